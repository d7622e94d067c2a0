"""Tolerances bought: a design for a share of machines, and what each tolerance costs.

`python -m ccd_casadi.tolerances PLACE`: a design for a share of machines, or prices of a run.

Writes tolerances.json; for a share the files of a run too, for prices of half-widths a case file.
"""

import argparse
import sys

from ccd_casadi.support.command_line import ExitCode, command, run_folder
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import one_line, option, positive
from ccd_casadi.support.terminal import inform, say

EXTENSION = Extension(
    commands={
        "tolerances": (
            "ccd_casadi.extensions.tolerances",
            "design for a share of machines; price the tolerances of a run",
        )
    }
)


@command(
    "ccd_casadi.tolerances",
    "Design a machine and controller for the share of machines that [robust] names, judged on "
    "fresh draws. CASE.toml may be the folder of a finished solve: what each tolerance costs.",
    option("--theta", metavar="m1=60,m2=60", help="of a case: the hardware, which is not searched"),
    option("--budget", metavar="MINUTES", type=positive,
           help="of a case: end each search in this time (default: [outer] minutes, 5)"),
    needs=["ccd_casadi.extensions.tolerances.answers"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.plant_tables import parse_theta
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.codesign.result import write_case
    from ccd_casadi.extensions.tolerances.answers import (
        design_for_share,
        price_answer,
        share_answer,
        tolerance_case,
    )
    from ccd_casadi.sampling.sampler import Sampler
    from ccd_casadi.sampling.store import SampleStore
    from ccd_casadi.support.errors import UserError
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.process_pool import PoolOptions, Workers
    from ccd_casadi.support.text import versions

    place = options.case
    run = None
    if place.is_dir():
        if options.theta is not None or options.budget is not None:
            raise UserError(f"{place}: a run has its own theta; leave out --theta and --budget")
        of = tolerance_case(load_case(place / "case.toml"))
        run = read_run(place)
        folder = run_folder(place, options.out or place)
    else:
        of = tolerance_case(load_case(place))
        if of.plan is None:
            words = "is missing; give it, or name the folder of a finished solve for its prices"
            raise UserError(f"{place}: robust.share: {words}")
        out = options.out or place.with_name(f"{place.stem}_tolerances")
        theta = None if options.theta is None else parse_theta(of.case, options.theta)
        folder = run_folder(place, out)
    problem = of.problem if run is None else run.problem
    with (
        Workers(options.workers, PoolOptions.patience) as workers,
        SampleStore(folder / "tolerances.sqlite") as store,
    ):
        sampler = Sampler(problem, store, workers, quiet=options.quiet)
        if run is None:
            minutes = options.budget or of.case.outer.minutes
            answer = share_answer(design_for_share(of, sampler, theta, options.seed, minutes))
        else:
            answer = price_answer(run, sampler, options.quiet)
    for name in () if run else ("result.json", "controller.json"):  # of an earlier one
        (folder / name).unlink(missing_ok=True)
    reported = {"seed": options.seed, "seconds": options.seconds(), "versions": versions()}
    write_json(folder / "tolerances.json", answer.entry | reported)
    for name, content in answer.files.items():
        if isinstance(content, str):
            (folder / name).write_text(content, "utf-8")
        else:
            write_json(folder / name, content)
    if "result.json" in answer.files:
        write_case(folder, of.case)
    inform("\n".join((*answer.words, f"file          {folder / 'tolerances.json'}")))
    if answer.good:
        return ExitCode.DONE
    say(one_line(f"not verified: {answer.words[0]}"), sys.stderr)
    return ExitCode.NOT_VERIFIED
