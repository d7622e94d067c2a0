"""The outer problem from a formulation to a verified design, with a check of the whole box."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from ccd_casadi.codesign.formulations import Direct, Formulation
from ccd_casadi.codesign.gaussian_processes import surrogate_quality
from ccd_casadi.codesign.outer import Outer, OuterSearch, Place, PolishedDesign, is_expensive
from ccd_casadi.codesign.outer_problem import FormulationResult, GlobalCheck, RunTerms
from ccd_casadi.codesign.result import infeasible_dict, predicted_value, result_dict
from ccd_casadi.codesign.result_entries import start_entry
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.objective import objective_of, violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import NoDesign
from ccd_casadi.support.time_budget import StageOptions, ends_early, stage, time_is_up
from surrogates import design
from surrogates.fitting import recalibrate


@dataclass(frozen=True)
class GlobalCheckOptions:
    """Numbers of the global check over the box; lengths are shares of the box of θ."""

    points_per_start: int = 8  # for every local solve: each costs as much as an inner problem
    expensive_points: int = 8  # at most where each takes a search over the controller
    better: float = 1e-6  # relative: a J that is lower by less is the same optimum
    nearly: float = (
        0.03  # relative: an end of a range that is worse by less may lead to a better one
    )
    cluster: float = 0.02  # inner problems that are closer count once
    same: float = 1e-3  # a point this close to the optimum starts nothing new
    perturbation: float = (
        0.02  # standard deviation of starts around an optimum that is not stationary
    )
    perturbed_starts: int = 4


def global_check(
    outer: OuterSearch,
    end: PolishedDesign,
    points: int,
    seed: int,
    options: GlobalCheckOptions = GlobalCheckOptions(),
) -> GlobalCheck:
    """Evaluate `points` θ over the box for a J lower than that of an end.

    What the run has solved itself counts among the points. Where these are expensive only a few
    are added, away from what is known: the way to one optimum says nothing of another.
    """
    problem, J, here = outer.problem, end.objective, outer.theta_of(end.x)
    points = 0 if ends_early("global check") else points
    if not outer.global_check_is_cheap:
        points = min(points, options.expensive_points)
    samples, fresh = _spread(outer, points, seed, options.cluster) if points else ([], 0)
    able = [sample for sample in samples if np.isfinite(objective_of(problem, sample))]
    values = np.array([objective_of(problem, sample) for sample in able])
    margin = options.better * abs(J) if np.isfinite(J) else 0.0
    best_x, best, started = None, J, 0
    stationary = np.isfinite(J) and end.kkt.stationarity <= outer.kkt_level
    known = [Place(end.x, J, bool(stationary))]

    def solve_from(starts: Sequence[InnerSample]) -> None:
        nonlocal best_x, best, started
        for sample in starts:
            if ends_early("local solve"):
                continue
            started += 1
            place = outer.local_solve(sample, known)
            if place is not None:
                known.append(place)
                if place.objective < best - margin:
                    best_x, best = place.x, place.objective

    lowest, others = _starts(problem, able, values, here, options.same)
    starts = [*lowest, *others] if outer.global_check_is_cheap else lowest
    if outer.global_check_is_cheap or is_expensive(problem):
        starts = starts[: -(-points // options.points_per_start)]
    solve_from(starts)
    ends = _ends(problem, here if best_x is None else outer.theta_of(best_x), options.same)
    if len(ends) and np.isfinite(best) and 2 * len(ends) <= points:
        room = 0.0 if is_expensive(problem) else options.nearly * abs(best)
        least = np.inf if outer.global_check_is_cheap else best + room
        ends = outer.promising(ends, least)
        found = outer.sampler.values(ends, "search from the ends of each parameter")
        solve_from([sample for sample in found if objective_of(problem, sample) < least])
    return GlobalCheck(
        points=len(samples),
        fresh=fresh,
        feasible=len(able),
        better=int((values < J - margin).sum()),
        starts=started,
        seed=seed,
        before=J,
        after=best,
        x=best_x,
    )


def _ends(problem: CoDesignProblem, theta: Array, same: float) -> Array:
    """θ (k, n_θ) with one parameter at a time at an end of its range, where it is not there yet."""
    lower, upper = box(problem)
    found = [
        np.where(np.arange(len(theta)) == i, end, theta)
        for i in range(len(theta))
        for end in (lower[i], upper[i])
        if abs(end - theta[i]) > same * (upper[i] - lower[i])
    ]
    allowed = [x for x in found if not violations(problem, x)]
    return np.array(allowed).reshape(-1, len(theta))


def solve_perturbed(
    outer: OuterSearch, x: Array, seed: int, options: GlobalCheckOptions = GlobalCheckOptions()
) -> list[Array]:
    """Ends of local solves from a few starts around x: the last try where x is not stationary."""
    here, bounds = outer.theta_of(x), box(outer.problem)
    found = []
    shape = options.perturbed_starts, here.size
    for step in np.random.default_rng(seed).normal(0.0, options.perturbation, shape):
        theta = np.clip(here + step * bounds.width, *bounds)
        sample = outer.sampler.values(theta, "perturbed starts")[0]
        place = outer.local_solve(sample, (), 1e-13) if sample.feasible else None
        if place is not None:
            found.append(place.x)
    return found


def _spread(
    outer: OuterSearch, points: int, seed: int, cluster: float
) -> tuple[list[InnerSample], int]:
    """The inner problems that the run has solved, and as many more as make up `points`; where these
    are expensive, those of a spread set that none is near. Second, how many these are."""
    sampler, bounds = outer.sampler, box(outer.problem)
    known: list[InnerSample] = []
    for sample in sampler.solved.values():
        if all(bounds.away(sample.theta, one.theta) > cluster for one in known):
            known.append(sample)
    spread = design("sobol", *bounds, points, seed)
    if outer.global_check_is_cheap:
        spread = spread[len(known) :]
    else:
        n = spread.shape[1]
        solved = np.reshape([one.theta for one in known], (-1, n))
        away = bounds.away(spread[:, None], solved)
        spread = spread[(away > 0.5 * points ** (-1.0 / n)).all(axis=1)]
    free = [theta for theta in spread if not violations(outer.problem, theta)]
    more: list[InnerSample] = []
    if free:
        found = sampler.values(np.array(free), "global check")
        more = [one for one in found if one.searched]
    return [*known, *more], len(more)


def _starts(
    problem: CoDesignProblem,
    samples: Sequence[InnerSample],
    values: Array,
    theta: Array,
    same: float = GlobalCheckOptions().same,
) -> tuple[list[InnerSample], list[InnerSample]]:
    """Samples with a lower J than their n_θ + 1 nearest neighbours, and the rest; away from θ, the
    best first."""
    if not samples:
        return [], []
    bounds, thetas = box(problem), np.array([sample.theta for sample in samples])
    lowest: list[InnerSample] = []
    others: list[InnerSample] = []
    for i in np.argsort(values):
        near = np.argsort(bounds.away(thetas, thetas[i]))[1 : theta.size + 2]
        if bounds.away(thetas[i], theta) > same:
            (lowest if (values[near] >= values[i]).all() else others).append(samples[i])
    return lowest, others


@dataclass(frozen=True)
class SearchResult:
    """The end of a search: `end` None where no design was found; `outer` as it is by then."""

    outer: Outer
    outcome: FormulationResult
    end: PolishedDesign | None
    rounds: int = 1
    global_check: GlobalCheck | None = None


def search_outer(
    outer: Outer, formulation: Formulation, seed: int, known: Array | None = None, most: int = 3,
    ending: float = StageOptions.ending,
) -> SearchResult:  # fmt: skip
    """Formulation and polish, again with what the inner problem at the end has found better: `most`
    rounds.

    `known`: x of a local optimum that another search has found, in place of the formulation;
    `ending`: share of the budget until which ends are polished.
    """
    outer = outer.prepare(seed)
    end: PolishedDesign | None = None
    global_check: GlobalCheck | None = None
    for rounds in count(1):
        outcome = FormulationResult(known, agreed=True)
        if known is None:
            outcome = outer.solve_formulation(formulation, seed)
        if outcome.x is None:
            outcome = outer.fallback(outcome, seed)
        if outcome.x is None and time_is_up():
            outcome = replace(outcome, x=_at_hand(outer, end))
        if outcome.x is None:
            return SearchResult(outer, outcome, None, rounds)
        with stage(ending):
            try:
                end = outer.polish(outcome.x)
            except NoDesign as error:
                if end is None:
                    return SearchResult(outer, FormulationResult(message=str(error)), None, rounds)
                break
            # of a design that exceeds a bound on a plant nothing is gained, whatever the time
            last = rounds >= (2 * most if time_is_up() else most)
            more = None if last else outer.add_exceeding_plants(end)
        if more is None:
            outcome, found, global_check = _after_global_check(
                outer, outcome, end, formulation, seed
            )
            moved = found is not end and rounds < most
            more, end = outer.add_exceeding_plants(found) if moved else None, found
        if more is None:
            break
        goes_on = known is not None or isinstance(formulation, Direct) or time_is_up()
        outer, known = more, end.x if goes_on else None
    return SearchResult(outer, outcome, end, rounds, global_check)


def _at_hand(outer: OuterSearch, end: PolishedDesign | None) -> Array | None:
    """x where the time is up and a formulation has none: of an end before, else the start."""
    if end is not None or violations(outer.problem, outer.problem.start):
        return None if end is None else end.x
    with stage(StageOptions.ending):
        sample = outer.sampler.values(np.array(outer.problem.start), "at the start")[0]
    return sample.joint if sample.feasible else None


def _after_global_check(
    outer: OuterSearch,
    outcome: FormulationResult,
    end: PolishedDesign,
    formulation: Formulation,
    seed: int,
) -> tuple[FormulationResult, PolishedDesign, GlobalCheck]:
    """After the global check over the box, and a last try where the end is not stationary."""
    with outer.sampler.spent.on("box_look"):
        checked = global_check(outer, end, formulation.box_points, seed)
    if checked.x is not None:
        with stage(StageOptions.ending), suppress(NoDesign):
            found = outer.polish(checked.x)
            end = best_end([end, found], outer.kkt_level, formulation.tolerance)
    residual = end.kkt.stationarity
    retried = outer.retries_pay and np.isfinite(residual) and residual > outer.kkt_level
    if retried and not ends_early("perturbed start", GlobalCheckOptions.perturbed_starts):
        with outer.sampler.spent.on("polish"):
            starts = solve_perturbed(outer, end.x, seed)
        ends = [end]
        for x in starts:
            with suppress(NoDesign):
                ends.append(outer.polish(x))
        end = best_end(ends, outer.kkt_level, formulation.tolerance)
    learns = not isinstance(formulation, Direct) and formulation.max_refinements > 0
    if learns and end.feasible:
        foreseen = predicted_value(outcome, end.x, end.value)
        if abs(foreseen / end.value - 1.0) > formulation.tolerance:
            learnt = outer.with_training_sample(outcome, end)
            outcome = replace(learnt, foreseen=foreseen)  # the error that is reported
    return outcome, end, checked


def best_end(ends: Sequence[PolishedDesign], level: float, tolerance: float) -> PolishedDesign:
    """The least J of those that are feasible; within the tolerance of it one that is stationary.

    A better design that is not stationary is kept: to call a worse one optimal would be untrue.
    """
    least = min(item.objective for item in ends)
    if not np.isfinite(least):
        return ends[0]
    near = [item for item in ends if item.objective <= least + tolerance * abs(least)]
    stationary = [item for item in near if item.kkt.stationarity <= level]
    return min(stationary or near, key=lambda item: item.objective)


def conclude(search: SearchResult, terms: RunTerms) -> Solution:
    """The design judged, and result.json."""
    outcome, sampler = search.outcome, search.outer.sampler
    spent = sampler.spent
    if search.end is None:
        return Solution(infeasible_dict(terms, outcome.message, spent.by_purpose), outcome, None)
    with spent.on("checks"), stage(StageOptions.ending):
        verified = search.outer.verify(search.end, search.rounds)
    surrogates = tuple(recalibrate(process, terms.seed) for process in outcome.surrogates)
    outcome = replace(outcome, surrogates=surrogates)
    quality = surrogate_quality(outcome.surrogates, verified, quiet=sampler.quiet)
    result = result_dict(terms, outcome, verified, spent.by_purpose, quality, search.global_check)
    result["start"] = start_entry(sampler)
    return Solution(result, outcome, verified, quality)


def conclude_at(outer: Outer, outcome: FormulationResult, terms: RunTerms) -> Solution:
    """An outcome polished and judged as it is, without a global check over the box."""
    end = None if outcome.x is None else outer.polish(outcome.x)
    return conclude(SearchResult(outer, outcome, end), terms)
