"""`python -m ccd_casadi.solve CASE.toml`: sample, fit, IPOPT, verify; writes the run folder."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.case import load_case, problem_of
from ccd_casadi.case_sections import Case
from ccd_casadi.case_toml import case_to_toml
from ccd_casadi.cluster import pool
from ccd_casadi.command_line import ExitCode, add_scheduler, parser, run, run_folder
from ccd_casadi.diagnosis import Severity, diagnose, first_seen
from ccd_casadi.direct import solve_direct
from ccd_casadi.iterates import FormulationResult
from ccd_casadi.known import Surrogates, named_surrogate
from ccd_casadi.lifted import solve_lifted
from ccd_casadi.models import SHIPPED
from ccd_casadi.nested import solve_nested
from ccd_casadi.outer import unmet_constraint
from ccd_casadi.problem import CoDesignProblem, box, plant_of
from ccd_casadi.results import (
    clean,
    controller_dict,
    infeasible_dict,
    result_dict,
    write_json,
)
from ccd_casadi.samples import SampleStore
from ccd_casadi.sampling import Truth
from ccd_casadi.surrogate_quality import quality_dict, surrogate_quality
from ccd_casadi.verify import VerifiedDesign, verify
from surrogates import Quality, design, save
from surrogates.files import write_whole

PATIENCE = 2.0  # s of work that is not worth starting processes for
FORMULATIONS = ("nested", "lifted", "direct")
_CODES = {
    "verified": ExitCode.DONE,
    "not_verified": ExitCode.NOT_VERIFIED,
    "infeasible": ExitCode.INFEASIBLE,
}


@dataclass(frozen=True)
class Solution:
    """Everything a run found: the JSON result, and the objects behind it (None: infeasible)."""

    result: dict[str, Any]
    outcome: FormulationResult
    verified: VerifiedDesign | None
    quality: tuple[Quality, ...] = ()

    @property
    def exit_code(self) -> ExitCode:
        """The command's exit code."""
        return _CODES[self.result["status"]]


def solve(
    case: Case, truth: Truth, formulation: str, seed: int, given: Surrogates | None = None
) -> Solution:
    """Run one formulation, verify and polish its design on the truth."""
    began = perf_counter()
    forbidden = unmet_constraint(truth.problem, case.outer.starts, seed)
    if forbidden:
        outcome = FormulationResult(None, None, (), (), None, False, forbidden)
    else:
        outcome = _formulate(case, truth, formulation, seed, given)
        if outcome.x is None:
            outcome = rescue(truth, outcome, seed)
    return conclude(truth, formulation, outcome, case.outer.tolerance, seed, began)


def conclude(
    truth: Truth,
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
            syntheses=truth.syntheses,
            seconds=perf_counter() - began,
            seed=seed,
        )
        return Solution(result, outcome, None)
    verified = verify(truth, outcome.x)
    quality = surrogate_quality(outcome.surrogates, verified.x, seed)
    result = result_dict(
        truth.problem,
        formulation,
        outcome,
        verified,
        tolerance=tolerance,
        syntheses=truth.syntheses,
        seconds=perf_counter() - began,
        seed=seed,
    )
    result["surrogate_quality"] = clean(quality_dict(quality))
    return Solution(result, outcome, verified, quality)


def _formulate(
    case: Case, truth: Truth, formulation: str, seed: int, given: Surrogates | None
) -> FormulationResult:
    outer, sampling = case.outer, case.sampling
    if formulation == "nested":
        return solve_nested(
            truth,
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
            truth,
            points=points,
            starts=outer.starts,
            tolerance=outer.tolerance,
            max_refinements=outer.max_refinements,
            seed=seed,
            given=given,
            surrogate_kind=outer.surrogate,
        )
    return solve_direct(truth, starts=outer.direct_starts, seed=seed)


def rescue(truth: Truth, outcome: FormulationResult, seed: int) -> FormulationResult:
    """Ask the true inner problem at a few θ: is the case infeasible, or did a formulation fail?"""
    lower, upper = box(truth.problem)
    points = design("sobol", lower, upper, 8, seed)
    samples = truth.bandwidths(points, "looking for a feasible design")
    feasible = [sample for sample in samples if sample.feasible]
    if not feasible:
        assert truth.nearest is not None
        words = truth.nearest.shortfall
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


def summary(solution: Solution) -> str:
    """The result in a few lines for the terminal."""
    result = solution.result
    if result["status"] == "infeasible":
        return f"no feasible design: {result['reason']}"
    units = result["units"]
    theta = ", ".join(f"{k} = {v:.6g} {units[k]}".strip() for k, v in result["theta"].items())
    lines = [
        f"status        {result['status']}  {result['reason']}".rstrip(),
        f"theta         {theta}",
        f"objective     {result['objective']:.4f}   hardware cost {result['hardware_cost']:.6g}",
        f"bandwidth     {result['bandwidth_hz']:.4f} Hz   predicted "
        f"{result['surrogate_bandwidth_hz']:.4f} Hz (error {result['verification_error']:.1e})",
        f"weights       omega_S = {result['omega_S_hz']:.5g} Hz, "
        f"omega_T = {result['omega_T_hz']:.5g} Hz",
        f"sensitivity   peak {result['sensitivity_peak']:.5f} at "
        f"{result['sensitivity_peak_hz']:.4g} Hz, |S| {result['sensitivity_low']:.4g} at omega_low",
        f"certificate   {'passed' if result['certificate']['passed'] else 'FAILED'}: norm "
        f"{result['certificate']['norm']:.6g} <= {result['certificate']['norm_bound']:.6g}, "
        f"poles left of {result['certificate']['max_real_pole']:.4g} 1/s",
        f"binding       {', '.join(result['active']) or 'nothing'}",
        f"optimality    KKT residual {result['kkt']['stationarity']:.1e} on the true problem",
        f"cost          {result['syntheses']} syntheses, {result['seconds']:.1f} s",
    ]
    lines += [f"note          {words}" for words in result.get("notes", ())]
    return "\n".join(lines)


def tell(case: Case, problem: CoDesignProblem) -> None:
    """On stderr: what is serious about a plant of the user's own, and what it is made of."""
    if case.plant.model in SHIPPED:
        return
    found = first_seen(diagnose(problem, case.suspension.rigid_modes)[1])
    for item in found:
        if item.severity is not Severity.NOTE:
            print(f"{item.severity.value}: plant: {item.words}", file=sys.stderr)
    for words in plant_of(problem).notes(problem.start):
        print(f"note: {words}", file=sys.stderr)


def command(options: argparse.Namespace) -> ExitCode:
    """The command itself."""
    case = load_case(options.case)
    problem = problem_of(case)
    plant_of(problem)  # a wrong plant is told before anything is written
    folder = run_folder(options.case, options.out)
    if not options.quiet:
        tell(case, problem)
    given = None
    if options.surrogate is not None:
        given = named_surrogate(folder, options.surrogate, options.formulation, problem)
    store = folder / "samples.sqlite"
    with (
        pool(options.scheduler, options.workers, PATIENCE) as workers,
        SampleStore(store) as samples,
    ):
        truth = Truth(problem, samples, workers, quiet=options.quiet)
        solution = solve(case, truth, options.formulation, options.seed, given)
        write_run(folder, case, solution)
    from ccd_casadi.report import write_report  # matplotlib is slow to import

    write_report(folder, case, problem, solution)
    if not options.quiet:
        print(summary(solution))
        print(f"run folder    {folder}")
    elif solution.exit_code is not ExitCode.DONE:
        print(f"{options.case}: {solution.result['reason']}", file=sys.stderr)
    return solution.exit_code


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = parser("ccd_casadi.solve", "Co-design a stage and its controller; see the README.")
    arguments.add_argument(
        "--formulation", choices=FORMULATIONS, default="nested", help="default: nested"
    )
    arguments.add_argument(
        "--resume",
        action="store_true",
        help="go on from the samples in the run folder (every run does; kept for scripts)",
    )
    arguments.add_argument(
        "--surrogate",
        metavar="NAME",
        help="start from a version of the run folder's surrogates (0002), not by sampling",
    )
    add_scheduler(arguments)
    return run(command, arguments, argv)


if __name__ == "__main__":
    raise SystemExit(main())
