"""Controllers in the form that an industrial drive accepts: a cascade with its filters, rounded as
the drive rounds, judged and proven as it runs.

`python -m ccd_casadi.drive CASE.toml`: an industrial drive's cascade, rounded and proven.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from ccd_casadi.support.command_line import ExitCode, command, run_folder
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import integer, one_line, option, take_value
from ccd_casadi.support.terminal import inform, remark, say

EXTENSION = Extension(
    commands={
        "drive": (
            "ccd_casadi.extensions.drives",
            "design an industrial drive's cascade, rounded and proven",
        )
    }
)


@command(
    "ccd_casadi.drive",
    "Find the fastest cascade of the drive that [drive] names, round it as the drive rounds, judge "
    "and prove it; write a sheet of its parameters, JSON and C code.",
    option("--theta", metavar="m1=60,m2=60", help="the hardware (default: the case's start)"),
    option("--codesign", action="store_true", help="search theta as well, by the case's objective"),
    option("--today", metavar="FILE.toml", type=Path,
           help="present values by number or name, shown beside the new ones"),
    take_value("--starts", "N", integer(1), "starting points of the search", 24),
    needs=["ccd_casadi.extensions.drives.drive_design", "ccd_casadi.cases.case_problem"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Design, write the folder, print the sheet."""
    from dataclasses import replace

    from ccd_casadi.cases.case import load_case, read_toml
    from ccd_casadi.cases.plant_tables import parse_theta
    from ccd_casadi.drawing.paint import write_page
    from ccd_casadi.extensions.drives.cascade import program_of
    from ccd_casadi.extensions.drives.drive_case import (
        DriveCodesignOptions,
        codesign_drive,
        codesign_words,
        drive_problem,
        figures_of,
    )
    from ccd_casadi.extensions.drives.drive_design import DriveOptions, design_drive
    from ccd_casadi.extensions.drives.sheet import drive_page, entry, sheet_figures, sheet_text
    from ccd_casadi.reporting.facts import run_name
    from ccd_casadi.support.errors import UserError
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.process_pool import Workers
    from ccd_casadi.support.text import versions

    case = load_case(options.case)
    theta = None if options.theta is None else parse_theta(case, options.theta)
    today = None if options.today is None else read_toml(options.today)
    if today and not all(isinstance(value, (int, float)) for value in today.values()):
        raise UserError(f'{options.today}: give numbers, as in "p1417" = 500')
    if theta is not None and options.codesign:
        raise UserError("--theta fixes what --codesign searches; give one of both")
    problem = drive_problem(case, theta)
    drive = problem.cascade.drive
    own_settings = (
        *problem.cascade.settings, *(setting for setting, _ in problem.cascade.current),
        drive.speed_feedforward, drive.force_feedforward,
    )  # fmt: skip
    known = [(one.number, one.name) for one in own_settings if one]
    if strange := [name for name in today or {} if not any(name in pair for pair in known)]:
        own = ", ".join(number or name for number, name in known)
        raise UserError(f"{options.today}: {strange[0]} is no parameter of this drive: {own}")
    folder = run_folder(options.case, options.out)
    numbers = DriveOptions(search=replace(DriveOptions().search, starts=options.starts))
    near = None
    searched: dict[str, Any] = {}
    if options.codesign:
        first, best = codesign_drive(
            problem, options.seed, lambda words: remark(words, options.quiet),
            DriveCodesignOptions(drive=numbers),
        )  # fmt: skip
        problem, near = drive_problem(case, best.theta), best.candidate
        searched = {"codesign": {"start": figures_of(problem, first),
                                 "best": figures_of(problem, best)}}  # fmt: skip
    with Workers(options.workers) as workers:
        found = design_drive(
            problem.cascade, problem.uncertain, problem.bounds, problem.sampling,
            seed=options.seed, workers=workers, options=numbers, near=near,
            progress=lambda words: remark(words, options.quiet), ported=problem.ported,
        )  # fmt: skip
    run = {"seconds": options.seconds(), "seed": options.seed, "versions": versions()}
    answer = entry(problem, found, today) | searched | run
    figures = sheet_figures(problem, found, answer)
    text = sheet_text(found, figures, answer, today)
    (folder / "sheet.txt").write_text(f"{text}\n", "utf-8")
    code = program_of(found.cascade, found.values, found.ahead).code(run_name(folder))
    (folder / "cascade.c").write_text(code, "utf-8")
    write_json(folder / "drive.json", answer)
    page = drive_page(run_name(folder), problem, found, answer, figures, today)
    write_page(folder / "report.html", page)
    if searched:
        text = f"{codesign_words(problem, searched['codesign'])}\n{text}"
    inform(text)
    inform(f"page          {folder / 'report.html'}")
    if answer["reason"]:
        say(one_line(f"not verified: {answer['reason']}"), sys.stderr)
    return ExitCode.of(answer["status"])
