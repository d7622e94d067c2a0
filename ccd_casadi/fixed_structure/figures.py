"""Every local peak of S, KS, T and GS on every plant against its bound, with exact derivatives.

All are logarithms of a gain over its bound, so that a constraint is c(κ, τ) <= 0 with τ = ln ω_b:

    S_max   ln|S| - ln S_max                        every local peak
    shape   ln|S| + ½ ln 2 - min(0, ln(shape ω/ω_b))    every local peak on ω <= ω_b, and ω_b itself
    S_low   ln|S(jω_low)| - ln S_low
    KS, T   ln|W_KS KS|, ln|W_T T| - ln weighted_level,   GS   ln|GS| - ln compliance_max

Candidates are the local maxima on a grid that runs through every pole and zero of plants,
controller and closed loops with its flanks: a rational function has no narrower peak than these.
Each is closed on the zero of its exact slope. At a peak the derivative to κ is that of the curve,

    ∂ln|S| = ∂ln|GS| = -Re(T ∂ln K),   ∂ln|KS| = ∂ln|T| = Re(S ∂ln K)      (κ)
    ∂ln|S| = ∂ln|KS| = -Re(S K ∂G),    ∂ln|T| = Re(S ∂G/G)                 (the plant, so θ)
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, singledispatch

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.loop import PlantSet, closed_loops, stable
from ccd_casadi.fixed_structure.structure import (
    Structure,
    response,
    response_and_slope,
    response_and_slopes,
    roots,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights

PER_DECADE = 24
FLANKS = np.array([-3.0, -1.0, -0.4, 0.0, 0.4, 1.0, 3.0])  # in half widths of a root
AROUND_THE_KINK = np.array([0.97, 0.99, 0.997, 1.0, 1.003, 1.01, 1.03])
RELEVANT = -1.0  # ln of the share of its bound under which a peak is none of ours
APART = 1e-8  # relative: grid points that are closer count as one
CLOSINGS = 9  # of a peak's bracket by false position; the error is squared, so is its effect
HALF_POWER = 0.5 * np.log(2.0)


class Curve(IntEnum):
    """What is bounded."""

    S_MAX = 0
    SHAPE = 1
    S_LOW = 2
    KS = 3
    T = 4
    GS = 5
    CROSSING = 6  # |S(jω_b)| <= 1/√2, the end of the shape


@dataclass(frozen=True)
class LoopProblem:
    """The plants, the structure and the bounds, frequencies over ω₀; `box` (2, n) bounds κ.

    `margin` is how far (in logarithms) inside every bound its searches aim.
    """

    plants: PlantSet
    structure: Structure | ChannelStructure
    bounds: Bounds
    box: Array
    margin: float = 0.0

    @cached_property
    def low(self) -> float:
        """ω_low over ω₀."""
        return self.bounds.omega_low / self.plants.omega_0

    @cached_property
    def base(self) -> Array:
        """v from far below ω_low and every root to far above, logarithmic."""
        sizes = np.abs(self.plants.poles[self.plants.residues != 0.0])
        bottom = 0.03 * min(self.low, float(sizes.min()))
        top = 100.0 * max(1.0, float(sizes.max()))  # of a rigid body ω₀, not its suspension
        if self.bounds.weighted_level is not None and self.bounds.weights is not None:
            w = self.bounds.weights  # a K without enough roll-off has its largest W_KS KS there
            top = max(top, 10.0 * max(w.c_K * w.omega_K, w.omega_T / w.A_u) / self.plants.omega_0)
        if self.plants.period is not None:
            top = 100.0 / self.plants.period
        return np.geomspace(bottom, top, int(PER_DECADE * np.log10(top / bottom)))

    @cached_property
    def fixed(self) -> Array:
        """The base grid and the flanks of every plant's poles and zeros, (P, k)."""
        P = self.plants
        widest = max(len(z) for z in P.zeros)
        found = np.full((len(P.plants), P.A.shape[1] + widest), np.nan, complex)
        for i, plant in enumerate(P.plants):
            found[i, : len(plant.A)] = np.linalg.eigvals(plant.A)
            found[i, P.A.shape[1] : P.A.shape[1] + len(P.zeros[i])] = P.zeros[i]
        return np.concatenate([np.tile(self.base, (len(found), 1)), _flanked(found)], axis=1)

    @cached_property
    def curves(self) -> tuple[Curve, ...]:
        """Those of which all peaks count."""
        found = [Curve.S_MAX, Curve.SHAPE]
        if self.bounds.weighted_level is not None:
            found += [Curve.KS, Curve.T]
        if self.bounds.compliance_max is not None:
            found.append(Curve.GS)
        return tuple(found)


@dataclass(frozen=True)
class Problem(LoopProblem):
    """That of SISO plants."""

    structure: Structure


@dataclass(frozen=True)
class Loops:
    """S, K, G, T of some plants at some v, and the slopes of ln|·| to ln v."""

    v: Array
    which: np.ndarray
    S: np.ndarray
    K: np.ndarray
    to_kappa: np.ndarray
    levels: dict[Curve, Array]
    slopes: dict[Curve, Array]


@dataclass(frozen=True)
class Constraints:
    """M constraints c <= 0: curve, plant, v (over ω₀), value, derivatives to κ (M, n) and τ."""

    curve: np.ndarray
    plant: np.ndarray
    v: Array
    value: Array
    to_kappa: Array
    to_tau: Array

    def only(self, chosen: np.ndarray) -> "Constraints":
        """Some of them, by mask or index."""
        parts = (self.curve, self.plant, self.v, self.value, self.to_kappa, self.to_tau)
        return Constraints(*(part[chosen] for part in parts))


def plant_of_row(problem: LoopProblem, row: np.ndarray) -> np.ndarray:
    """The plant that a constraint's `plant` belongs to: several rows of a plant are numbered on."""
    return row % len(problem.plants.plants)


@dataclass(frozen=True)
class Assessment:
    """One controller on all plants: stable or not, and where it is, its constraints.

    `peaks` are exact; `near` lie on the base grid and tell how curves go between the peaks.
    """

    stable: bool
    poles: np.ndarray
    peaks: Constraints | None
    near: Constraints | None

    @property
    def violation(self) -> float:
        """The largest c above 0; infinite for an unstable loop."""
        if self.peaks is None:
            return np.inf
        return max(0.0, float(self.peaks.value.max()))


@singledispatch
def assess(
    problem: LoopProblem,
    kappa: Array,
    tau: float,
    *,
    within: float = 0.5,
    depth: float = RELEVANT,
    each: bool = False,
) -> Assessment:
    """Stability by the eigenvalues of every loop, then the constraints with c > `depth`.

    `within`: how far below 0 a value on the base grid may be to be among `near`.
    `each`: the constraints of unstable loops are given too, where some are stable.
    """
    assert isinstance(problem, Problem)
    poles = closed_loops(problem.plants, problem.structure, kappa)[0]
    good = stable(poles)
    if not good.any() if each else not good.all():
        return Assessment(False, poles, None, None)
    v, regular = frequency_grid(problem, roots(problem.structure, kappa), poles, tau)
    P, k = v.shape
    which = np.broadcast_to(np.arange(P)[:, None], v.shape)
    loops = evaluate(problem, kappa, tau, which, v, order=0)
    found, near = [], []
    crossing = float(problem.plants.variable(np.array([np.exp(tau)]))[0])
    for curve in problem.curves:
        value = loops.levels[curve]
        if curve is Curve.SHAPE:
            value = np.where(v <= crossing, value, -np.inf)
        left, right = np.full((2, P, k), -np.inf)
        left[:, 1:], right[:, :-1] = value[:, :-1], value[:, 1:]
        rows, at = np.nonzero((value > depth) & (value >= left) & (value > right))
        low, high = v[rows, np.maximum(at - 1, 0)], v[rows, np.minimum(at + 1, k - 1)]
        if curve is Curve.SHAPE:
            high = np.minimum(high, crossing)
        found.append((np.full(len(rows), curve), rows, v[rows, at], low, high))
        rows, at = np.nonzero(regular & (value > -within))
        near.append((np.full(len(rows), curve), rows, v[rows, at]))
    kind, rows, start, low, high = (np.concatenate(part) for part in zip(*found, strict=True))
    top, closed = _closed(problem, kappa, tau, kind, rows, start, low, high)
    # Of the shape an open end at ω_b is the crossing; one at the lowest frequency is its own.
    whole = closed | (kind != Curve.SHAPE) | (start < 0.1 * crossing)
    kind, rows, top = kind[whole], rows[whole], top[whole]
    plants = np.arange(P)
    low_v = float(problem.plants.variable(np.array([problem.low]))[0])
    kind = np.concatenate([kind, np.full(P, Curve.S_LOW), np.full(P, Curve.CROSSING)])
    rows = np.concatenate([rows, plants, plants])
    top = np.concatenate([top, np.full(P, low_v), np.full(P, crossing)])
    other = [np.concatenate(part) for part in zip(*near, strict=True)]
    return Assessment(
        True,
        poles,
        constraints(problem, kappa, tau, kind, rows, top),
        constraints(problem, kappa, tau, *other),
    )


def constraints(
    problem: Problem, kappa: Array, tau: float, curve: np.ndarray, which: np.ndarray, v: Array
) -> Constraints:
    """Values and derivatives of these curves of these plants at these v."""
    loops = evaluate(problem, kappa, tau, which, v)
    value, to_tau = np.empty(len(v)), np.zeros(len(v))
    for code in np.unique(curve):
        chosen = curve == code
        value[chosen] = loops.levels[Curve(code)][chosen] + problem.margin
    T = 1.0 - loops.S
    of_s = np.isin(curve, (Curve.S_MAX, Curve.SHAPE, Curve.S_LOW, Curve.CROSSING, Curve.GS))
    factor = np.where(of_s, -T, loops.S)
    to_kappa = (factor[:, None] * loops.to_kappa).real
    omega = problem.plants.frequency(v)
    if problem.bounds.shape is not None:
        rising = shaped_at(problem, omega) * problem.bounds.shape < np.exp(tau)
        to_tau[(curve == Curve.SHAPE) & rising] = 1.0
    end = curve == Curve.CROSSING
    to_tau[end] = (loops.slopes[Curve.CROSSING] / chain_of(problem, v))[end]
    return Constraints(curve, which, v, value, to_kappa, to_tau)


def evaluate(
    problem: Problem, kappa: Array, tau: float, which: np.ndarray, v: Array, *, order: int = 2
) -> Loops:
    """All curves of the plants `which` at v (any one shape), relative to their bounds.

    `order` 0: levels only, 1: slopes to ln v only, 2: both, and ∂ln K/∂κ.
    """
    plants, bounds = problem.plants, problem.bounds
    s = 1j * v
    to_kappa = np.zeros((*v.shape, 0))
    K_slope: np.ndarray = np.zeros(())
    if order == 0:
        K = response(problem.structure, kappa, s)
    elif order == 1:
        K, K_slope = response_and_slope(problem.structure, kappa, s)
    else:
        K, to_kappa, K_slope = response_and_slopes(problem.structure, kappa, s)
    if order == 0:
        G, dG = plants.values(which, v), np.zeros(())
    else:
        G, dG = plants.responses(which, v)
    L = G * K
    S = 1.0 / (1.0 + L)
    omega = plants.frequency(v)
    weighted, compliant = Curve.KS in problem.curves, bounds.compliance_max is not None
    levels: dict[Curve, Array] = {}
    gradients: dict[Curve, Array] = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        shaped = shaped_at(problem, omega)
        under = np.zeros(v.shape)
        if bounds.shape is not None:
            under = np.minimum(np.log(bounds.shape * shaped) - tau, 0.0)
        if weighted:
            assert bounds.weights is not None
            W, dW = log_weights(bounds.weights, omega * plants.omega_0)
        if compliant and order == 0:
            free, free_slope = plants.values(which, v, free=True), np.zeros(())
        elif compliant:
            free, free_slope = plants.free_responses(which, v)
        if order != 1:
            ln_S = np.log(np.abs(S))
            levels = {
                Curve.S_MAX: ln_S - np.log(bounds.S_max),
                Curve.S_LOW: ln_S - np.log(bounds.S_low),
                Curve.CROSSING: ln_S + HALF_POWER,
                Curve.SHAPE: ln_S + HALF_POWER - under,
            }
            if bounds.weighted_level is not None:
                ln_level = np.log(bounds.weighted_level)
                ln_K, ln_L = np.log(np.abs(K)), np.log(np.abs(L))
                levels[Curve.KS] = ln_K + ln_S + W[0] + np.log(plants.force) - ln_level
                levels[Curve.T] = ln_L + ln_S + W[1] - ln_level
            if bounds.compliance_max is not None:
                ceiling = np.log(bounds.compliance_max * plants.force)
                levels[Curve.GS] = np.log(np.abs(free)) + ln_S - ceiling
        if order:
            chain = chain_of(problem, v)
            slope = -(S * (K * dG + L * K_slope)).real
            gradients = dict.fromkeys((Curve.S_MAX, Curve.S_LOW, Curve.CROSSING), slope)
            gradients[Curve.SHAPE] = slope - ((under < 0.0) & (shaped == omega)) * chain
            if weighted:
                gradients[Curve.KS] = K_slope.real + slope + dW[0] * chain
                gradients[Curve.T] = (K_slope + dG / G).real + slope + dW[1] * chain
            if compliant:
                gradients[Curve.GS] = (free_slope / free).real + slope
    return Loops(v, which, S, K, to_kappa, levels, gradients)


@singledispatch
def to_theta(problem: LoopProblem, kappa: Array, found: Constraints) -> Array:
    """∂c/∂θ (M, n_θ) at fixed κ and τ."""
    assert isinstance(problem, Problem)
    plants = problem.plants
    count = plants.plants[0].dA.shape[0]
    out = np.zeros((len(found.v), count))
    loops = evaluate(problem, kappa, 0.0, found.plant, found.v)
    G, _ = plants.responses(found.plant, found.v)
    free, _ = plants.free_responses(found.plant, found.v)
    for i in np.unique(found.plant):
        at = np.flatnonzero(found.plant == i)
        dG = plants.to_theta(int(i), found.v[at])
        S, K = loops.S[at][:, None], loops.K[at][:, None]
        loss = -(S * K * dG).real
        of_t = (found.curve[at] == Curve.T)[:, None]
        out[at] = loss + np.where(of_t, (dG / G[at][:, None]).real, 0.0)
        of_gs = found.curve[at] == Curve.GS
        if of_gs.any():
            own = plants.to_theta(int(i), found.v[at][of_gs], free=True)
            out[at[of_gs]] += (own / free[at][of_gs][:, None]).real
    return out


def log_weights(weights: Weights, omega: Array) -> tuple[Array, Array]:
    """ln|W_KS| (m/N), ln|W_T| as rows, and their slopes to ln ω; ω in rad/s."""
    w = weights
    square = omega**2
    pairs = ((w.omega_K, w.c_K * w.omega_K), (w.omega_T / w.A_l, w.omega_T / w.A_u))
    scales = (w.c_K / w.M_K, 1.0 / w.A_u)
    values = [
        np.log(scale) + 0.5 * np.log((square + zero**2) / (square + pole**2))
        for scale, (zero, pole) in zip(scales, pairs, strict=True)
    ]
    slopes = [square / (square + z**2) - square / (square + p**2) for z, p in pairs]
    return np.array(values), np.array(slopes)


def shaped_at(problem: LoopProblem, omega: Array) -> Array:
    """The ω that the shape counts: its own, without an integrator at least ω_low."""
    return omega if problem.structure.integrator else np.maximum(omega, problem.low)


def chain_of(problem: LoopProblem, v: Array) -> Array:
    """∂ln ω/∂ln v."""
    T = problem.plants.period
    if T is None:
        return np.ones_like(v)
    return np.asarray(v / problem.plants.frequency(v) / (1.0 + (0.5 * T * v) ** 2))


def frequency_grid(
    problem: LoopProblem, controller: tuple[np.ndarray, np.ndarray], poles: np.ndarray, tau: float
) -> tuple[Array, np.ndarray]:
    """The frequencies v (P, k), ascending, on which peaks are looked for; which are of the base.

    `controller`: the zeros and the poles of K. Where the shape turns level its curve has a kink,
    and may have a peak on either side of it.
    """
    own = np.concatenate(controller)
    own = np.tile(own[np.abs(own) > 0.0], (len(poles), 1))
    parts = [problem.fixed, _flanked(own), _flanked(poles)]
    if problem.bounds.shape is not None:
        kink = np.exp(tau) / problem.bounds.shape * AROUND_THE_KINK
        parts.append(np.tile(problem.plants.variable(kink), (len(poles), 1)))
    joint = np.concatenate(parts, axis=1)
    bottom, top = problem.base[0], problem.base[-1]
    # Points that fall together would hide a peak between them: spares go below the base instead.
    spare = np.broadcast_to(bottom * np.linspace(0.5, 0.99, joint.shape[1]), joint.shape)
    joint = np.where((joint >= bottom) & (joint <= top), joint, spare)
    order = np.argsort(joint, axis=1, kind="stable")
    v = np.take_along_axis(joint, order, axis=1)
    twice = np.zeros(v.shape, bool)
    twice[:, 1:] = np.diff(v, axis=1) < APART * v[:, 1:]
    regular = (order < len(problem.base)) & ~twice
    v = np.where(twice, spare * 0.5, v)
    order = np.argsort(v, axis=1)
    v, regular = np.take_along_axis(v, order, axis=1), np.take_along_axis(regular, order, axis=1)
    # Conjugate roots fall together, so that nearly half were spares; one below the base is enough.
    useless = slice(1, max(1, int((v < bottom).sum(axis=1).min())))
    return np.delete(v, useless, axis=1), np.delete(regular, useless, axis=1)


def _flanked(values: np.ndarray) -> Array:
    """Frequencies around roots (P, n): the imaginary part with flanks, and the size."""
    centre, half = np.abs(values.imag), np.abs(values.real)
    found = centre[..., None] + half[..., None] * FLANKS
    return np.concatenate([found.reshape(len(values), -1), np.abs(values)], axis=1)


def _closed(
    problem: Problem,
    kappa: Array,
    tau: float,
    curve: np.ndarray,
    which: np.ndarray,
    start: Array,
    low: Array,
    high: Array,
) -> tuple[Array, np.ndarray]:
    def slope(x: Array, of: np.ndarray) -> Array:
        loops = evaluate(problem, kappa, tau, which[of], np.exp(x), order=1)
        out = np.empty(len(x))
        for code in np.unique(curve[of]):
            chosen = curve[of] == code
            out[chosen] = loops.slopes[Curve(code)][chosen]
        return out

    return closed_on_zero(slope, start, low, high)


def closed_on_zero(
    slope: Callable[[Array, np.ndarray], Array], start: Array, low: Array, high: Array
) -> tuple[Array, np.ndarray]:
    """Local maxima by Illinois false position on the slope, in brackets [low, high] around start.

    `slope` takes logarithms and the indices of the brackets that they are in. Where a bracket's
    slopes do not change sign (an end) the start stays; second: where they do.
    """
    if not len(start):
        return start, np.zeros(0, bool)
    every = np.arange(len(start))
    middle = np.log(start)
    f = slope(middle, every)
    other = np.where(f > 0.0, np.log(high), np.log(low))
    g = slope(other, every)
    a, fa, b, fb = middle.copy(), f.copy(), other, g
    inside = (fa * fb < 0.0) & np.isfinite(fa) & np.isfinite(fb)
    left = np.flatnonzero(inside)
    for _ in range(CLOSINGS):
        if not len(left):
            break
        A, FA, B, FB = a[left], fa[left], b[left], fb[left]
        x = B - FB * (B - A) / (FB - FA)
        fx = slope(x, left)
        opposite = fx * FB < 0.0
        a[left], fa[left] = np.where(opposite, B, A), np.where(opposite, FB, 0.5 * FA)
        b[left], fb[left] = x, fx
        left = left[np.abs(fx) >= 1e-9]
    return np.exp(np.where(inside, b, middle)), inside
