"""Every local peak of S, KS, T and GS on every plant against its bound, with exact derivatives.

The constraints are those of `loop_problem`, their peaks those that `peak_search` finds. At a peak
the derivative to κ is that of the curve,

    ∂ln|S| = ∂ln|GS| = -Re(T ∂ln K),   ∂ln|KS| = ∂ln|T| = Re(S ∂ln K)      (κ)
    ∂ln|S| = ∂ln|KS| = -Re(S K ∂G),    ∂ln|T| = Re(S ∂G/G)                 (the plant, so θ)
"""

from collections.abc import Sequence
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
)
from ccd_casadi.fixed_structure.peak_search import CLOSINGS, FLAT, NARROW, frequency_grid
from ccd_casadi.fixed_structure.structure import response, roots
from ccd_casadi.kernels import sections
from ccd_casadi.kernels.sections import HALF_POWER as HALF_POWER
from ccd_casadi.support.arrays import Array

RELEVANT = -1.0  # ln of the share of its bound under which a peak is none of ours
OF_S = (Curve.S_MAX, Curve.LEVEL, Curve.SHAPE, Curve.S_LOW, Curve.CROSSING, Curve.GS)
IS_OF_S = np.isin(list(Curve), OF_S)  # by code


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
    levels = curve_levels(problem, kappa, tau, problem.curves, v)
    found, near = [], []
    crossing = float(problem.plants.variable(np.array([np.exp(tau)]))[0])
    for curve, value in levels.items():
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
    value, slope, S, g = loop_rows(problem, kappa, tau, curve, which, v)
    to_tau = np.where(curve == Curve.SHAPE, 1.0, 0.0)
    end = curve == Curve.CROSSING
    to_tau[end] = (slope / chain_of(problem, v))[end]
    to_kappa = to_parameters(curve, S, g)
    return Constraints(curve, which, v, value + problem.margin, to_kappa, to_tau)


def loop_rows(
    problem: Problem, kappa: Array, tau: float, curve: np.ndarray, which: np.ndarray, v: Array
) -> tuple[Array, Array, np.ndarray, np.ndarray]:
    """Values, slopes to ln v, S, and g = ∂ln K/∂κ (M, n) of these rows."""
    found: tuple[Array, Array, np.ndarray, np.ndarray] = sections.rows(
        curve, problem.factors, np.exp(kappa), *problem.modes, np.ascontiguousarray(which), v,
        problem.limits(tau),
    )  # fmt: skip
    return found


def to_parameters(curve: np.ndarray, S: np.ndarray, g: np.ndarray) -> Array:
    """∂c/∂κ (M, n) at fixed frequencies."""
    factor = np.where(IS_OF_S[curve], S - 1.0, S)
    return np.asarray((factor[:, None] * g).real)


def curve_levels(
    problem: Problem, kappa: Array, tau: float, curves: Sequence[Curve], v: Array
) -> dict[Curve, Array]:
    """The curves of all plants at v (P, k), relative to their bounds; without the margin."""
    codes = np.array(curves, np.int64)
    values = sections.levels(codes, problem.factors, np.exp(kappa), *problem.modes, v,
                             problem.limits(tau))  # fmt: skip
    return dict(zip(curves, values, strict=True))


@singledispatch
def to_theta(problem: LoopProblem, kappa: Array, found: Constraints) -> Array:
    """∂c/∂θ (M, n_θ) at fixed κ and τ."""
    assert isinstance(problem, Problem)
    plants = problem.plants
    count = plants.plants[0].dA.shape[0]
    out = np.zeros((len(found.v), count))
    G = plants.values(found.plant, found.v)
    K_all = response(problem.structure, kappa, 1j * found.v)
    S_all = 1.0 / (1.0 + G * K_all)
    free = plants.values(found.plant, found.v, free=True)
    for i in np.unique(found.plant):
        at = np.flatnonzero(found.plant == i)
        dG = plants.to_theta(int(i), found.v[at])
        S, K = S_all[at][:, None], K_all[at][:, None]
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
    tolerances = (FLAT, NARROW, float(CLOSINGS))
    found: tuple[Array, np.ndarray] = sections.close(
        curve, problem.factors, np.exp(kappa), *problem.modes, which, start, low, high,
        problem.limits(tau), tolerances,
    )  # fmt: skip
    return found
