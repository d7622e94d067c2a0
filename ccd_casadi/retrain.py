"""`ccd retrain RUN_DIR`: true samples where they help the optimum most, then a new fit."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from ccd_casadi.support.command_line import ExitCode, add_scheduler, run, run_parser
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import number, whole

GROUP = "surrogates.truth"  # of the entry points by which a package offers a truth of its own


def command(options: argparse.Namespace) -> ExitCode:
    """The command itself."""
    from ccd_casadi.codesign.retraining import Settings, retrain
    from surrogates.files import copy_run
    from surrogates.interface import SurrogateFitError
    from surrogates.serialise import SurrogateFileError

    folder = options.run if options.out is None else options.out
    opener = opener_of(options.run)
    if folder != options.run:
        copy_run(options.run, folder)
    settings = Settings(options.budget, options.batch, options.explore, options.seed)
    try:
        with opener(
            folder, tolerance=options.tolerance, workers=options.workers,
            scheduler=options.scheduler, seed=options.seed, quiet=options.quiet,
            user_code=not options.no_user_code,
        ) as truth:  # fmt: skip
            outcome = retrain(folder, truth, settings, options.quiet)
    except (SurrogateFileError, SurrogateFitError) as error:
        raise UserError(str(error)) from error
    if not options.quiet:
        print(f"{outcome.status} ({outcome.reason}): {outcome.rounds} rounds, {outcome.spent} "
              f"evaluations, surrogate {outcome.version} in {folder}")  # fmt: skip
    elif outcome.status != "verified":
        print(f"{folder}: {outcome.status} ({outcome.reason})", file=sys.stderr)
    return ExitCode.of(outcome.status)


def opener_of(folder: Path) -> Callable[..., AbstractContextManager[Any]]:
    """What opens the truth that a run folder's truth.json names: ours, or an installed package's.

    A folder may come from anybody, so it never names a file or an import path. Raises UserError.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such run folder; make one with a solve")
    path, name = folder / "truth.json", "ccd_casadi"
    try:
        name = json.loads(path.read_bytes())["truth"]
    except FileNotFoundError:
        pass
    except (KeyError, TypeError):
        raise UserError(f'{path}: truth: is missing; write {{"truth": NAME}}') from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: is no readable JSON ({error}); solve again") from None
    if name == "ccd_casadi":
        return open_run
    installed = {point.name: point for point in entry_points(group=GROUP)}
    if not isinstance(name, str) or name not in installed:
        raise UserError(
            f"{path}: truth: {name!a:.60} is not installed (known: ccd_casadi and the entry points "
            f"of the group {GROUP}); install the package that has it"
        )
    opener: Callable[..., AbstractContextManager[Any]] = installed[name].load()
    return opener


def open_run(folder: Path, **options: Any) -> AbstractContextManager[Any]:
    """The truth of one of our run folders, which draws its report."""
    from ccd_casadi.codesign import retrained_run

    return retrained_run.open_run(folder, write_page=_write_page, **options)


def _write_page(*work: Any) -> None:
    from ccd_casadi.reporting.solve_page import write_report  # matplotlib is slow to import

    write_report(*work)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = run_parser(
        "surrogates.retrain", "True samples where they help the optimum most, then a new fit.",
        about="the run folder; with --out a copy there is retrained",
    )  # fmt: skip
    add = arguments.add_argument
    add("--budget", metavar="N", type=whole(1), default=500,
        help="evaluations that retraining may add in all (default: 500)")  # fmt: skip
    add("--tolerance", metavar="X", type=number(1e-12, 0.5),
        help="relative agreement of prediction and truth (default: the case's)")  # fmt: skip
    add("--batch", metavar="Q", type=whole(1), default=4, help="points a round (default: 4)")
    add("--explore", metavar="SHARE", type=number(0.0, 1.0), default=0.25,
        help="share of a batch at the largest deviation (default: 0.25)")  # fmt: skip
    add_scheduler(arguments)
    return run(command, arguments, argv, needs=["ccd_casadi.codesign.retrained_run"])


if __name__ == "__main__":
    raise SystemExit(main())
