"""Searches of controllers of fixed structure that are kept in the store of samples.

A run that resumes from its store repeats none: the search at the start, multi-start searches at the
ends, and the values of samples with their designs.
"""

from dataclasses import dataclass, replace
from functools import partial

from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import (
    Scenario,
    state_of,
    with_state,
    with_warm_start,
)
from ccd_casadi.inner_problem.structured_bandwidth import (
    ProblemAt,
    StructuredValue,
    structured_value,
)
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_search import (
    least_from,
    prepare_search,
    search_starts,
    with_range,
)
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.structured_units import from_controller
from ccd_casadi.sampling.units import problem_hash, sample_key
from ccd_casadi.support.terminal import Log, remark


@dataclass(frozen=True)
class InitialSearch:
    """Warm starts (κ in SI: `anchors`) and plants (`members`) of the search at the start, by the
    names that stores use; `words`: why there are none. `bandwidth` in rad/s of the controller that
    was found at the start, which a store of an earlier version has not."""

    anchors: tuple[tuple[float, ...], ...]
    members: tuple[Scenario, ...]
    error_anchors: tuple[tuple[float, ...], ...]
    words: str
    bandwidth: float | None = None


def with_initial_search(sampler: Sampler, seed: int) -> tuple[CoDesignProblem, str]:
    """Warm starts and plants, from the store where an earlier run has found them.

    Second, in words, why there are no warm starts; empty where there are.
    """
    problem = with_range(with_state(sampler.problem, seed=seed))
    owner = problem_hash({"seeds": problem.identity(), "inner": problem.inner_identity()})

    def searched() -> InitialSearch:
        log = printer("search at the start", sampler.quiet)
        anchored, made, _ = prepare_search(problem, log, sampler.workers)
        anchored, made, _ = least_from(anchored, problem.start, made, log, sampler.workers)
        own, start = state_of(anchored), problem.start
        words = "" if made.certified else made.words
        alone = len(own.scenarios) == len(uncertain_plant(problem, start).corners())
        if made.certified and alone and problem.figure is BANDWIDTH:
            # No plant was found worse: this is the search that an end at the start needs.
            make = partial(ProblemAt(anchored, start).value_of, made, 1)
            sampler.of(anchored).recall("race", start, StructuredValue, make)
        bandwidth = made.bandwidth if made.certified else None
        return InitialSearch(
            own.warm_starts, own.scenarios, own.error_warm_starts, words, bandwidth
        )

    key = sample_key(owner, problem.start)
    found = sampler.store.recall(key, owner, problem.start, InitialSearch, searched)
    sampler.bandwidth_at_start = found.bandwidth
    known = {"warm_starts": found.anchors, "error_warm_starts": found.error_anchors}
    return with_state(problem, **known, scenarios=found.members), found.words


def multistart_at(sampler: Sampler, best: InnerSample) -> StructuredValue:
    """A multi-start search at the θ of a sample, from its controller too; stored, and counted.

    Parameters
    ----------
    sampler : Sampler
        Of the problem.
    best : InnerSample
        With θ and κ, SI.

    Returns
    -------
    StructuredValue
        With all local optima of its design.
    """
    problem, theta = sampler.problem, best.theta
    if best.kappa:
        problem = with_warm_start(problem, best.kappa)

    def multistart() -> StructuredValue:
        made = search_starts(
            problem, theta, printer("search at the end", sampler.quiet), sampler.workers
        )
        found = ProblemAt(problem, theta).value_of(made, 1, workers=sampler.workers)
        return replace(found, design=replace(found.design, local_optima=made.local_optima))

    sampler.count_multistart(sample_key(sampler.hash, theta))
    return sampler.recall("race", theta, StructuredValue, multistart)


def value_with_design(sampler: Sampler, best: InnerSample) -> StructuredValue:
    """A sample with its design and envelope, from the store where it was made before.

    Parameters
    ----------
    sampler : Sampler
        Of the problem.
    best : InnerSample
        With θ and κ, SI.

    Returns
    -------
    StructuredValue
        The value at θ from its κ, or from warm starts where it has none.
    """
    problem = from_controller(sampler.problem, best.kappa) if best.kappa else sampler.problem
    make = partial(structured_value, problem, best.theta, sampler.workers)
    return sampler.of(problem).recall("value", best.theta, StructuredValue, make)


def printer(label: str, quiet: bool) -> Log:
    """Lines of progress on stderr."""
    return lambda words: remark(f"{label}: {words}", quiet)
