"""Multipliers for the bound on every controller: Laguerre and Kautz functions, and the cone
programme that chooses among them."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class MultiplierBasis:
    """`reals` a > 0 for s = -a, then `pairs` p (Re p > 0, Im p > 0) for s = -p and its conjugate.

    `corner` a and `order` e of the roll-off; `zeros` z with `turned` -1 for a multiplier, +1 for
    a T; `constant`: 1 is one of the functions.
    """

    reals: tuple[float, ...]
    pairs: tuple[complex, ...]
    corner: float
    order: int
    zeros: tuple[complex, ...] = ()
    turned: int = -1
    constant: bool = False

    def values(self, v: Array) -> np.ndarray:
        """(len(v), n) at s = jv."""
        s = 1j * v
        fixed = (self.corner / (s + self.corner)) ** self.order
        for z in self.zeros:
            fixed = fixed * ((s - z) / (s + np.conj(z))) ** self.turned
        found = [fixed] if self.constant else []
        product = fixed
        for a in self.reals:
            below = s + a
            found.append(product * np.sqrt(2.0 * a) / below)
            product = product * ((s - a) / below)
        for p in self.pairs:
            b, c = 2.0 * p.real, abs(p) ** 2
            below = s * s + b * s + c
            found.append(product * np.sqrt(2.0 * b) * s / below)
            found.append(product * np.sqrt(2.0 * b * c) / below)
            product = product * (s * s - b * s + c) / below
        return np.array(found).T

    def most_curved(self, low: Array, high: Array, weight: Array) -> Array:
        """Σ_k weight_k max |d²/dv²| of every function on the intervals, or more.

        Of F = Π f_i with l_i = f_i'/f_i it is F (Σ l_i)² + F Σ l_i'; |l| <= 1/d and |l'| <= 1/d²
        of a pole at the distance d, 2 Re p/d² and 4 Re p/d³ of an all-pass factor.
        """
        assert not self.constant

        def near(p: complex) -> Array:
            gap = np.maximum(np.maximum(low + p.imag, -p.imag - high), 0.0)
            return np.asarray(np.hypot(p.real, gap))

        corner = near(self.corner + 0j)
        size = (self.corner / corner) ** self.order
        slope, bend = self.order / corner, self.order / corner**2
        for z in self.zeros:
            d = near(complex(z))
            slope, bend = slope + 2.0 * z.real / d**2, bend + 4.0 * z.real / d**3
        weights = iter(np.abs(weight).tolist())
        total = np.zeros(low.shape)
        for a in self.reals:
            d = near(complex(a))
            second = (slope + 1.0 / d) ** 2 + bend + 1.0 / d**2
            total += next(weights) * np.sqrt(2.0 * a) / d * size * second
            slope, bend = slope + 2.0 * a / d**2, bend + 4.0 * a / d**3
        for p in self.pairs:
            one, two = near(p), near(np.conj(p))
            b, r = 2.0 * p.real, size / (one * two)
            first = slope + 1.0 / one + 1.0 / two
            second = first**2 + bend + 1.0 / one**2 + 1.0 / two**2
            total += next(weights) * np.sqrt(2.0 * b) * r * (2.0 * first + high * second)
            total += next(weights) * np.sqrt(2.0 * b) * abs(p) * r * second
            slope = slope + b * (1.0 / one**2 + 1.0 / two**2)
            bend = bend + 2.0 * b * (1.0 / one**3 + 1.0 / two**3)
        return total

    def tail(self, start: float, weight: Array) -> float:
        """∫ |h| dv from `start` on, or more, with a roll-off of order 1: a real pole's function is
        at most √(2a)/v; from twice |p| on one of a pair at most 4√(4 Re p)/v, as |jv + p| >= v/2.
        """
        assert self.order == 1
        assert not self.constant
        assert start >= 2.0 * max(map(abs, self.pairs), default=0.0)
        most = [np.sqrt(2.0 * a) for a in self.reals]
        for p in self.pairs:
            most += [4.0 * np.sqrt(4.0 * p.real)] * 2
        return float(np.abs(weight) @ np.array(most) * self.corner / start)


SOLVED = ("Solved", "AlmostSolved")


def that_matter(centres: np.ndarray, radii: Array, almost: float = 0.01) -> np.ndarray:
    """Select of the discs (k, N) the first two, and others that no disc contains, or all but
    `almost` of their radius."""
    found = np.ones(radii.shape, bool)
    for i in range(2, len(radii)):
        for j in range(len(radii)):
            holds = np.abs(centres[i] - centres[j]) + radii[j] <= (1.0 + almost) * radii[i]
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
    x = _solve(aim, sparse.csc_matrix(rows.reshape(-1, n + 1)), right.ravel(), 0, 0)
    return (np.inf, np.zeros(n)) if x is None else (float(x[-1]), x[:n])


def greatest_multiplier(
    functions: np.ndarray, width: Array, centres: np.ndarray, radii: Array, cost: float = 1e-5
) -> tuple[float, Array]:
    """The same g from the other side and the coefficients of h; `width` are the grid's cells.

    The first disc is around 0; its h_i is what h and the others leave. The length of the
    coefficients costs a little, `cost` in g: where T is small h may be anything, and large ones
    that cancel leave no certificate.
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
    aim = np.concatenate([np.zeros(n), -c.real, c.imag, np.zeros(N + E), [cost]])
    x = _solve(aim, rows, right, 1, n + 1)
    return (np.inf, np.zeros(n)) if x is None else (float(-aim[:-1] @ x[:-1]), x[:n])


def _solve(
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
