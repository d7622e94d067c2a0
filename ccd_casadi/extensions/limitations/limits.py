"""What the bounds on a loop say of T at one frequency: discs, of one plant and of others of its
set."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.lti.loop import Sampling, zoh
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


def limits_of(
    plant: StateSpace,
    bounds: Bounds,
    sampling: Sampling | None,
    name: str = "",
    direction: Array | None = None,
    ratio: float = 1.0,
    integrator: bool = True,
    outside: float = 1e-3,
) -> Limits:
    """Find the limits of a SI plant in a direction of outputs (one output: None).

    `bounds` are its own. Free bodies and unstable poles make S vanish there; what is used here, T
    analytic with zeros of G, holds with them too. A root whose real part is `outside` of its size
    counts as one of the right half plane.
    """
    if sampling is None:
        held, period = plant, 0.0
    else:
        held, period = zoh(plant, sampling.period, sampling.delay), sampling.period
    u = np.ones((1, 1)) if direction is None else np.asarray(direction)[None, :]
    parts = (
        response_of(
            StateSpace(held.A, held.B[:, [j]], u @ held.C, u @ held.D[:, [j]], period=period)
        )
        for j in range(held.B.shape[1])
    )
    row = tuple(part for part in parts if part is not None)
    one = plant.B.shape[1] == 1 and len(plant.C) == 1
    roots = (row[0].zeros, row[0].poles) if one else (np.empty(0, complex),) * 2
    beyond, growing = (tuple(part[part.real > outside * np.abs(part)].tolist()) for part in roots)
    free = None
    forced = getattr(plant, "mechanics", plant)  # on which disturbing forces act
    alone = forced.B.shape[1] == len(forced.C) == 1  # what they move is S times it
    if one and alone and bounds.compliance_max is not None:
        free = response_of(forced)
    return Limits(name, bounds, row, free, period, beyond, ratio, integrator, unstable=growing)


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
