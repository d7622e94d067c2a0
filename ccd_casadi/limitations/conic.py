"""The two cone programmes on a grid: the least scaling of both discs by a T, and its dual by an h.

    inside:   min g             over T in its basis,  |T| <= g m_T, |1 - T| <= g m_S
    outside:  max ∫ Re h₂ dv   over h in its basis and h₂,  ∫ m_T|h - h₂| + m_S|h₂| dv <= 1

By Clarabel's interior-point method (Goulart and Chen 2024). Nothing is believed of the answers:
`bound` looks at T on a finer grid, `certificate` at h on every interval.
"""

import numpy as np
from scipy import sparse

from ccd_casadi.support.arrays import Array

COST = 1e-5  # of the length of h's coefficients, in g
SOLVED = ("Solved", "AlmostSolved")


def least_scaling(functions: np.ndarray, m_S: Array, m_T: Array) -> tuple[float, Array]:
    """g and the coefficients of T, from the basis on the grid (N, n)."""
    N, n = functions.shape
    rows, right = np.zeros((2, N, 3, n + 1)), np.zeros((2, N, 3))
    for i, (m, sign) in enumerate(((m_T, -1.0), (m_S, 1.0))):
        size = np.sqrt(m)  # between rows that are ill scaled and discs that are
        rows[i, :, 0, -1] = -m / size
        rows[i, :, 1, :n] = sign * functions.real / size[:, None]
        rows[i, :, 2, :n] = sign * functions.imag / size[:, None]
    right[1, :, 1] = 1.0 / np.sqrt(m_S)
    aim = np.append(np.zeros(n), 1.0)
    x = _solved(aim, sparse.csc_matrix(rows.reshape(-1, n + 1)), right.ravel(), 0, 0)
    return (np.inf, np.zeros(n)) if x is None else (float(x[-1]), x[:n])


def greatest_multiplier(
    functions: np.ndarray, width: Array, m_S: Array, m_T: Array
) -> tuple[float, Array]:
    """The same g from the other side and the coefficients of h; `width` are the grid's cells.

    The length of the coefficients costs a little: where T is small h may be anything, and large
    ones that cancel leave no certificate.
    """
    N, n = functions.shape
    one, none = sparse.identity(N), sparse.csr_matrix((N, N))
    free = sparse.csr_matrix((N, n))
    re, im = (sparse.csr_matrix(-part) for part in (functions.real, functions.imag))
    # unknowns: coefficients, Re h₂, Im h₂, bounds of |h - h₂| and of |h₂|
    parts = [
        [free, none, none, -one, none], [re, one, none, none, none], [im, none, one, none, none],
        [free, none, none, none, -one], [free, -one, none, none, none],
        [free, none, -one, none, none],
    ]  # fmt: skip
    stacked = sparse.vstack([sparse.hstack(part) for part in parts]).tocsr()
    order = np.arange(6 * N).reshape(2, 3, N).transpose(0, 2, 1).ravel()
    budget = np.concatenate([np.zeros(n + 2 * N), width * m_T, width * m_S])
    cones = sparse.vstack([sparse.csr_matrix(budget[None]), stacked[order]])
    # the last unknown: the length of the coefficients, a cone of its own
    length = sparse.coo_matrix(
        (-np.ones(n + 1), (np.arange(n + 1), [n + 4 * N, *range(n)])), (n + 1, n + 4 * N + 1)
    )
    none = sparse.csr_matrix((1 + 6 * N, 1))
    rows = sparse.vstack([sparse.hstack([cones, none]), length]).tocsc()
    right = np.append(1.0, np.zeros(6 * N + n + 1))
    aim = np.concatenate([np.zeros(n), -width, np.zeros(3 * N), [COST]])
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
