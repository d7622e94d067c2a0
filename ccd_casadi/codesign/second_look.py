"""After the end of a formulation: verify, look over the box, go on from what is better."""

from dataclasses import replace
from time import perf_counter

import numpy as np

from ccd_casadi.codesign.box_look import BoxLook, look_over_box, perturbed
from ccd_casadi.codesign.direct import Direct
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.formulations import Formulation
from ccd_casadi.codesign.lifted import solve_lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.result import infeasible_dict, predicted_value, result_dict
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.codesign.stored import Surrogates, fitted_quantities
from ccd_casadi.codesign.surrogate_quality import surrogate_quality
from ccd_casadi.codesign.verified_mixed import VerifiedDesign
from ccd_casadi.codesign.verify import verify
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from surrogates import design

MOVED_ROUNDS = 1  # more after a look: local solves on the truth have found what they would look for


def conclude_with_look(
    sampler: Sampler, formulation: Formulation, outcome: FormulationResult, seed: int, began: float
) -> Solution:
    """Verify, look over the box for something better, and go on from there if there is."""
    assert outcome.x is not None
    name = type(formulation).__name__.lower()
    verified = verify(sampler, outcome.x)
    J = verified.objective if verified.feasible else np.inf
    with sampler.spent.on("box_look"):
        points = formulation.box_points
        look = look_over_box(sampler, verified.x, J, points, seed, outcome.surrogates)
    rounds = 0 if isinstance(formulation, Direct) else formulation.max_refinements
    if look.x is not None or (
        len(outcome.iterates) <= rounds
        and _prediction_error(outcome, verified) > formulation.tolerance
    ):
        x, again = verified.x, formulation
        if look.x is not None:
            x = look.x
            if not isinstance(formulation, Direct):
                again = replace(formulation, max_refinements=min(rounds, MOVED_ROUNDS))
        outcome = _resumed(sampler, again, outcome, x, seed)
        ends = [verify(sampler, end) for end in _distinct(x, outcome.x)]
        verified = _best([verified, *ends], formulation.tolerance)
    if verified.kkt.stationarity > verified.kkt_level:
        with sampler.spent.on("polish"):
            starts = perturbed(sampler, verified.x, seed)
        ends = [verify(sampler, end) for end in starts]
        verified = _best([verified, *ends], formulation.tolerance)
        if isinstance(formulation, Direct):  # has no surrogate that could have promised another
            outcome = replace(outcome, x=verified.x, design=sampler.truth.at(verified.x))
    return conclude(sampler, name, outcome, formulation.tolerance, seed, began, verified, look)


def _resumed(
    sampler: Sampler, formulation: Formulation, outcome: FormulationResult, x: Array, seed: int
) -> FormulationResult:
    """Go on from a better design (or the same one, wrongly predicted): the surrogates learn it."""
    if isinstance(formulation, Direct):
        return replace(outcome, x=x, design=sampler.truth.at(x), agreed=True)
    if isinstance(formulation, Nested):
        thetas = np.unique(np.array([*sampler.solved, tuple(x[:-2])]), axis=0)
        found = solve_nested(sampler, formulation, seed=seed, given=Surrogates((), thetas, ()))
    else:
        old = fitted_quantities(outcome.surrogates)
        new = [sample for sample in sampler.quantities(x) if sample.certified]
        samples = tuple({sample.x: sample for sample in (*old, *new)}.values())
        thetas = np.array([sample.x[:-2] for sample in samples])
        processes = outcome.surrogates if old else ()
        given = Surrogates(processes, thetas, samples)
        found = solve_lifted(
            sampler, formulation, seed=seed, given=given, incumbent=new[0] if new else None
        )
    if found.x is None:
        return replace(outcome, x=x, surrogates=found.surrogates or outcome.surrogates)
    return replace(found, iterates=(*outcome.iterates, *found.iterates))


def _prediction_error(outcome: FormulationResult, verified: VerifiedDesign) -> float:
    return abs(predicted_value(outcome, verified) / verified.value - 1.0)


def _distinct(x: Array, other: Array | None) -> list[Array]:
    return [x] if other is None or np.array_equal(x, other) else [x, other]


def _best(found: list[VerifiedDesign], tolerance: float) -> VerifiedDesign:
    """The least J of those that are feasible; within the tolerance of it one that is stationary.

    A better design that is not stationary is kept: to call a worse one optimal would be untrue.
    """
    feasible = [item for item in found if item.feasible] or found
    least = min(item.objective for item in feasible)
    near = [item for item in feasible if item.objective <= least + tolerance * abs(least)]
    stationary = [item for item in near if item.kkt.stationarity <= item.kkt_level]
    return min(stationary or near, key=lambda item: item.objective)


def conclude(
    sampler: Sampler,
    formulation: str,
    outcome: FormulationResult,
    tolerance: float,
    seed: int,
    began: float,
    verified: VerifiedDesign | None = None,
    look: BoxLook | None = None,
) -> Solution:
    """Verify and polish what a formulation found, if anything, where that is not done yet."""
    if outcome.x is None:
        result = infeasible_dict(
            formulation,
            outcome.message,
            spent=sampler.spent.by_purpose,
            seconds=perf_counter() - began,
            seed=seed,
        )
        return Solution(result, outcome, None)
    verified = verify(sampler, outcome.x) if verified is None else verified
    quality = surrogate_quality(outcome.surrogates, verified, seed, quiet=sampler.quiet)
    result = result_dict(
        formulation,
        outcome,
        verified,
        tolerance=tolerance,
        spent=sampler.spent.by_purpose,
        seconds=perf_counter() - began,
        seed=seed,
        quality=quality,
        look=look,
    )
    return Solution(result, outcome, verified, quality)


def rescue(sampler: Sampler, outcome: FormulationResult, seed: int) -> FormulationResult:
    """Ask the true inner problem at a few θ: is the case infeasible, or did a formulation fail?"""
    lower, upper = box(sampler.problem)
    points = design("sobol", lower, upper, 8, seed)
    with sampler.spent.on("rescue"):
        samples = sampler.bandwidths(points, "looking for a feasible design")
    feasible = [sample for sample in samples if sample.feasible]
    if not feasible:
        assert sampler.nearest is not None
        words = sampler.nearest.shortfall
        return FormulationResult(None, None, outcome.iterates, (), None, False, words)
    best = max(feasible, key=lambda sample: sample.bandwidth)
    x = np.array([*best.theta, np.log(best.omega_S), np.log(best.omega_T)])
    return FormulationResult(
        x, None, outcome.iterates, outcome.surrogates, outcome.outer, False, outcome.message
    )
