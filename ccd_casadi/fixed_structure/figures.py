"""Every local peak of S, KS, T and GS on every plant against its bound, with exact derivatives.

The constraints are those of `loop_problem`, their peaks those that `peak_search` finds. At a peak
the derivative to κ is that of the curve,

    ∂ln|S| = ∂ln|GS| = -Re(T ∂ln K),   ∂ln|KS| = ∂ln|T| = Re(S ∂ln K)      (κ)
    ∂ln|S| = ∂ln|KS| = -Re(S K ∂G),    ∂ln|T| = Re(S ∂G/G)                 (the plant, so θ)
"""

from dataclasses import dataclass
from functools import singledispatch

import numpy as np

from ccd_casadi.fixed_structure.loop import closed_loops, stable
from ccd_casadi.fixed_structure.loop_problem import (
    Assessment,
    Constraints,
    Curve,
    LoopProblem,
    Problem,
    chain_of,
    log_weights,
    shaped_at,
)
from ccd_casadi.fixed_structure.peak_search import closed_on_zero, frequency_grid
from ccd_casadi.fixed_structure.structure import (
    response,
    response_and_slope,
    response_and_slopes,
    roots,
)
from ccd_casadi.support.arrays import Array

RELEVANT = -1.0  # ln of the share of its bound under which a peak is none of ours
HALF_POWER = 0.5 * np.log(2.0)
OF_S = (Curve.S_MAX, Curve.LEVEL, Curve.SHAPE, Curve.S_LOW, Curve.CROSSING, Curve.GS)


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
    v, regular = frequency_grid(problem, roots(problem.structure, kappa), poles)
    P, k = v.shape
    which = np.broadcast_to(np.arange(P)[:, None], v.shape)
    loops = evaluate(problem, kappa, tau, which, v, order=0)
    found, near = [], []
    crossing = float(problem.plants.variable(np.array([np.exp(tau)]))[0])
    for curve in problem.curves:
        value = loops.levels[curve]
        short = problem.ends_at_crossing(curve)
        if short:
            value = np.where(v <= crossing, value, -np.inf)
        left, right = np.full((2, P, k), -np.inf)
        left[:, 1:], right[:, :-1] = value[:, :-1], value[:, 1:]
        rows, at = np.nonzero((value > depth) & (value >= left) & (value > right))
        low, high = v[rows, np.maximum(at - 1, 0)], v[rows, np.minimum(at + 1, k - 1)]
        if short:
            high = np.minimum(high, crossing)
        found.append((np.full(len(rows), curve), rows, v[rows, at], low, high))
        rows, at = np.nonzero(regular & (value > -within))
        near.append((np.full(len(rows), curve), rows, v[rows, at]))
    kind, rows, start, low, high = (np.concatenate(part) for part in zip(*found, strict=True))
    top, closed = _closed(problem, kappa, tau, kind, rows, start, low, high)
    # An open end at ω_b is the crossing; one at the lowest frequency is a row of its own.
    ending = [curve for curve in problem.curves if problem.ends_at_crossing(curve)]
    whole = closed | ~np.isin(kind, ending) | (start < 0.1 * crossing)
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
    of_s = np.isin(curve, OF_S)
    factor = np.where(of_s, -T, loops.S)
    to_kappa = (factor[:, None] * loops.to_kappa).real
    to_tau[curve == Curve.SHAPE] = 1.0
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
                Curve.LEVEL: ln_S + HALF_POWER,
            }
            if bounds.shape is not None:
                under = np.log(bounds.shape * shaped) - tau
                levels[Curve.SHAPE] = ln_S + HALF_POWER - under
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
            gradients = dict.fromkeys(
                (Curve.S_MAX, Curve.S_LOW, Curve.CROSSING, Curve.LEVEL), slope
            )
            gradients[Curve.SHAPE] = slope - (shaped == omega) * chain
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
