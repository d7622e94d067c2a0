"""One co-design: sample, fit, solve with IPOPT, verify."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.controller_tables import OuterTable
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.formulations import (
    Formulation,
    formulation_of,
    usual_formulation,
    usual_name,
)
from ccd_casadi.codesign.outer import Outer
from ccd_casadi.codesign.outer_mixed import MixedOuter
from ccd_casadi.codesign.outer_problem import FormulationResult, RunTerms, unmet_constraint
from ccd_casadi.codesign.outer_search import conclude, conclude_at, search_outer
from ccd_casadi.codesign.result import infeasible_dict, of_budget
from ccd_casadi.codesign.verified import Solution, Verified
from ccd_casadi.inner_problem.controller_problem import ControllerProblem, MixedSensitivityProblem
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.kernels.compilation import ensure_compiled
from ccd_casadi.sampling.inner_samples import with_all_spent
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import PoolOptions, Workers
from ccd_casadi.support.time_budget import StageOptions, ends_early, stage, within_budget
from ccd_casadi.support.worker_process import one_blas_thread


@dataclass(frozen=True)
class RepairOptions:
    """Numbers of searches from a design that its judge refutes.

    Attributes
    ----------
    most : int
        How often the plants of the judge join the set.
    """

    most: int = 2


@one_blas_thread
def solve(
    problem: CoDesignProblem | Case,
    formulation: Formulation | None = None,
    *,
    seed: int = 0,
    workers: int = 1,
    store: str | Path | None = None,
    quiet: bool = True,
    budget: float | None = None,
) -> Solution:
    """Co-design the plant and its controller, verified on the true synthesis.

        min w1 f(θ) + w2 ω_b*(θ),  θ_min <= θ <= θ_max,  λ(θ) <= 0      (paper, equation (9))

    Parameters
    ----------
    problem : CoDesignProblem or Case
        As `problem_of` gives it; of a case its [sampling] and [outer] count too.
    formulation : Nested, Lifted or Direct
        By default that of the command: nested, and direct with more than 12 parameters; with
        sections lifted where that samples fewer θ, and direct with lists.
    seed : int
        Of every random choice.
    workers : int
        Processes; with more than one, call it behind `if __name__ == "__main__":`.
    store : path
        File of the samples, which a later call resumes from.
    quiet : bool
        Whether to show no progress on stderr.
    budget : float, optional
        Minutes of the search, which ends with the best design found in them; by default those of
        the case, `OuterTable.minutes` of a problem.

    Returns
    -------
    Solution
        The design; of an infeasible problem with `verified` None.

    Raises
    ------
    UserError
        The plant or the store cannot be used.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
    >>> solution = ccd.solve(problem, ccd.Lifted(points=24, box_points=4))
    >>> solution.result["status"], [round(v, 3) for v in solution.verified.theta]
    ('verified', [55.0, 55.0])
    """
    if isinstance(problem, Case):
        case, problem = problem, problem_of(problem)
        usual = formulation_of(case, usual_name(case, len(problem.names)))
        minutes = case.outer.minutes
    else:
        usual, minutes = usual_formulation(problem), OuterTable.minutes
    if workers > 1 and problem.source.given is not None:
        problem.source.given.require_found()
    with (
        TemporaryDirectory() as folder,
        Workers(workers, PoolOptions.patience) as pool,
        SampleStore(store or Path(folder) / "samples.sqlite") as samples,
    ):
        sampler = Sampler(problem, samples, pool, quiet=quiet)
        return within(budget or minutes, sampler, formulation or usual, seed)


def within(minutes: float, sampler: Sampler, formulation: Formulation, seed: int) -> Solution:
    """`co_design` within a time budget: the best design found in these minutes, judged.

    Parameters
    ----------
    minutes : float
        After which nothing more is searched.
    sampler, formulation, seed : Sampler, Formulation, int
        As of `co_design`.

    Returns
    -------
    Solution
        Its result says whether the budget ended it, and what was not searched.
    """
    if kernels := sampler.problem.controller.kernels:  # once for an installation: not of a budget
        ensure_compiled(*kernels)
    with within_budget(minutes) as spent:
        found = co_design(sampler, formulation, seed)
        return of_budget(found, spent, sampler.spent.seconds())


def co_design(
    sampler: Sampler, formulation: Formulation, seed: int, known: Array | None = None
) -> Solution:
    """Run one formulation on a sampler, verify and polish its design on the truth.

    A robust problem that leaves its design plant open is solved for each, and the best one kept;
    one with parameters from lists by branching over these (`catalogue`).

    Parameters
    ----------
    sampler : Sampler
        Of the problem.
    formulation : Nested, Lifted or Direct
        With its options.
    seed : int
        Of every random choice.
    known : (n,) array
        x of a local optimum that is known already, in place of the formulation.

    Returns
    -------
    Solution
        With `verified` None where no design is feasible.

    Raises
    ------
    UserError
        J rewards what it should not.
    """
    if sampler.problem.listed:
        return _of_lists(sampler, formulation, seed)
    terms = RunTerms(type(formulation).__name__.lower(), formulation.tolerance, seed)
    require_solvable(sampler.problem)
    forbidden = unmet_constraint(sampler.problem, formulation.starts, seed)
    if forbidden:
        return conclude_at(outer_of(sampler), FormulationResult(message=forbidden), terms)

    def solved(outer: Outer) -> Solution:
        """Searched and judged; again with the plants by which the judge refutes the design."""
        found = search_outer(outer, formulation, seed, known)
        solution = conclude(found, terms)
        for _ in range(RepairOptions.most):
            if found.end is None or solution.verified is None:
                break
            more = found.outer.add_refuting_plants(solution.verified)
            if more is None:
                break
            with stage(StageOptions.repair):
                if ends_early("repair of a refuted design"):
                    break
                again = search_outer(more, formulation, seed, found.end.x,
                                     ending=StageOptions.repair)  # fmt: skip
            if again.end is None:
                break
            found, solution = again, conclude(again, terms)
        return solution

    if sampler.problem.robust is None:
        best, share = solved(outer_of(sampler)), None
        best = replace(best, problem=sampler.problem)
    else:  # made on one of several plants
        from ccd_casadi.codesign.design_plants import best_over_design_plants

        best, share = best_over_design_plants(sampler, outer_of, solved, terms)
    result = with_all_spent(best.result, sampler.spent.by_purpose)
    result["seconds"] = perf_counter() - terms.began
    result["reason"] = outer_of(sampler).failure_reason(best, share)
    return replace(best, result=result)


def outer_of(sampler: Sampler) -> Outer:
    """The outer problem of the kind of controller that a sampler's problem has.

    Parameters
    ----------
    sampler : Sampler
        Of the problem.

    Returns
    -------
    Outer
        An instance of its class in `OUTERS`.
    """
    return OUTERS[type(sampler.problem.controller)](sampler)


def _structured(sampler: Sampler) -> Outer:
    """Imported where a problem has such a controller."""
    from ccd_casadi.codesign.outer_structured import StructuredOuter

    return StructuredOuter(sampler)


# One entry for each class of `CoDesignProblem.controller`; another kind adds its own.
OUTERS: dict[type[ControllerProblem], Callable[[Sampler], Outer]] = {
    MixedSensitivityProblem: MixedOuter,
    StructuredProblem: _structured,
}


@one_blas_thread
def verify(sampler: Sampler, x: Array) -> Verified:
    """Polish the design at x on the truth, compare it with the whole inner problem, judge it.

    Parameters
    ----------
    sampler, x : Sampler, array
        θ in SI, followed by ln ω_S and ln ω_T (rad/s) for mixed sensitivity.

    Returns
    -------
    Verified
        The design with its certificates.
    """
    outer = outer_of(sampler)
    end = outer.polish(x)
    with sampler.spent.on("checks"):
        return outer.verify(end, 1)


def require_solvable(problem: CoDesignProblem) -> None:
    """Refuse a problem whose J rewards what it should not.

    Raises
    ------
    UserError
        J decreases with a figure of which less is better.
    """
    if not problem.figure.larger_is_better and not problem.w2 > 0.0:
        v = problem.figure
        words = f'with inner.minimise = "{v.key}" J = w1 f + w2 {v.symbol} counts the {v.words} '
        words += f"{v.symbol} in {v.si_unit}"
        raise UserError(f"objective.w2: is {problem.w2:g}; {words}: give a positive number")


def _of_lists(sampler: Sampler, formulation: Formulation, seed: int) -> Solution:
    """A co-design with parameters from lists: local searches near by where its kind knows how."""
    from ccd_casadi.codesign.catalogue import best_of_lists

    terms = RunTerms(type(formulation).__name__.lower(), formulation.tolerance, seed)
    if isinstance(sampler.problem.controller, StructuredProblem):
        from ccd_casadi.codesign.structured_lists import ListedStructured

        of = ListedStructured(
            formulation, seed, lambda each, x: co_design(each, formulation, seed, known=x)
        )
        best = best_of_lists(sampler, of.between, of.search, of.judge, exchanges=True)
        if best.verified is None:  # a search near by knows nothing of the run
            whole = infeasible_dict(terms, best.result["reason"], sampler.spent.by_purpose)
            best = replace(best, result={**whole, "listed": best.result["listed"]})
        return best
    quick = replace(formulation, box_points=0)  # a bound needs no look at the box
    return best_of_lists(
        sampler,
        lambda each, near: co_design(each, quick, seed),
        lambda each, near: co_design(each, formulation, seed),
        exchanges=True,
    )
