"""What each tolerance costs: ω_b at other widths, from re-solves; and widths as variables.

A tolerance t at θ with f(t) = ω_b*(θ; t): it costs f(0) - f(t), and half of it buys f(t/2) - f(t).
Each f is a design of its own, from the run's controller, on its own worst plants. The multipliers
give only the slope df/d ln t at t; between 0 and t the active plants change, so the slope is listed
beside the re-solves and is not the price.

As variables the half-widths t lie between bounds, with machine and controller:

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
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import with_state
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import Uncertainty, structured_of, with_structured
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import silent
from ccd_casadi.support.text import HZ, number

SHARES = ("resonance_shift", "mode_shift", "gain")  # half-widths as shares


@dataclass(frozen=True)
class Price:
    """The price of one tolerance, in rad/s."""

    name: str  # of the tolerance
    width: str  # how wide it is, in words
    cost: float  # ω_b without it, less ω_b with it
    half_buys: float  # ω_b with half of it, less ω_b with it
    slope: float  # -dω_b/d ln t by the multipliers; NaN where they are not known

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of tolerances.json."""
        hz = {"costs_hz": self.cost, "half_buys_hz": self.half_buys, "slope_hz": self.slope}
        found = {key: w / HZ for key, w in hz.items()}
        return {"tolerance": self.name, "width": self.width, **found}

    @property
    def words(self) -> str:
        """The price in one line."""
        cost, buys = number(self.cost / HZ, 3), number(self.half_buys / HZ, 3)
        return f"{self.name} {self.width}: costs {cost} Hz; half of it buys {buys} Hz"


def tolerances_of(problem: CoDesignProblem) -> tuple[str, ...]:
    """The names of a problem's tolerances, modes together."""
    names = uncertain_plant(problem, problem.start).names
    return tuple(dict.fromkeys(map(tolerance_of, names)))


def scale_width(problem: CoDesignProblem, name: str, factor: float) -> CoDesignProblem:
    """Scale the width of one tolerance around the model; damping in its logarithm."""
    own: Uncertainty = structured_of(problem).uncertainty
    if name in SHARES:
        changed = replace(own, **{name: factor * getattr(own, name)})
    elif name == "damping":
        low, high = own.damping
        changed = replace(own, damping=(low**factor, high**factor))
    else:
        held = problem.source.held

        def around(key: str, low: float, high: float) -> tuple[str, float, float]:
            if f"theta.{key}" != name:
                return key, low, high
            model = held[key]
            return key, model + factor * (low - model), model + factor * (high - model)

        changed = replace(own, ranges=tuple(around(*each) for each in own.ranges if factor
                                            or f"theta.{each[0]}" != name))  # fmt: skip
    return with_structured(problem, uncertainty=changed)


def width_words(problem: CoDesignProblem, name: str) -> str:
    """Describe how wide a tolerance is."""
    own = structured_of(problem).uncertainty
    if name in SHARES:
        return f"±{100.0 * getattr(own, name):g} %"
    ends = {"damping": own.damping} | {f"theta.{key}": ends for key, *ends in own.ranges}
    low, high = ends[name]
    return f"{low:g} to {high:g}"


def redesign(
    problem: CoDesignProblem, theta: Sequence[float], kappa: Array, workers: Pool | None = None
) -> tuple[CoDesignProblem, SectionsDesign]:
    """The best from a controller at θ on the worst plants of the problem's own box: the problem at
    θ with these plants, and the design."""
    at = replace(problem, start=tuple(map(float, theta)))
    at = with_state(at, warm_starts=(tuple(map(float, kappa)),), scenarios=())
    found, made, _ = prepare_search(at, silent, workers, only_warm_starts=True)
    return found, made


def prices(
    problem: CoDesignProblem, theta: Sequence[float], kappa: Array, workers: Pool | None,
    log: Callable[[str], object],
) -> tuple[float, tuple[Price, ...]]:  # fmt: skip
    """Price every tolerance of a design.

    Parameters
    ----------
    problem, theta, kappa : CoDesignProblem, sequence of float, array
        Of a finished run, SI.
    workers, log : Pool or None, callable

    Returns
    -------
    bandwidth : float
        ω_b of the design with all of them, rad/s.
    prices : tuple of Price
    """
    own, made = redesign(problem, theta, kappa, workers)
    slopes = DesignOnBox(own, theta, made).tolerance_prices()

    def at(name: str, factor: float) -> float:
        _, found = redesign(scale_width(problem, name, factor), theta, made.kappa, workers)
        log(f"{name} times {factor:g}: {found.bandwidth / HZ:.5g} Hz")
        # the design of the wider set is one of the narrower set, whatever the search found
        return max(found.bandwidth if found.certified else 0.0, made.bandwidth)

    found = []
    for name in tolerances_of(problem):
        known = [w for key, w in slopes.items() if tolerance_of(key) == name]
        found.append(Price(
            name, width_words(problem, name),
            at(name, 0.0) - made.bandwidth, at(name, 0.5) - made.bandwidth,
            -sum(known) if known else np.nan,
        ))  # fmt: skip
    return made.bandwidth, tuple(found)


@dataclass(frozen=True)
class WidthOptions:
    """Numbers of the search over half-widths."""

    evaluations: int = 15  # at most, before the corners
    corners: int = 8  # of the bounds, that are evaluated where there are no more
    settled: float = 1e-4  # relative change of J that ends it
    polish: float = 1e-5  # of J: steps over θ that promise less are not taken
    usual: tuple[float, float] = (0.25, 2.0)  # bounds of a half-width over the case's


@dataclass(frozen=True)
class Bought:
    """A machine, its controller and its tolerances."""

    widths: Mapping[str, float]  # half-widths by name, as shares
    theta: tuple[float, ...]  # SI
    kappa: Array  # SI
    bandwidth: float  # rad/s
    objective: float  # J with what the tolerances cost
    slopes: Mapping[str, float]  # ∂J/∂ln t; none where the multipliers are not known


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
    own, made = redesign(wide, near.theta, near.kappa, sampler.workers)
    if not made.certified:
        return None
    there = sampler.of(own)
    start = there.value_from(near.theta, made.kappa.tolist())
    theta = pieces_from(there, start, options.polish).theta if start.feasible else near.theta
    if theta != near.theta:  # whose worst plants are others
        moved = redesign(wide, theta, made.kappa, sampler.workers)
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
    between: Mapping[str, Sequence[float]], log: Callable[[Bought], object],
    options: WidthOptions = WidthOptions(),
) -> WidthSearch | None:  # fmt: skip
    """Search half-widths, machine and controller together, from θ and κ of a finished run, SI.

    `costs` are what f rises by for a percent, `between` the least and largest half-width, both by
    name; `log` is given every design. None where the run's design is not found again.
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
    log(first)
    best, count = first, 1

    def J(u: Array) -> tuple[float, Array]:
        nonlocal best, count
        widths = dict(zip(costs, np.exp(u).tolist(), strict=True))
        found = first if np.array_equal(u, start_at) else at(widths, near=best)
        if found is None:  # worse than all: a line search turns back
            return 2.0 * abs(first.objective) + first.objective, np.zeros(len(u))
        if found is not first:
            count += 1
            log(found)
        best = min(best, found, key=lambda one: one.objective)
        return found.objective, np.array([found.slopes.get(name, 0.0) for name in costs])

    start_at = np.log([case[name] for name in costs])
    limits = {"maxfun": options.evaluations, "ftol": options.settled}
    minimize(J, start_at, jac=True, bounds=bounds, method="L-BFGS-B", options=limits)
    if 2 ** len(bounds) <= options.corners:
        for corner in product(*bounds.tolist()):
            J(np.array(corner))
    return WidthSearch(best, first, count, promised_gain(best, costs, bounds))


def promised_gain(best: Bought, costs: Mapping[str, float], bounds: Array) -> float:
    """Compute what the slopes promise from a design up to the bounds (n, 2) of ln t: at least as
    much as J can fall where it is convex in ln t."""
    if set(best.slopes) != set(costs):
        return np.nan
    u = np.log([best.widths[name] for name in costs])
    slopes = np.array([best.slopes[name] for name in costs])[:, None]
    return float(np.maximum((-slopes * (bounds - u[:, None])).max(axis=1), 0.0).sum())
