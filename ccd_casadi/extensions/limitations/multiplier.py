"""What forbids a bandwidth: discs, by the bounds on a loop, and a multiplier that combines them.

T lies in the discs of a frequency, of one plant and of others of its set. Multipliers are Laguerre
and Kautz functions; a cone programme chooses among them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy
from scipy import sparse

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

ROOT_HALF = np.sqrt(0.5)


@dataclass(frozen=True)
class Response:
    """g(jv) by poles and zeros, `value` at `at`; between two frequencies each factor has an
    exact range of its size. `accuracy`: relative error up to which they are used."""

    accuracy: ClassVar[float] = 1e-6

    zeros: np.ndarray
    poles: np.ndarray
    at: float
    value: complex

    def values(self, v: Array) -> np.ndarray:
        """Compute g(jv)."""
        found = np.full(v.shape, complex(self.value))
        for roots, sign in ((self.zeros, 1), (self.poles, -1)):
            for r in roots:
                found = found * ((1j * v - r) / (1j * self.at - r)) ** sign
        return found

    def range(self, low: Array, high: Array) -> tuple[Array, Array]:
        """The least and the largest that |g| can be on the intervals, its error included."""
        least, most = (np.full(low.shape, np.log(abs(self.value))) for _ in range(2))
        with np.errstate(divide="ignore"):  # of a pole or zero on the axis: from 0 or to infinity
            self._widen(least, most, low, high)
        return np.exp(least) * (1.0 - self.accuracy), np.exp(most) * (1.0 + self.accuracy)

    def _widen(self, least: Array, most: Array, low: Array, high: Array) -> None:
        """Adds the ranges of all factors' logarithms."""
        for roots, sign in ((self.zeros, 1.0), (self.poles, -1.0)):
            for r in roots:
                near = np.maximum(np.maximum(low - r.imag, r.imag - high), 0.0)
                far = np.maximum(np.abs(low - r.imag), np.abs(high - r.imag))
                one, two = (
                    sign * np.log(np.hypot(r.real, gap) / abs(1j * self.at - r))
                    for gap in (near, far)
                )
                least += np.minimum(one, two)
                most += np.maximum(one, two)


def response_of(system: StateSpace) -> Response | None:
    """Compute the response of one input and output, continuous or sampled; there in v, delays as
    zeros at 2/T.

    None where the input does not reach the output, as between axes that are apart.

    Raises PlantError where poles and zeros do not give the response.
    """
    T = system.period
    on = _find_reached(system.A, system.B) & _find_reached(system.A.T, system.C.T)
    if not on.any():
        return None
    even = balance_system(
        system.A[on][:, on], system.B[on], system.C[:, on]
    )  # or its zeros have errors of 1e-3
    system = StateSpace(*even, system.D, period=T)
    poles = system.poles
    size = 1.0 if T else float(np.abs(poles).max()) or 1.0
    zeros = system.zeros(size)
    if T:
        beyond = np.full(len(poles) - len(zeros), 2.0 / T, complex)  # zeros at z = ∞
        poles, zeros = (2.0 / T * (x - 1.0) / (x + 1.0) for x in (poles, zeros))
        zeros = np.append(zeros, beyond)
    poles = np.where(_resting(poles), 0.0, poles)
    moving = np.abs(poles[poles != 0.0])
    top = 2.0 / T if T else float(np.median(moving)) if moving.size else size
    v = top * np.geomspace(1e-3, 3.0, 25)
    omega = v if not T else 2.0 / T * np.arctan(0.5 * v * T)
    response = system.response(omega)[:, 0, 0]
    found = Response(zeros, poles, float(v[12]), complex(response[12]))
    error = np.abs(found.values(v) / response - 1.0).max()
    if not error <= 0.5 * Response.accuracy:
        words = "its poles and zeros do not give its response"
        raise PlantError(f"no bound on every controller: {words} (off by {error:.1e})")
    return found


def _resting(poles: np.ndarray, at_rest: float = 1e-6) -> np.ndarray:
    """Find the poles (s, or v of a sampled plant) of free bodies: `at_rest` of the fastest."""
    size = np.abs(poles)
    return np.asarray(size <= at_rest * size.max(initial=0.0))


def _find_reached(A: Array, B: Array) -> np.ndarray:
    """Find the states that the inputs reach through entries that are not zero."""
    found = np.asarray(B.any(axis=1))
    for _ in A:
        found = found | A[:, found].any(axis=1)
    return found


@dataclass(frozen=True)
class Limits:
    """The loop in one direction of outputs: ‖uᵀG‖ as held, |G| without hold (one channel), bounds.

    `others`: one channel's, of other plants that the same controller serves.
    `ratio`: its bandwidth over ω_b. `integrator`: the shape counts from 0 on, else from ω_low.
    `beyond`: zeros of G in the right half plane, in v, which T has for every controller.
    `unstable`: one channel's poles there, where S is 0 for every controller.
    `unbounded`: m_T where nothing bounds T, more than 1 + S_max.
    """

    unbounded: ClassVar[float] = 20.0

    name: str
    bounds: Bounds
    row: tuple[Response, ...]
    free: Response | None
    period: float
    beyond: tuple[complex, ...] = ()
    ratio: float = 1.0
    integrator: bool = True
    others: tuple["Limits", ...] = ()
    unstable: tuple[complex, ...] = ()

    def omega(self, v: Array) -> Array:
        """Return ω in rad/s."""
        T = self.period
        return np.asarray(2.0 / T * np.arctan(0.5 * T * v)) if T else v

    def variable(self, omega: float) -> float:
        """v of ω in rad/s, infinite from half the sampling rate on."""
        if not self.period:
            return omega
        angle = 0.5 * omega * self.period
        return float(2.0 / self.period * np.tan(angle)) if angle < 0.5 * np.pi else np.inf

    @cached_property
    def roots(self) -> np.ndarray:
        """Poles and zeros of the plants, in v."""
        rows = [g for one in (self, *self.others) for g in one.row]
        return np.concatenate([part for g in rows for part in (g.poles, g.zeros)])

    def radii(self, low: Array, high: Array, omega_b: float) -> tuple[Array, Array]:
        """m_S and m_T on the intervals [low, high] of v: no S, no T is larger anywhere on them."""
        bounds, own = self.bounds, self.ratio * omega_b
        first, last = self.omega(low), self.omega(high)
        m_S = np.full(low.shape, bounds.S_max)
        m_S = np.where(last <= own, np.minimum(m_S, ROOT_HALF), m_S)
        if bounds.shape is not None:
            counts = first >= (0.0 if self.integrator else bounds.omega_low)
            if bounds.shape_ends is ShapeEnd.CROSSING:
                counts &= last <= own
            x = last / own
            m_S = np.where(counts, np.minimum(m_S, bounds.room(x) * ROOT_HALF * x), m_S)
        if bounds.compliance_max is not None and self.free is not None:
            least = self.free.range(first, last)[0]
            m_S = np.minimum(m_S, bounds.compliance_max / least)
        m_T = np.full(low.shape, self.unbounded)
        if bounds.weighted_level is not None and bounds.weights is not None:
            ends = np.abs([bounds.weights.responses(omega) for omega in (first, last)])
            _, W_KS, W_T = ends.min(axis=0)  # both are monotone in ω
            square = sum(g.range(low, high)[1] ** 2 for g in self.row)
            m_T = np.minimum(m_T, bounds.weighted_level / W_T)
            m_T = np.minimum(m_T, bounds.weighted_level / W_KS * np.sqrt(square))
        return m_S, m_T


def discs(
    limits: Limits, low: Array, high: Array, omega_b: float, largest: float = 100.0
) -> tuple[np.ndarray, Array]:
    """Centres and radii (k, N) on the intervals [low, high] of v: T is in all of them.

    A disc whose radius is `largest` or more is replaced by the first."""
    m_S, m_T = limits.radii(low, high, omega_b)
    centres, radii = [np.zeros(low.shape), np.ones(low.shape)], [m_T, m_S]
    for other in limits.others:
        m_S, m_T = other.radii(low, high, omega_b)
        r, spread = ratio(limits.row[0], other.row[0], low, high)
        slack = np.maximum(1.0 - spread * np.minimum(m_T, 1.0 + m_S), 1e-9)  # |T| <= 1 + |S|
        S, size = circle(1.0 / r, m_T * (1.0 + spread) / slack)  # T and S change places
        for centre, radius in (circle(r, m_S / slack), (1.0 - S, size)):
            matters = radius < largest
            centres.append(np.where(matters, centre, 0.0))
            radii.append(np.where(matters, radius, radii[0]))
    return np.array(centres), np.array(radii)


def ratio(one: Response, other: Response, low: Array, high: Array) -> tuple[np.ndarray, Array]:
    """r = other/one at the intervals' middles, and |r(middle)/r(v) - 1| at most, on each.

    Of roots a and b in pairs |d ln r/dv| is at most the sum of |a - b|/(|jv - a| |jv - b|); of a
    root p without another 1/|jv - p|.
    """
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    slope = np.zeros(low.shape)

    def near(p: complex) -> Array:
        gap = np.maximum(np.maximum(low - p.imag, p.imag - high), 0.0)
        return np.asarray(np.hypot(p.real, gap))

    for mine, yours in ((one.zeros, other.zeros), (one.poles, other.poles)):
        rows, columns = scipy.optimize.linear_sum_assignment(np.abs(mine[:, None] - yours[None, :]))
        for a, b in zip(mine[rows], yours[columns], strict=True):
            if a != b:  # as the poles at 0 of free bodies
                slope += abs(a - b) / (near(a) * near(b))
        for p in (*np.delete(mine, rows), *np.delete(yours, columns)):
            slope += 1.0 / near(p)
    r = other.values(middle) / one.values(middle)
    return r, np.expm1(half * slope + 3.0 * Response.accuracy)


def circle(r: np.ndarray, m: Array) -> tuple[np.ndarray, Array]:
    """Compute the circle |1 - T| <= m |1 + (r - 1) T|; an infinite radius where that is not the
    inside of one."""
    square = 1.0 - (m * np.abs(r - 1.0)) ** 2
    inside = square > 0.0
    square = np.where(inside, square, 1.0)
    radius = np.where(inside, m * np.abs(r) / square, np.inf)
    return np.conj(1.0 + m**2 * (r - 1.0)) / square, radius


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
