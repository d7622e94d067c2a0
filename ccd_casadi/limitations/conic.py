"""Two cone programmes on a grid of frequencies: the least scaling of discs that some T keeps, and
the multiplier h that shows it.

    min g: |T - c| <= g r,      max ∫ Σ Re h_i c_i dv: Σ h_i = h, ∫ Σ r_i|h_i| dv <= 1
"""

import numpy as np
from scipy import sparse

from ccd_casadi.support.arrays import Array

COST = 1e-5  # of the length of h's coefficients, in g
SOLVED = ("Solved", "AlmostSolved")
MATTERS = 0.01  # of its radius: a disc that holds another one but for that does not matter


def that_matter(centres: np.ndarray, radii: Array) -> np.ndarray:
    """Which of the discs (k, N): the first two, and others that no disc lies in, or almost."""
    found = np.ones(radii.shape, bool)
    for i in range(2, len(radii)):
        for j in range(len(radii)):
            holds = np.abs(centres[i] - centres[j]) + radii[j] <= (1.0 + MATTERS) * radii[i]
            if j != i:
                found[i] &= ~(holds & found[j])
    return found


def least_scaling(functions: np.ndarray, centres: np.ndarray, radii: Array) -> tuple[float, Array]:
    """g and the coefficients of T, from the basis on the grid (N, n) and discs (k, N) there."""
    n = functions.shape[1]
    disc, at = np.nonzero(that_matter(centres, radii))
    c, r, functions = centres[disc, at], radii[disc, at], functions[at]
    size = np.sqrt(r)[:, None]  # between rows that are ill scaled and discs that are
    rows, right = np.zeros((len(r), 3, n + 1)), np.zeros((len(r), 3))
    rows[:, 0, -1:] = -size
    rows[:, 1, :n], rows[:, 2, :n] = functions.real / size, functions.imag / size
    right[:, 1:] = np.array([c.real, c.imag]).T / size
    aim = np.append(np.zeros(n), 1.0)
    x = _solved(aim, sparse.csc_matrix(rows.reshape(-1, n + 1)), right.ravel(), 0, 0)
    return (np.inf, np.zeros(n)) if x is None else (float(x[-1]), x[:n])


def greatest_multiplier(
    functions: np.ndarray, width: Array, centres: np.ndarray, radii: Array
) -> tuple[float, Array]:
    """The same g from the other side and the coefficients of h; `width` are the grid's cells.

    The first disc is around 0; its h_i is what h and the others leave. The length of the
    coefficients costs a little: where T is small h may be anything, and large ones that cancel
    leave no certificate.
    """
    N, n = functions.shape
    disc, at = np.nonzero(that_matter(centres, radii)[1:])
    c, r, E = centres[1:][disc, at] * width[at], radii[1:][disc, at] * width[at], len(at)
    one, each = sparse.identity(N), sparse.identity(E)
    summed = sparse.csr_matrix((np.ones(E), (at, np.arange(E))), (N, E))
    re, im = (sparse.csr_matrix(-part) for part in (functions.real, functions.imag))
    # unknowns: coefficients, Re h_i, Im h_i, bounds of |h - Σ h_i|, of |h_i| and of the length
    rows = sparse.bmat([
        [None, None, None, (width * radii[0])[None], r[None], None],
        [None, None, None, -one, None, None], [re, summed, None, None, None, None],
        [im, None, summed, None, None, None],
        [None, None, None, None, -each, None], [None, -each, None, None, None, None],
        [None, None, -each, None, None, None],
        [None, None, None, None, None, [[-1.0]]],
        [-sparse.identity(n), None, None, None, None, None],
    ]).tocsr()  # fmt: skip
    threes = [np.arange(3 * count).reshape(3, count).T.ravel() for count in (N, E)]
    end = 1 + 3 * (N + E)
    order = [[0], 1 + threes[0], 1 + 3 * N + threes[1], np.arange(end, end + n + 1)]
    rows, right = rows[np.concatenate(order)].tocsc(), np.append(1.0, np.zeros(end + n))
    aim = np.concatenate([np.zeros(n), -c.real, c.imag, np.zeros(N + E), [COST]])
    x = _solved(aim, rows, right, 1, n + 1)
    return (np.inf, np.zeros(n)) if x is None else (float(-aim[:-1] @ x[:-1]), x[:n])


def _solved(
    aim: Array, rows: sparse.csc_matrix, right: Array, linear: int, last: int
) -> Array | None:
    """min aim·x where right - rows x is >= 0 in its `linear` first rows, then in cones of three,
    and in one cone of its `last` rows."""
    import clarabel  # slow to import

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.NonnegativeConeT(linear)] if linear else []
    cones += [clarabel.SecondOrderConeT(3)] * ((len(right) - linear - last) // 3)
    cones += [clarabel.SecondOrderConeT(last)] if last else []
    none = sparse.csc_matrix((len(aim), len(aim)))
    answer = clarabel.DefaultSolver(none, aim, rows, right, cones, settings).solve()
    return np.array(answer.x) if str(answer.status) in SOLVED else None
