"""`python -m ccd_casadi.inner CASE.toml --theta m1=60,m2=60`: the true inner loop at one θ."""

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccd_casadi.cases import SEARCH, is_searched
from ccd_casadi.support.command_line import ExitCode, command, run_folder
from ccd_casadi.support.options import break_frequencies, break_frequency_options, option
from ccd_casadi.support.terminal import inform

if TYPE_CHECKING:  # what computes is imported once the options are known to be right
    from ccd_casadi.cases.measured_case import MeasuredCase
    from ccd_casadi.codesign.inner_answer import InnerAnswer

PROGRESS = partial(inform, stream=sys.stderr)  # stdout is for the answer


@command(
    "ccd_casadi.inner", "Find the best controller at one theta; print it as JSON.",
    option("--theta", metavar="m1=60,m2=60", help="the hardware; a measured plant has none"),
    option("--begin-at", metavar="FOLDER", type=Path,
           help="sections: start one search from the controller of this run, not many"),
    *break_frequency_options("of a weight; with both: one synthesis, no search"),
    needs=["ccd_casadi.codesign.result"],
    early=lambda options: SEARCH if is_searched(options.case) else (),
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Print one JSON object; with both break frequencies given, of that single synthesis."""
    from ccd_casadi.cases.case import CaseError, load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.cases.diagnosis import suspicions
    from ccd_casadi.cases.measured_case import measured_case
    from ccd_casadi.cases.plant_tables import parse_theta
    from ccd_casadi.codesign.inner_answer import InnerOptions, mixed_answer, structured_answer
    from ccd_casadi.inner_problem.controller_problem import MixedSensitivityProblem
    from ccd_casadi.inner_problem.structured_problem import StructuredProblem
    from ccd_casadi.support.errors import UserError
    from ccd_casadi.support.process_pool import Workers

    measured = measured_case(options.case)
    if measured is not None:
        return _answer_measured(measured, options)
    case = load_case(options.case)
    if options.theta is None:
        start = ",".join(f"{each.name}={each.start:g}" for each in case.theta)
        raise CaseError(f"{case.path}: --theta is missing; give the hardware, --theta {start}")
    problem = problem_of(case, at_a_sample=True)
    theta = parse_theta(case, options.theta)
    point = break_frequencies(options)
    answer = {MixedSensitivityProblem: mixed_answer, StructuredProblem: structured_answer}
    with Workers(options.workers) as workers:
        how = InnerOptions(options.seed, workers, PROGRESS, point, options.begin_at)
        try:
            found = answer[type(problem.controller)](problem, theta, how)
        except UserError as error:
            raise CaseError(f"{case.path}: {error}") from error
    if found.status == "infeasible":
        causes = suspicions(problem, case.suspension.rigid_modes)
        reason = "; ".join(filter(None, [found.figures.get("reason", ""), *causes]))
        found = replace(found, figures={**found.figures, "reason": reason})
    return _print(found, options)


def _answer_measured(case: "MeasuredCase", options: argparse.Namespace) -> ExitCode:
    """Sections on a measured response, with a page where a folder is asked for."""
    from ccd_casadi.cases.case import CaseError
    from ccd_casadi.support import extensions

    measured_answer = extensions.function("measured_answer")
    measured_page = extensions.function("measured_page")
    if measured_answer is None or measured_page is None:
        words = extensions.missing("'measured'", "functions", "measured_answer")
        raise CaseError(f"{case.path}: plant.model: {words}")
    given = (options.theta, options.omega_S_hz, options.omega_T_hz, options.begin_at)
    if any(value is not None for value in given):
        words = 'plant.model = "measured" has no theta and no weights to place; leave out --theta'
        raise CaseError(f"{case.path}: {words}, --omega-s-hz, --omega-t-hz and --begin-at")
    PROGRESS(f"{case.file}: {case.responses[0].words}")
    found, made = measured_answer(case, seed=options.seed, log=PROGRESS)
    stable = made.figures is not None and made.figures.stable
    if options.out is not None and made.controller is not None and stable:
        from ccd_casadi.drawing.paint import write_page

        folder = run_folder(options.case, options.out)
        answer = {"status": found.status, **found.figures}
        write_page(folder / "report.html", measured_page(case, made.controller, answer))
    return _print(found, options)


def _print(found: "InnerAnswer", options: argparse.Namespace) -> ExitCode:
    """Print the answer, after controller.json is written: the folder may be refused."""
    from ccd_casadi.codesign.result_entries import figures_dict
    from ccd_casadi.support.json_files import json_text, write_json
    from ccd_casadi.support.text import versions

    if options.out is not None and found.controller is not None:
        folder = run_folder(options.case, options.out)
        write_json(folder / "controller.json", found.controller)
    answer: dict[str, Any] = {
        "status": found.status,
        **found.figures,
        "seconds": options.seconds(),
        "seed": options.seed,
        "formulation": "inner",
        "versions": versions(),
        "sweep": [figures_dict(row) for row in found.rows],
    }
    print(json_text(answer))
    return ExitCode.of(found.status)


if __name__ == "__main__":
    raise SystemExit(main())
