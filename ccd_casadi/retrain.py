"""`ccd retrain RUN_DIR`: true samples where they help the optimum most, then a new fit."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ccd_casadi.codesign import FORMULATIONS
from ccd_casadi.support.command_line import RUN, SCHEDULER, ExitCode, command
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import integer, option, real, take_value
from ccd_casadi.support.process_pool import PoolOptions, pool
from ccd_casadi.support.terminal import say
from surrogates.files import copy_run

if TYPE_CHECKING:  # what computes is imported once the options are known to be right
    from ccd_casadi.codesign.verified import Solution


@command(
    "surrogates.retrain", "True samples where they help the optimum most, then a new fit.",
    take_value("--budget", "N", integer(1), "most syntheses that retraining adds in total", 500),
    option("--tolerance", metavar="X", type=real(1e-12, 0.5),
           help="relative agreement of prediction and truth (default: the case's)"),
    SCHEDULER, needs=["ccd_casadi.codesign.run"],
    place=RUN | {"help": "the run folder; with --out a copy there is retrained"},
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Add true samples to a run where they help its optimum most, and fit again.

    Parameters
    ----------
    options : argparse.Namespace
        Of the command line.

    Returns
    -------
    ExitCode
    """
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.codesign.result import write_run
    from ccd_casadi.codesign.retraining import Job, only_job, publish
    from ccd_casadi.codesign.run import outer_of, require_solvable
    from ccd_casadi.sampling.sampler import Sampler
    from ccd_casadi.sampling.store import SampleStore

    folder = options.run if options.out is None else options.out
    formulation = formulation_in(options.run)
    if folder != options.run:
        copy_run(options.run, folder)
    case = load_case(folder / "case.toml")
    problem = problem_of(case)
    require_solvable(problem)
    with (
        pool(options.scheduler, options.workers, PoolOptions.patience) as workers,
        SampleStore(folder / "samples.sqlite") as store,
    ):
        outer = outer_of(Sampler(problem, store, workers, quiet=options.quiet))
        outer = outer.resume(folder, options.seed)
        sampler = outer.sampler

        def write(solution: "Solution") -> None:
            from ccd_casadi.reporting.solve_page import write_report  # matplotlib is slow to import

            write_run(folder, case, solution)
            publish(folder)
            write_report(folder, case, sampler.problem, solution)

        with only_job(folder, sampler.store.count(sampler.hash)) as base:
            job = Job(folder, case, outer, formulation, base, options.budget, options.tolerance,
                      options.seed)  # fmt: skip
            outcome = job.run(write)
    if not options.quiet:
        say(f"{outcome.status} ({outcome.reason}): {outcome.rounds} rounds, {outcome.spent} "
            f"syntheses, surrogate {outcome.version} in {folder}")  # fmt: skip
    elif outcome.status != "verified":
        say(f"{folder}: {outcome.status} ({outcome.reason})", sys.stderr)
    return ExitCode.of(outcome.status)


def formulation_in(folder: Path) -> str:
    """The formulation that a run folder's truth.json names, lifted where there is no such file.

    Raises UserError.
    """
    from ccd_casadi.cases.run_files import read_json

    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such run folder; make one with a solve")
    path = folder / "truth.json"
    found = read_json(path) if path.exists() else {"truth": "ccd_casadi"}
    if found.get("truth") != "ccd_casadi":
        raise UserError(f'{path}: truth: is {found.get("truth")!a:.60}; only "ccd_casadi" is known')
    formulation = found.get("formulation", "lifted")
    if formulation not in FORMULATIONS:
        words = f"{formulation!r:.60} is unknown; give {', '.join(FORMULATIONS)}"
        raise UserError(f"{path}: formulation: {words}")
    return str(formulation)


if __name__ == "__main__":
    raise SystemExit(main())
