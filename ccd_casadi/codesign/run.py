"""One co-design from a case: sample, fit, solve with IPOPT, verify; and its run folder."""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.cases.sections import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign import FORMULATIONS as FORMULATIONS
from ccd_casadi.codesign.design_plants import best_over_design_plants
from ccd_casadi.codesign.direct import Direct, solve_direct
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.lifted import Lifted, solve_lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.result import (
    clean,
    controller_dict,
    infeasible_dict,
    result_dict,
    write_json,
)
from ccd_casadi.codesign.stored import Surrogates
from ccd_casadi.codesign.surrogate_quality import quality_dict, surrogate_quality
from ccd_casadi.codesign.verify import VerifiedDesign, verify
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import PATIENCE, Workers
from surrogates import Quality, design, save
from surrogates.files import write_whole

Formulation = Nested | Lifted | Direct


@dataclass(frozen=True)
class Solution:
    """Everything a run found: the JSON result, and the objects behind it (None: infeasible).

    `problem` is the one solved: of a robust case that leaves its design plant open, the best one's.
    """

    result: dict[str, Any]
    outcome: FormulationResult
    verified: VerifiedDesign | None
    quality: tuple[Quality, ...] = ()
    problem: CoDesignProblem | None = None


def formulation_of(case: Case, name: str) -> Formulation:
    """The formulation of that name with the options of a case file."""
    outer, sampling = case.outer, case.sampling
    rounds = (outer.starts, outer.tolerance, outer.max_refinements, outer.surrogate)
    if name == "nested":
        return Nested(sampling.design, sampling.points, *rounds)
    if name == "lifted":
        return Lifted(sampling.lifted_points, *rounds)
    return Direct(starts=outer.direct_starts, tolerance=outer.tolerance)


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
    >>> solution = ccd.solve(problem, ccd.Lifted(points=24))
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

    A robust problem that leaves its design plant open is solved for each, and the best one kept.
    """
    began = perf_counter()
    if unmet_constraint(sampler.problem, formulation.starts, seed):
        return _co_design(sampler, formulation, seed)  # which says so

    def concluded(each: Sampler, outcome: FormulationResult) -> Solution:
        name = type(formulation).__name__.lower()
        return conclude(each, name, outcome, formulation.tolerance, seed, began)

    return best_over_design_plants(
        sampler, lambda each: _co_design(each, formulation, seed, given), concluded
    )


def _co_design(
    sampler: Sampler, formulation: Formulation, seed: int, given: Surrogates | None = None
) -> Solution:
    """The same for a problem with one design plant."""
    began = perf_counter()
    name = type(formulation).__name__.lower()
    forbidden = unmet_constraint(sampler.problem, formulation.starts, seed)
    if forbidden:
        outcome = FormulationResult(None, None, (), (), None, False, forbidden)
    else:
        if isinstance(formulation, Nested):
            outcome = solve_nested(sampler, formulation, seed=seed, given=given)
        elif isinstance(formulation, Lifted):
            outcome = solve_lifted(sampler, formulation, seed=seed, given=given)
        else:
            outcome = solve_direct(sampler, formulation, seed=seed)
        if outcome.x is None:
            outcome = rescue(sampler, outcome, seed)
    return conclude(sampler, name, outcome, formulation.tolerance, seed, began)


def conclude(
    sampler: Sampler,
    formulation: str,
    outcome: FormulationResult,
    tolerance: float,
    seed: int,
    began: float,
) -> Solution:
    """Verify and polish what a formulation found, if anything."""
    if outcome.x is None:
        result = infeasible_dict(
            formulation,
            outcome.message,
            syntheses=sampler.syntheses,
            seconds=perf_counter() - began,
            seed=seed,
        )
        return Solution(result, outcome, None)
    verified = verify(sampler, outcome.x)
    quality = surrogate_quality(outcome.surrogates, verified.x, seed)
    result = result_dict(
        sampler.problem,
        formulation,
        outcome,
        verified,
        tolerance=tolerance,
        syntheses=sampler.syntheses,
        seconds=perf_counter() - began,
        seed=seed,
    )
    result["surrogate_quality"] = clean(quality_dict(quality))
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
    """The case with the design plant that was found best, where it left that open."""
    if solution.problem is None or solution.problem.robust is None:
        return case
    robust = replace(case.robust, design_at=solution.problem.robust.design_at)
    return replace(case, robust=robust)


def write_run(folder: Path, case: Case, solution: Solution) -> None:
    """Write what a run folder holds besides samples and report; clear an earlier run's.

    The case in it names the design plant that was found best, so that what works on the run does.
    """
    for name in ("result.json", "controller.json", "surrogate.json", "report.html"):
        (folder / name).unlink(missing_ok=True)
    text = case_to_toml(resolved(case, solution))
    write_whole(folder / "case.toml", text)  # a kill must not leave half a case to resume from
    formulation = solution.result["formulation"]
    write_json(folder / "truth.json", {"truth": "ccd_casadi", "formulation": formulation})
    if solution.verified is not None:
        write_json(folder / "controller.json", controller_dict(solution.verified.design.controller))
    if solution.outcome.surrogates:
        save(
            solution.outcome.surrogates,
            folder / "surrogate.json",
            {
                "formulation": formulation,
                "outputs": ["bandwidth"]
                if len(solution.outcome.surrogates) == 1
                else ["bandwidth", "ln_sensitivity_peak", "ln_sensitivity_low"],
                "loo": [vars(process.loo) for process in solution.outcome.surrogates],
            },
        )
    write_json(folder / "result.json", solution.result)
