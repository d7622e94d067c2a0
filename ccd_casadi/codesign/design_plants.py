"""A robust problem once for each plant that its controllers may be made on; the best one is kept.

    min over θ and design plants s of J(θ, s) = min over s of (min over θ of J(θ, s))

Where none of them holds on the whole set, the range is reached by continuation: from the optimum of
the plant alone the set is widened step by step, each design polished on the problem of a wider one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.codesign.kinked import polish
from ccd_casadi.codesign.outer import Outer
from ccd_casadi.codesign.outer_problem import FormulationResult, RunTerms
from ccd_casadi.codesign.outer_search import conclude_at
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.problem import design_choices
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import time_is_up

CONTINUED = "reached by continuation from narrower ranges"
REPORTED = ("status", "objective", "reason", "theta", "bandwidth_hz")  # of each design plant


@dataclass(frozen=True)
class ContinuationOptions:
    """Numbers of the continuation from the plant alone to its set, shares of the range."""

    first_step: float = 0.25
    least_step: float = 1.0 / 16.0  # a smaller one is not tried
    polishes: int = 5  # at most


def widen(
    sampler: Sampler, x: Array, options: ContinuationOptions = ContinuationOptions()
) -> tuple[Array, float]:
    """Widen a design for the plant alone towards the whole set of a problem with one design plant.

    x = (θ, ln ω_S, ln ω_T) and the share of the range held there.
    """
    problem = sampler.problem
    assert problem.robust is not None
    x, held, step = np.asarray(x, float), 0.0, options.first_step
    for _ in range(options.polishes):
        if held >= 1.0 or step < options.least_step:
            break
        share = min(1.0, held + step)
        narrower = replace(problem, robust=problem.robust.scale(share))
        found = polish(sampler.of(narrower, traced=share == 1.0).truth, x)
        if found.acceptable:
            x, held, step = found.x, share, 2.0 * step
        else:
            step *= 0.5
    return x, held


def best_over_design_plants(
    sampler: Sampler,
    outer_of: Callable[[Sampler], Outer],
    solve: Callable[[Outer], Solution],
    terms: RunTerms,
) -> tuple[Solution, float | None]:
    """The best of a robust problem's solutions over its design plants, by `solve` and continuation.

    A problem with one design plant is solved as it is. Returns the part of the set's range, too, up
    to which designs were found where none holds on the whole.
    """
    problem = sampler.problem
    assert problem.robust is not None
    choices = design_choices(problem)
    samplers = [sampler.of(choice) if len(choices) > 1 else sampler for choice in choices]
    found = [solve(outer_of(each)) for each in samplers]
    share = None
    if not any(map(_holds, found)) and not time_is_up():
        share = 0.0
        alone = solve(outer_of(sampler.of(replace(problem, robust=None), traced=False)))
        if alone.verified is not None:
            for i, each in enumerate(samplers):
                x, held = widen(each, alone.verified.point)
                share = max(share, held)
                if held >= 1.0:
                    outcome = FormulationResult(x, agreed=True, message=CONTINUED)
                    there = conclude_at(outer_of(each), outcome, terms)
                    found[i] = min(found[i], there, key=order)
    violation = [np.inf if each.nearest is None else each.nearest.violation for each in samplers]
    best = min(range(len(found)), key=lambda i: (*order(found[i]), violation[i]))
    names = [choice.robust.design_at for choice in choices if choice.robust]
    reported = [{key: item.result[key] for key in REPORTED if key in item.result} for item in found]
    tried = dict(zip(names, reported, strict=True))
    result = found[best].result
    own = result.get("robust", {}) | {"design_at": names[best], "tried": tried}
    sampler.nearest = samplers[best].nearest
    return replace(found[best], result={**result, "robust": own}, problem=choices[best]), share


def _holds(item: Solution) -> bool:
    """Whether the design keeps its constraints on the whole set, whatever else is said of it."""
    checks = item.result.get("checks", {})
    return bool(checks) and all(
        checks.get(name, True)
        for name in ("certificate", "constraints", "judge", "second_engine", "robust")
    )


def order(item: Solution) -> tuple[int, int, float]:
    """Verified first, then what fails the fewest checks, then the least J."""
    result = item.result
    failed = sum(passed is False for passed in result.get("checks", {}).values())
    status = ("verified", "not_verified", "infeasible").index(result["status"])
    return status, failed, result.get("objective", np.inf)
