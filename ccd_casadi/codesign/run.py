"""One co-design from a case: sample, fit, solve with IPOPT, verify; and its run folder."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.cases.sections import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign.box_look import BoxLook, look_over_box, perturbed
from ccd_casadi.codesign.catalogue import best_of_lists
from ccd_casadi.codesign.design_plants import best_over_design_plants
from ccd_casadi.codesign.direct import Direct, solve_direct
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.full_order import full_order_beside
from ccd_casadi.codesign.lifted import OUTPUTS, Lifted, solve_lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.result import (
    controller_dict,
    infeasible_dict,
    predicted_bandwidth,
    result_dict,
)
from ccd_casadi.codesign.sections_result import beside_dict, sections_controller, sections_result
from ccd_casadi.codesign.sections_run import SectionsRun, run_sections
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.codesign.stored import Surrogates, fitted_quantities
from ccd_casadi.codesign.surrogate_quality import surrogate_quality
from ccd_casadi.codesign.verdict import KKT_LEVEL
from ccd_casadi.codesign.verify import VerifiedDesign, verify
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import write_json
from ccd_casadi.support.process_pool import PATIENCE, Workers
from ccd_casadi.support.progress import Progress
from surrogates import design, save
from surrogates.files import write_whole

Formulation = Nested | Lifted | Direct
MOVED_ROUNDS = 1  # more after a look: local solves on the truth have found what they would look for


def formulation_of(case: Case, name: str) -> Formulation:
    """The formulation of that name with the options of a case file."""
    outer, sampling = case.outer, case.sampling
    rounds = (
        outer.starts,
        outer.tolerance,
        outer.max_refinements,
        outer.surrogate,
        outer.box_points,
    )
    if name == "nested":
        return Nested(sampling.design, sampling.points, *rounds)
    if name == "lifted":
        return Lifted(sampling.lifted_points, *rounds)
    return Direct(outer.direct_starts, outer.tolerance, outer.box_points)


def solve(
    problem: CoDesignProblem,
    formulation: Formulation | None = None,
    *,
    seed: int = 0,
    workers: int = 1,
    store: str | Path | None = None,
    quiet: bool = True,
) -> Solution:
    """Co-design the plant and its controller, verified on the true synthesis.

        min w1 f(θ) + w2 ω_b*(θ),  θ_min <= θ <= θ_max,  λ(θ) <= 0      (paper, equation (9))

    `formulation` is `Nested(...)`, `Lifted(...)` (default) or `Direct(...)`; samples are kept in
    the file `store`, which a later call resumes from, or nowhere. More than one of `workers` needs
    the caller's script behind `if __name__ == "__main__":`, as any use of processes does.

    Raises UserError where the plant or the store cannot be used; an infeasible problem is a
    Solution with `verified` None.

    >>> import ccd_casadi as ccd
    >>> problem = ccd.problem_of(ccd.load_case("runs/two_mass.toml"))
    >>> solution = ccd.solve(problem, ccd.Lifted(points=24, box_points=4))
    >>> solution.result["status"], [round(v, 3) for v in solution.verified.theta]
    ('verified', [55.0, 55.0])
    """
    with (
        TemporaryDirectory() as folder,
        threadpool_limits(limits=1),  # the matrices are small
        Workers(workers, PATIENCE) as pool,
        SampleStore(store or Path(folder) / "samples.sqlite") as samples,
    ):
        sampler = Sampler(problem, samples, pool, quiet=quiet)
        return co_design(sampler, formulation or Lifted(), seed)


def co_design(
    sampler: Sampler, formulation: Formulation, seed: int, given: Surrogates | None = None
) -> Solution:
    """Run one formulation on a sampler, verify and polish its design on the truth.

    A robust problem that leaves its design plant open is solved for each, and the best one kept;
    one with parameters from lists by branching over these (`catalogue`).
    """
    if sampler.problem.listed:
        if given is not None:
            raise UserError("--surrogate: starts no solve with lists of values; leave it out")
        return best_of_lists(sampler, lambda each: co_design(each, formulation, seed))
    began = perf_counter()
    name = type(formulation).__name__.lower()

    def concluded(each: Sampler, outcome: FormulationResult) -> Solution:
        return conclude(each, name, outcome, formulation.tolerance, seed, began)

    forbidden = unmet_constraint(sampler.problem, formulation.starts, seed)
    if sampler.problem.sections is not None and not forbidden:
        return _of_sections(sampler, formulation, seed, given)
    if forbidden:
        return concluded(sampler, FormulationResult(None, None, (), (), None, False, forbidden))

    def solved(each: Sampler) -> Solution:
        if isinstance(formulation, Nested):
            outcome = solve_nested(each, formulation, seed=seed, given=given)
        elif isinstance(formulation, Lifted):
            outcome = solve_lifted(each, formulation, seed=seed, given=given)
        else:
            outcome = solve_direct(each, formulation, seed=seed)
        if outcome.x is None:
            outcome = rescue(each, outcome, seed)
        if outcome.x is None:
            return concluded(each, outcome)
        return _with_look(each, formulation, outcome, seed, began)

    return best_over_design_plants(sampler, solved, concluded)


def _with_look(
    sampler: Sampler, formulation: Formulation, outcome: FormulationResult, seed: int, began: float
) -> Solution:
    """Verify, look over the box for something better, and go on from there if there is."""
    assert outcome.x is not None
    name = type(formulation).__name__.lower()
    verified = verify(sampler, outcome.x)
    J = verified.objective if verified.feasible else np.inf
    look = look_over_box(sampler, verified.x, J, formulation.box_points, seed, outcome.surrogates)
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
    if verified.kkt.stationarity > KKT_LEVEL:
        ends = [verify(sampler, end) for end in perturbed(sampler, verified.x, seed)]
        verified = _best([verified, *ends], formulation.tolerance)
        if isinstance(formulation, Direct):  # has no surrogate that could have promised another
            outcome = replace(outcome, x=verified.x, design=sampler.design(verified.x))
    return conclude(sampler, name, outcome, formulation.tolerance, seed, began, verified, look)


def _resumed(
    sampler: Sampler, formulation: Formulation, outcome: FormulationResult, x: Array, seed: int
) -> FormulationResult:
    """Go on from a better design (or the same one, wrongly predicted): the surrogates learn it."""
    if isinstance(formulation, Direct):
        return replace(outcome, x=x, design=sampler.design(x), agreed=True)
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
    return abs(predicted_bandwidth(outcome, verified) / verified.design.figures.bandwidth - 1.0)


def _distinct(x: Array, other: Array | None) -> list[Array]:
    return [x] if other is None or np.array_equal(x, other) else [x, other]


def _best(found: list[VerifiedDesign], tolerance: float) -> VerifiedDesign:
    """The least J of those that are feasible; within the tolerance of it one that is stationary.

    A better design that is not stationary is kept: to call a worse one optimal would be untrue.
    """
    feasible = [item for item in found if item.feasible] or found
    least = min(item.objective for item in feasible)
    near = [item for item in feasible if item.objective <= least + tolerance * abs(least)]
    stationary = [item for item in near if item.kkt.stationarity <= KKT_LEVEL]
    return min(stationary or near, key=lambda item: item.objective)


def _of_sections(
    sampler: Sampler, formulation: Formulation, seed: int, given: Surrogates | None
) -> Solution:
    """A co-design with a controller of fixed structure."""
    if given is not None:
        raise UserError("--surrogate: starts no solve with sections; solve the case without it")
    problem = sampler.problem
    if sections_of_problem(problem).of_error and not problem.w2 > 0.0:
        words = 'with inner.minimise = "rms_error" J = w1 f + w2 e counts the error e in m'
        raise UserError(f"objective.w2: is {problem.w2:g}; {words}: give a positive number")
    began, name = perf_counter(), type(formulation).__name__.lower()
    found = run_sections(sampler, formulation, seed)
    return solution_of_sections(
        sampler.problem, name, found, formulation.tolerance, seed, perf_counter() - began,
        sampler.quiet,
    )  # fmt: skip


def solution_of_sections(
    problem: CoDesignProblem,
    name: str,
    found: SectionsRun,
    tolerance: float,
    seed: int,
    seconds: float,
    quiet: bool = True,
) -> Solution:
    """result.json and the objects behind it."""
    spent: dict[str, Any] = {"syntheses": found.syntheses, "seconds": seconds, "seed": seed}
    if found.verified is None:
        return Solution(infeasible_dict(name, found.outcome.message, **spent), found.outcome, None)
    verified = found.verified
    theta = np.array(verified.theta)
    of_error = sections_of_problem(problem).of_error
    quality = surrogate_quality(found.outcome.surrogates, theta, seed, of_error=of_error)
    result = sections_result(
        problem, name, found.outcome, verified, tolerance=tolerance, quality=quality, **spent
    )
    with Progress(1, "full order beside it", quiet=quiet) as bar:
        beside = full_order_beside(verified.problem, verified.theta, verified.design)
        bar.advance()
    result["full_order"] = beside_dict(beside)
    return Solution(result, found.outcome, None, quality, sections=found.verified)


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
            syntheses=sampler.syntheses,
            seconds=perf_counter() - began,
            seed=seed,
        )
        return Solution(result, outcome, None)
    verified = verify(sampler, outcome.x) if verified is None else verified
    quality = surrogate_quality(outcome.surrogates, verified.x, seed, quiet=sampler.quiet)
    result = result_dict(
        sampler.problem,
        formulation,
        outcome,
        verified,
        tolerance=tolerance,
        syntheses=sampler.syntheses,
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


def resolved(case: Case, solution: Solution) -> Case:
    """The case with what was found best of what it left open: design plant, listed values."""
    problem = solution.problem
    if problem is None:
        return case
    held = problem.source.held
    chosen = tuple(p.fixed_at(held[p.name]) for p in case.theta if p.name in held)
    if chosen:
        free = tuple(p for p in case.theta if p.name not in held)
        case = replace(case, theta=free, fixed=(*case.fixed, *chosen))
    if problem.robust is None:
        return case
    return replace(case, robust=replace(case.robust, design_at=problem.robust.design_at))


def write_run(folder: Path, case: Case, solution: Solution) -> None:
    """Write what a run folder holds besides samples and report; clear an earlier run's.

    The case in it names what was found best of what was open, so that what works on the run does.
    """
    for name in ("result.json", "controller.json", "surrogate.json", "report.html", "index.html"):
        (folder / name).unlink(missing_ok=True)
    text = case_to_toml(resolved(case, solution))
    write_whole(folder / "case.toml", text)  # a kill must not leave half a case to resume from
    formulation = solution.result["formulation"]
    write_json(folder / "truth.json", {"truth": "ccd_casadi", "formulation": formulation})
    if solution.verified is not None:
        write_json(folder / "controller.json", controller_dict(solution.verified.design.controller))
    if solution.sections is not None:
        made = solution.sections
        words = sections_controller(made.problem, made.design)
        write_json(folder / "controller.json", words)
    if solution.outcome.surrogates:
        save(
            solution.outcome.surrogates,
            folder / "surrogate.json",
            {
                "formulation": formulation,
                "outputs": list(OUTPUTS[: len(solution.outcome.surrogates)]),
                "loo": [vars(process.loo) for process in solution.outcome.surrogates],
            },
        )
    write_json(folder / "result.json", solution.result)
