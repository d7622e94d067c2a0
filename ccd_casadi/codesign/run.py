"""One co-design from a case: sample, fit, solve with IPOPT, verify; and its run folder."""

import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.cases.sections import Case
from ccd_casadi.cases.toml_writer import case_to_toml
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
from ccd_casadi.codesign.sections_result import sections_controller, sections_result
from ccd_casadi.codesign.sections_run import VerifiedSections, run_sections
from ccd_casadi.codesign.stored import Surrogates
from ccd_casadi.codesign.surrogate_quality import Quality, quality_dict, surrogate_quality
from ccd_casadi.codesign.verify import VerifiedDesign, verify
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import PATIENCE, Workers
from surrogates import design, save

FORMULATIONS = ("nested", "lifted", "direct")
Formulation = Nested | Lifted | Direct


@dataclass(frozen=True)
class Solution:
    """Everything a run found: the JSON result, and the objects behind it (None: infeasible)."""

    result: dict[str, Any]
    outcome: FormulationResult
    verified: VerifiedDesign | None
    quality: tuple[Quality, ...] = ()
    sections: VerifiedSections | None = None  # instead of `verified`, of a fixed structure


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
    """Run one formulation on a sampler, verify and polish its design on the truth."""
    began = perf_counter()
    name = type(formulation).__name__.lower()
    forbidden = unmet_constraint(sampler.problem, formulation.starts, seed)
    if sampler.problem.sections is not None and not forbidden:
        return _of_sections(sampler, formulation, seed, given)
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


def _of_sections(
    sampler: Sampler, formulation: Formulation, seed: int, given: Surrogates | None
) -> Solution:
    """A co-design with a controller of fixed structure."""
    if given is not None:
        raise UserError("--surrogate: starts no solve with sections; solve the case without it")
    began, name = perf_counter(), type(formulation).__name__.lower()
    found = run_sections(sampler, formulation, seed)
    spent: dict[str, Any] = {
        "syntheses": found.syntheses, "seconds": perf_counter() - began, "seed": seed,
    }  # fmt: skip
    if found.verified is None:
        return Solution(infeasible_dict(name, found.outcome.message, **spent), found.outcome, None)
    result = sections_result(
        sampler.problem, name, found.outcome, found.verified, tolerance=formulation.tolerance,
        **spent,
    )  # fmt: skip
    theta = np.array(found.verified.theta)
    quality = surrogate_quality(found.outcome.surrogates, theta, seed)
    result["surrogate_quality"] = clean(quality_dict(quality))
    return Solution(result, found.outcome, None, quality, found.verified)


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


def write_run(folder: Path, case: Case, solution: Solution) -> None:
    """Write what a run folder holds besides samples and report; clear an earlier run's."""
    for name in ("result.json", "controller.json", "surrogate.json", "report.html"):
        (folder / name).unlink(missing_ok=True)
    text = case_to_toml(case)
    draft = folder / "case.toml.part"  # a kill must not leave half a case to resume from
    draft.write_text(text, encoding="utf-8")
    os.replace(draft, folder / "case.toml")
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
                "outputs": ["bandwidth"]
                if len(solution.outcome.surrogates) == 1
                else ["bandwidth", "ln_sensitivity_peak", "ln_sensitivity_low"],
                "loo": [vars(process.loo) for process in solution.outcome.surrogates],
            },
        )
    write_json(folder / "result.json", solution.result)
