"""`python -m ccd_casadi.check CASE.toml`: the plant over its box before anything is designed."""

import argparse
import sys

from ccd_casadi.support.command_line import ExitCode, command, option, run_folder
from ccd_casadi.support.terminal import inform, say
from ccd_casadi.support.text import plural, spoken, with_unit


@command(
    "ccd_casadi.check", "Look at a case's plant before designing anything.",
    option("--json", action="store_true", help="the diagnosis as JSON"),
    needs=["ccd_casadi.codesign.result"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import plain_case, problem_of
    from ccd_casadi.cases.diagnosis import PlantReportOptions, diagnose, plant_report
    from ccd_casadi.cases.findings import Severity
    from ccd_casadi.reporting.facts import theta_words
    from ccd_casadi.support.json_files import json_text, json_values, write_json
    from ccd_casadi.support.text import template

    case = load_case(options.case)
    problem = problem_of(plain_case(case))
    facts, findings = diagnose(problem, case.suspension.rigid_modes, options.seed)
    errors = [f for f in findings if f.severity is Severity.ERROR]
    for item in errors:
        say(f"{options.case}: plant: {item.words}", sys.stderr)
    if errors:
        return ExitCode.BAD_INPUT
    found = json_values(plant_report(case, problem, facts, findings))
    if options.out is not None:
        write_json(run_folder(options.case, options.out) / "check.json", found)
    if options.json:
        say(json_text(found))
    else:
        words = template("templates/check.txt", counted=plural, spoken=spoken, with_unit=with_unit)
        say(
            words.render(found, start=theta_words(found), shares=PlantReportOptions.shares).rstrip()
        )
        designs = "drive" if case.drive.name else "tolerances" if case.robust.share else "solve"
        inform(f"next          ccd {designs} {options.case}")
    return ExitCode.DONE


if __name__ == "__main__":
    raise SystemExit(main())
