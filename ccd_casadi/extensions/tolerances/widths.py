"""Tolerances as variables: the half-widths t between bounds, with machine and controller.

    min over t of J(t) = min over θ of w1 (f(θ) + Σ c_i 100 (t_i⁰ - t_i)) + w2 ω_b*(θ; t)

t⁰ are the case's half-widths as shares, c_i what f rises by for a percent. An outer search by
L-BFGS-B over ln t, with few evaluations: each moves θ from the best before, and has the slopes

    ∂J/∂ln t_i = -100 w1 c_i t_i + w2 ∂ω_b*/∂ln t_i

by the multipliers (the envelope theorem: θ and controller are optimal). ω_b* is often almost linear
in t, and the optimum then at a corner of the bounds, of which few are evaluated too. What the
slopes promise up to the bounds is the gap of a convex J; J need not be convex, and the local optima
over θ are not searched anew.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ccd_casadi.codesign.outer import pieces_from
from ccd_casadi.extensions.tolerances.machines import tolerance_of
from ccd_casadi.extensions.tolerances.prices import redesigned
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.structured_problem import structured_of, with_structured
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class WidthOptions:
    """Numbers of the search over half-widths.

    Attributes
    ----------
    evaluations : int
        At most, before the corners.
    corners : int
        Of the bounds, that are evaluated where there are no more.
    settled : float
        Relative change of J that ends it.
    polish : float
        Of J: steps over θ that promise less are not taken.
    usual : tuple of float
        Bounds of a half-width over the case's, where it has none.
    """

    evaluations: int = 15
    corners: int = 8
    settled: float = 1e-4
    polish: float = 1e-5
    usual: tuple[float, float] = (0.25, 2.0)


@dataclass(frozen=True)
class Bought:
    """A machine, its controller and its tolerances.

    Attributes
    ----------
    widths : mapping
        Half-widths by name, as shares.
    theta, kappa : tuple of float, array
        SI.
    bandwidth, objective : float
        rad/s; J with what the tolerances cost.
    slopes : mapping
        ∂J/∂ln t; none where the multipliers are not known.
    """

    widths: Mapping[str, float]
    theta: tuple[float, ...]
    kappa: Array
    bandwidth: float
    objective: float
    slopes: Mapping[str, float]


@dataclass(frozen=True)
class WidthSearch:
    """The best that was found, the design with the case's widths, how many were evaluated, and what
    the slopes at the best promise up to the bounds, in units of J (NaN: not known)."""

    best: Bought
    first: Bought
    evaluations: int
    gap: float


def bought(
    sampler: Sampler, widths: Mapping[str, float], costs: Mapping[str, float], near: Bought,
    options: WidthOptions = WidthOptions(),
) -> Bought | None:  # fmt: skip
    """The best machine and controller near another one, with these half-widths (shares) and costs
    (per percent); None where no controller is certified."""
    case, problem = structured_of(sampler.problem).uncertainty, sampler.problem
    changed: dict[str, Any] = dict(widths)
    wide = with_structured(problem, uncertainty=replace(case, **changed))
    own, made = redesigned(wide, near.theta, near.kappa, sampler.workers)
    if not made.certified:
        return None
    there = sampler.of(own)
    start = there.value_from(near.theta, made.kappa.tolist())
    theta = pieces_from(there, start, options.polish).theta if start.feasible else near.theta
    if theta != near.theta:  # whose worst plants are others
        moved = redesigned(wide, theta, made.kappa, sampler.workers)
        if not moved[1].certified:
            theta = near.theta
        else:
            own, made = moved
    spent = sum(100.0 * cost * (getattr(case, name) - widths[name])
                for name, cost in costs.items())  # fmt: skip
    J = objective(problem, theta, made.bandwidth) + problem.w1 * spent
    found: dict[str, float] = {}
    for key, slope in DesignOnBox(own, theta, made).tolerance_prices().items():
        found[tolerance_of(key)] = found.get(tolerance_of(key), 0.0) + slope
    slopes = {name: problem.w2 * found[name] - 100.0 * problem.w1 * cost * widths[name]
              for name, cost in costs.items() if name in found}  # fmt: skip
    return Bought(dict(widths), tuple(theta), made.kappa, made.bandwidth, J, slopes)


def buy(
    sampler: Sampler, theta: Sequence[float], kappa: Array, costs: Mapping[str, float],
    between: Mapping[str, Sequence[float]], tell: Callable[[Bought], object],
    options: WidthOptions = WidthOptions(),
) -> WidthSearch | None:  # fmt: skip
    """Search half-widths, machine and controller together.

    Parameters
    ----------
    sampler : Sampler
        Of a case's problem.
    theta, kappa : sequence of float, array
        Of a finished run, SI.
    costs, between : mapping
        What f rises by for a percent, by name; least and largest half-width.
    tell : callable
        Is given every design.
    options : WidthOptions

    Returns
    -------
    WidthSearch or None
        None where the run's design is not found again.
    """
    own = structured_of(sampler.problem).uncertainty
    case = {name: getattr(own, name) for name in costs}
    usual = {name: [factor * case[name] for factor in options.usual] for name in costs}
    bounds = np.log([between.get(name, usual[name]) for name in costs])
    start = Bought(case, tuple(theta), kappa, np.nan, np.nan, {})
    at = partial(bought, sampler, costs=costs, options=options)
    first = at(case, near=start)
    if first is None:
        return None
    tell(first)
    best, count = first, 1

    def J(u: Array) -> tuple[float, Array]:
        nonlocal best, count
        widths = dict(zip(costs, np.exp(u).tolist(), strict=True))
        found = first if np.array_equal(u, start_at) else at(widths, near=best)
        if found is None:  # worse than all: a line search turns back
            return 2.0 * abs(first.objective) + first.objective, np.zeros(len(u))
        if found is not first:
            count += 1
            tell(found)
        best = min(best, found, key=lambda one: one.objective)
        return found.objective, np.array([found.slopes.get(name, 0.0) for name in costs])

    start_at = np.log([case[name] for name in costs])
    limits = {"maxfun": options.evaluations, "ftol": options.settled}
    minimize(J, start_at, jac=True, bounds=bounds, method="L-BFGS-B", options=limits)
    if 2 ** len(bounds) <= options.corners:
        for corner in product(*bounds.tolist()):
            J(np.array(corner))
    return WidthSearch(best, first, count, promised(best, costs, bounds))


def promised(best: Bought, costs: Mapping[str, float], bounds: Array) -> float:
    """What the slopes promise from a design up to the bounds (n, 2) of ln t: at least as much as J
    can fall where it is convex in ln t."""
    if set(best.slopes) != set(costs):
        return np.nan
    u = np.log([best.widths[name] for name in costs])
    slopes = np.array([best.slopes[name] for name in costs])[:, None]
    return float(np.maximum((-slopes * (bounds - u[:, None])).max(axis=1), 0.0).sum())
