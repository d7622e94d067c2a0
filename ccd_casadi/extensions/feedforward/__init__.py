"""Feedforward and shaper of a setpoint for every plant of a set, and what learns on the machine.

`python -m ccd_casadi.feedforward RUN_DIR`: feedforward and shaper for every plant of the set.
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ccd_casadi.robust import MOVE_OPTIONS, move_of
from ccd_casadi.support.command_line import RUN, ExitCode, command, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import integer, one_line, option, take_value
from ccd_casadi.support.terminal import inform, say

if TYPE_CHECKING:
    from ccd_casadi.cases.run_folder import FinishedRun
    from ccd_casadi.extensions.feedforward.set_feedforward import SetFeedforward


EXTENSION = Extension(
    commands={
        "feedforward": (
            "ccd_casadi.extensions.feedforward",
            "feedforward and shaper of a move, for every plant of the set",
        )
    }
)


FILE = "feedforward.json"


@command(
    "ccd_casadi.feedforward",
    "Find the feedforward and the shaper with which a move settles on every plant of the set.",
    option("--controller", type=Path, metavar="FILE",
           help="the controller as it runs, as deploy/controller.json; needed where the case has "
           "no loop.rate_hz"),
    option("--learn", type=Path, metavar="LOG",
           help="improve the coefficients in the folder by the error of a move of the machine: "
           "CSV with a line for each sample and a column `error`, or error1, error2, ...: the "
           "controller's error in m; a column `time` in s has to be of its samples"),
    take_value("--taps", "N", integer(1, 9), "of the shaper at most; 1: none", 3),
    take_value("--judges", "N", integer(1), "plants of the set that judge the design", 500),
    take_value("--axis", "N", integer(1), "output that moves", 1),
    *MOVE_OPTIONS, needs=["ccd_casadi.extensions.feedforward.set_feedforward"], place=RUN,
    without_effect=["--workers"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Find, judge, write feedforward.json, C code and the page; or learn from a move.

    The move is that of the options; what they leave out is as in [move] of the case.
    """
    from ccd_casadi.analysis.setpoint import setpoint
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.deployment.given_controller import as_it_runs, with_controller
    from ccd_casadi.extensions.feedforward.feedforward_files import (
        entry,
        feedforward_page,
        place_words,
        summary,
        write_code,
    )
    from ccd_casadi.extensions.feedforward.set_feedforward import (
        FeedforwardSetOptions,
        set_feedforward,
    )
    from ccd_casadi.reporting.run_verdict import index_of, publish
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.text import versions

    run = read_run(options.run)
    run = (as_it_runs(run) if options.controller is None
           else with_controller(run, options.controller))  # fmt: skip
    outputs = len(run.plant.C)
    if options.axis > outputs:
        raise UserError(f"--axis: is {options.axis}; the plant has outputs 1 to {outputs}")
    if options.axis > 1 and run.loop.at:
        words = "of several sensors on one actuator the one whose error counts moves; leave it out"
        raise UserError(f"--axis: is {options.axis}; {words}")
    folder = run_folder(options.run, options.out or options.run / "feedforward")
    limits, window = move_of(options, run, options.axis - 1)
    if options.learn is not None:
        return _learn(run, folder, options.learn)
    found = set_feedforward(
        run, setpoint(limits), window, axis=options.axis - 1, taps=options.taps, seed=options.seed,
        options=FeedforwardSetOptions(judges=options.judges),
    )  # fmt: skip
    place = place_words(run)
    notes = [f"all {place}"] if place else []
    answer = entry(found, options.axis) | {"notes": notes, "seed": options.seed,
                                           "versions": versions(),
                                           "seconds": options.seconds()}  # fmt: skip
    write_json(folder / FILE, answer)
    write_code(folder, answer)
    inform("\n".join([*summary(found), *(f"note          {words}" for words in notes)]))
    publish(run.folder, folder / "report.html", feedforward_page(run, found, index_of(folder)))
    inform(f"page          {folder / 'report.html'}")
    return _end(found)


def _end(found: "SetFeedforward") -> ExitCode:
    if found.kept == len(found.judged):
        return ExitCode.DONE
    lost = len(found.judged) - found.kept
    words = f"not verified: {lost} of {len(found.judged)} plants that were drawn settle later"
    say(one_line(f"{words} than {1e3 * found.found.time:.4g} ms"), sys.stderr)
    return ExitCode.NOT_VERIFIED


def _learn(run: "FinishedRun", folder: Path, log: Path) -> ExitCode:
    """Replace the coefficients in the folder by what a measured move has learned."""
    from ccd_casadi.cases.run_files import read_json
    from ccd_casadi.extensions.feedforward.feedforward_files import improve, read_error, write_code
    from ccd_casadi.support.json_files import write_json

    before = read_json(folder / FILE)
    after, words = improve(run, folder / FILE, before, read_error(log, before["period"]))
    write_json(folder / FILE, after)
    write_code(folder, after)
    inform("\n".join(words))
    return ExitCode.DONE
