"""One co-design from a case: sample, fit, solve with IPOPT, verify; and its run folder."""

import os
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.cases.sections import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign.direct import solve_direct
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.lifted import solve_lifted
from ccd_casadi.codesign.nested import solve_nested
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.result import (
    clean,
    controller_dict,
    infeasible_dict,
    result_dict,
    write_json,
)
from ccd_casadi.codesign.stored import Surrogates
from ccd_casadi.codesign.surrogate_quality import Quality, quality_dict, surrogate_quality
from ccd_casadi.codesign.verify import VerifiedDesign, verify
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.sampling.sampler import Sampler
from surrogates import design, save

FORMULATIONS = ("nested", "lifted", "direct")


@dataclass(frozen=True)
class Solution:
    """Everything a run found: the JSON result, and the objects behind it (None: infeasible)."""

    result: dict[str, Any]
    outcome: FormulationResult
    verified: VerifiedDesign | None
    quality: tuple[Quality, ...] = ()


def solve(
    case: Case, sampler: Sampler, formulation: str, seed: int, given: Surrogates | None = None
) -> Solution:
    """Run one formulation, verify and polish its design on the truth."""
    began = perf_counter()
    forbidden = unmet_constraint(sampler.problem, case.outer.starts, seed)
    if forbidden:
        outcome = FormulationResult(None, None, (), (), None, False, forbidden)
    else:
        outcome = _formulate(case, sampler, formulation, seed, given)
        if outcome.x is None:
            outcome = rescue(sampler, outcome, seed)
    return conclude(sampler, formulation, outcome, case.outer.tolerance, seed, began)


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


def _formulate(
    case: Case, sampler: Sampler, formulation: str, seed: int, given: Surrogates | None
) -> FormulationResult:
    outer, sampling = case.outer, case.sampling
    if formulation == "nested":
        return solve_nested(
            sampler,
            kind=sampling.design,
            points=sampling.points,
            starts=outer.starts,
            tolerance=outer.tolerance,
            max_refinements=outer.max_refinements,
            seed=seed,
            given=given,
            surrogate_kind=outer.surrogate,
        )
    if formulation == "lifted":
        # A quadratic in n variables has (n+1)(n+2)/2 coefficients; a sample with gradients
        # gives n+1 numbers: 6n samples are twelve times what it needs at n = 4, six times at n = 8.
        points = sampling.lifted_points or 6 * (len(case.theta) + 2)
        return solve_lifted(
            sampler,
            points=points,
            starts=outer.starts,
            tolerance=outer.tolerance,
            max_refinements=outer.max_refinements,
            seed=seed,
            given=given,
            surrogate_kind=outer.surrogate,
        )
    return solve_direct(sampler, starts=outer.direct_starts, seed=seed)


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
