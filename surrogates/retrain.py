"""`python -m surrogates.retrain RUN_DIR`: new truth where it helps the optimum most, then refit."""

import argparse
import math
import os
import sys
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import NoReturn

from surrogates.copies import copy_run
from surrogates.ctrl_c import begun, ctrl_c_noticed, was_ctrl_c
from surrogates.interface import SurrogateFitError
from surrogates.retraining import Settings, retrain
from surrogates.serialise import SurrogateFileError
from surrogates.truth import TruthError, TruthInterrupted, opener_of


class ExitCode(IntEnum):
    """How the command ended."""

    DONE = 0
    BAD_INPUT = 2
    INFEASIBLE = 3
    NOT_VERIFIED = 4
    INTERRUPTED = 130


RESUMABLE = "the same command resumes from there"
CODES = {
    "verified": ExitCode.DONE,
    "not_verified": ExitCode.NOT_VERIFIED,
    "infeasible": ExitCode.INFEASIBLE,
}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(ExitCode.BAD_INPUT, f"{' '.join(message.split())}; see {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    result = _Parser(prog="python -m surrogates.retrain", description=__doc__)
    default = Settings()
    result.add_argument("run", metavar="RUN_DIR", type=Path, help="the run folder")
    result.add_argument(
        "--out", metavar="DIR", type=Path, help="retrain a copy there (default: RUN_DIR itself)"
    )
    result.add_argument(
        "--budget",
        metavar="N",
        type=_whole,
        default=default.budget,
        help="evaluations that retraining may add in all (default: %(default)s)",
    )
    result.add_argument(
        "--tolerance",
        metavar="X",
        type=_fraction,
        help="relative agreement of prediction and truth (default: the case's)",
    )
    result.add_argument(
        "--batch",
        metavar="Q",
        type=_whole,
        default=default.batch,
        help="points a round (default: %(default)s)",
    )
    result.add_argument(
        "--explore",
        metavar="SHARE",
        type=_share,
        default=default.explore,
        help="share of a batch at the largest deviation (default: %(default)s)",
    )
    result.add_argument(
        "--workers",
        metavar="N",
        type=_whole,
        default=len(os.sched_getaffinity(0)),
        help="worker processes (default: all cores)",
    )
    result.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="evaluate on the cluster at tcp://host:port, if the truth knows clusters; --workers "
        "then has no effect",
    )
    result.add_argument("--seed", metavar="N", type=_natural, default=0, help="default: 0")
    result.add_argument("--quiet", action="store_true", help="no progress, no summary")
    result.add_argument(
        "--no-user-code",
        action="store_true",
        help="refuse a run folder whose truth is code that comes with it",
    )
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    begun()
    try:
        options = parser().parse_args(argv)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else ExitCode.DONE
    run, quiet = options.run, options.quiet
    folder = run if options.out is None else options.out
    settings = Settings(options.budget, options.batch, options.explore, options.seed)
    try:
        opener = opener_of(run)
        if folder != run:
            copy_run(run, folder)
        opened = opener(
            folder, tolerance=options.tolerance, workers=options.workers,
            scheduler=options.scheduler, seed=options.seed, quiet=quiet,
            user_code=not options.no_user_code,
        )  # fmt: skip
        with ctrl_c_noticed(), opened as truth:
            outcome = retrain(folder, truth, settings, quiet)
    except (TruthError, SurrogateFileError, SurrogateFitError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return ExitCode.BAD_INPUT
    except OSError as error:
        print(f"{error.filename or folder}: {error.strerror or error}", file=sys.stderr)
        return ExitCode.BAD_INPUT
    except MemoryError:
        print(f"{folder}: not enough memory; retrain with fewer samples", file=sys.stderr)
        return ExitCode.BAD_INPUT
    except TruthInterrupted as error:
        print(f"interrupted: {error}; {RESUMABLE}", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except BaseException as error:
        if not was_ctrl_c(error):
            raise
        print(f"interrupted; {RESUMABLE}", file=sys.stderr)
        return ExitCode.INTERRUPTED
    if not quiet:
        print(f"{outcome.status} ({outcome.reason}): {outcome.rounds} rounds, {outcome.spent} "
              f"evaluations, surrogate {outcome.version} in {folder}")  # fmt: skip
    elif outcome.status != "verified":
        print(f"{folder}: {outcome.status} ({outcome.reason})", file=sys.stderr)
    return CODES[outcome.status]


def _number(text: str, low: float, high: float, words: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no {words}; give one")
    return value


def _fraction(text: str) -> float:
    return _number(text, 1e-12, 0.5, "number from 1e-12 to 0.5")


def _share(text: str) -> float:
    return _number(text, 0.0, 1.0, "share from 0 to 1")


def _natural(text: str) -> int:
    if not (text.isdecimal() and len(text) < 10):
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no whole number; give one")
    return int(text)


def _whole(text: str) -> int:
    value = _natural(text)
    if value < 1:
        raise argparse.ArgumentTypeError("0 is too few; give 1 or more")
    return value


if __name__ == "__main__":
    raise SystemExit(main())
