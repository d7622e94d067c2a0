"""The outer problem from a formulation to a verified design, for every kind of controller.

A formulation, a polish of its end on the truth and the whole inner problem there; where that finds
better the search begins anew with it. Then a global check over the box, and on from what is better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from ccd_casadi.codesign.formulation import FormulationResult, GlobalCheck, Terms
from ccd_casadi.codesign.formulations import Direct, Formulation
from ccd_casadi.codesign.gaussian_processes import surrogate_quality
from ccd_casadi.codesign.global_check import global_check, perturbed
from ccd_casadi.codesign.outer import End, Outer
from ccd_casadi.codesign.result import infeasible_dict, predicted_value, result_dict
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.support.arrays import Array
from surrogates.fitting import recalibrated

AGAIN = 3  # times at most that a search begins with what the inner problem has found better


@dataclass(frozen=True)
class SearchResult:
    """What a search ends with: `end` None where no design was found; `outer` as it is by then."""

    outer: Outer
    outcome: FormulationResult
    end: End | None
    rounds: int = 1
    look: GlobalCheck | None = None


def search_outer(
    outer: Outer, formulation: Formulation, seed: int, known: Array | None = None
) -> SearchResult:
    """Formulation and polish, again with what the inner problem at the end has found better.

    `known`: x of a local optimum that another search has found, in place of the formulation.
    """
    outer = outer.prepared(seed)
    for rounds in count(1):
        outcome = FormulationResult(known, agreed=True)
        if known is None:
            outcome = outer.solve_formulation(formulation, seed)
        if outcome.x is None:
            outcome = outer.fallback(outcome, seed)
        if outcome.x is None:
            return SearchResult(outer, outcome, None, rounds)
        end = outer.polished(outcome.x)
        more = None if rounds == AGAIN else outer.extended(end)
        if more is None:
            outcome, found, look = _looked(outer, outcome, end, formulation, seed)
            moved = found is not end and rounds < AGAIN
            more, end = outer.extended(found) if moved else None, found
        if more is None:
            break
        goes_on = known is not None or isinstance(formulation, Direct)
        outer, known = more, end.x if goes_on else None
    return SearchResult(outer, outcome, end, rounds, look)


def _looked(
    outer: Outer, outcome: FormulationResult, end: End, formulation: Formulation, seed: int
) -> tuple[FormulationResult, End, GlobalCheck]:
    """After the global check over the box, and a last try where the end is not stationary."""
    with outer.sampler.spent.on("box_look"):
        look = global_check(outer, end, formulation.box_points, seed)
    if look.x is not None:
        end = best_end([end, outer.polished(look.x)], outer.kkt_level, formulation.tolerance)
    residual = end.kkt.stationarity
    if outer.retries_pay and np.isfinite(residual) and residual > outer.kkt_level:
        with outer.sampler.spent.on("polish"):
            starts = perturbed(outer, end.x, seed)
        ends = [end, *map(outer.polished, starts)]
        end = best_end(ends, outer.kkt_level, formulation.tolerance)
    learns = not isinstance(formulation, Direct) and formulation.max_refinements > 0
    if learns and end.feasible:
        foreseen = predicted_value(outcome, end.x, end.value)
        if abs(foreseen / end.value - 1.0) > formulation.tolerance:
            learnt = outer.with_training_sample(outcome, end)
            outcome = replace(learnt, foreseen=foreseen)  # the error that is reported
    return outcome, end, look


def best_end(ends: Sequence[End], level: float, tolerance: float) -> End:
    """The least J of those that are feasible; within the tolerance of it one that is stationary.

    A better design that is not stationary is kept: to call a worse one optimal would be untrue.
    """
    least = min(item.objective for item in ends)
    if not np.isfinite(least):
        return ends[0]
    near = [item for item in ends if item.objective <= least + tolerance * abs(least)]
    stationary = [item for item in near if item.kkt.stationarity <= level]
    return min(stationary or near, key=lambda item: item.objective)


def conclude(search: SearchResult, terms: Terms) -> Solution:
    """The design judged, and result.json."""
    outcome, sampler = search.outcome, search.outer.sampler
    spent = sampler.spent
    if search.end is None:
        return Solution(infeasible_dict(terms, outcome.message, spent.by_purpose), outcome, None)
    with spent.on("checks"):
        verified = search.outer.verified(search.end, search.rounds)
    surrogates = tuple(recalibrated(process, terms.seed) for process in outcome.surrogates)
    outcome = replace(outcome, surrogates=surrogates)
    quality = surrogate_quality(outcome.surrogates, verified, quiet=sampler.quiet)
    result = result_dict(terms, outcome, verified, spent.by_purpose, quality, search.look)
    return Solution(result, outcome, verified, quality)


def conclude_at(outer: Outer, outcome: FormulationResult, terms: Terms) -> Solution:
    """An outcome polished and judged as it is, without a global check over the box."""
    end = None if outcome.x is None else outer.polished(outcome.x)
    return conclude(SearchResult(outer, outcome, end), terms)
