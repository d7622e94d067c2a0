"""One co-design: sample, fit, solve with IPOPT, verify."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from threadpoolctl import threadpool_limits

from ccd_casadi.codesign.catalogue import best_of_lists
from ccd_casadi.codesign.design_plants import best_over_design_plants
from ccd_casadi.codesign.direct import Direct, solve_direct
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.formulations import MANY, Formulation
from ccd_casadi.codesign.lifted import Lifted, solve_lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.result import infeasible_dict, result_dict
from ccd_casadi.codesign.second_look import conclude, conclude_with_look, rescue
from ccd_casadi.codesign.sections_lists import ListedSections
from ccd_casadi.codesign.sections_run import SectionsRun, run_sections
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.codesign.stored import Surrogates
from ccd_casadi.codesign.surrogate_quality import surrogate_quality
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import PATIENCE, Workers


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

    `formulation` is `Nested(...)`, `Lifted(...)` or `Direct(...)`: by default lifted, direct with
    more than 12 parameters. Samples are kept in the file `store`, which a later call resumes from,
    or nowhere. More than one of `workers` needs the caller's script behind
    `if __name__ == "__main__":`, as any use of processes does.

    Raises UserError where the plant or the store cannot be used; an infeasible problem is a
    Solution with `verified` None.

    >>> import ccd_casadi as ccd
    >>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
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
        usual = Lifted() if len(problem.names) <= MANY else Direct()
        return co_design(sampler, formulation or usual, seed)


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
        return _of_lists(sampler, formulation, seed)
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
            with each.spent.on("search"):
                outcome = solve_direct(each, formulation, seed=seed)
        if outcome.x is None:
            outcome = rescue(each, outcome, seed)
        if outcome.x is None:
            return concluded(each, outcome)
        return conclude_with_look(each, formulation, outcome, seed, began)

    return best_over_design_plants(sampler, solved, concluded)


def _of_lists(sampler: Sampler, formulation: Formulation, seed: int) -> Solution:
    """A co-design with parameters from lists."""
    if sampler.problem.sections is not None:
        of = ListedSections(formulation, seed, lambda each: co_design(each, formulation, seed))
        return best_of_lists(sampler, of.search, of.search, of.judge)
    quick = replace(formulation, box_points=0)  # a bound needs no look at the box
    return best_of_lists(
        sampler,
        lambda each, near: co_design(each, quick, seed),
        lambda each, near: co_design(each, formulation, seed),
    )


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
    spent: dict[str, Any] = {"spent": found.spent, "seconds": seconds, "seed": seed}
    if found.verified is None:
        return Solution(infeasible_dict(name, found.outcome.message, **spent), found.outcome, None)
    quality = surrogate_quality(found.outcome.surrogates, found.verified, seed, quiet=quiet)
    result = result_dict(
        name, found.outcome, found.verified, tolerance=tolerance, quality=quality, **spent
    )
    return Solution(result, found.outcome, found.verified, quality)
