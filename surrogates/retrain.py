"""`python -m surrogates.retrain RUN_DIR`: new truth where it helps the optimum most, then refit."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from surrogates.files import copy_run
from surrogates.interface import SurrogateFitError
from surrogates.interrupts import begun, ctrl_c_noticed, was_ctrl_c
from surrogates.options import ExitCode, Parser, number, one_line, usable_cores, whole
from surrogates.retraining import Settings, retrain
from surrogates.serialise import SurrogateFileError
from surrogates.truth import TruthError, TruthInterrupted, opener_of

RESUMABLE = "the same command resumes from there"

def parser() -> argparse.ArgumentParser:
    """The command's options."""
    result = Parser(prog="python -m surrogates.retrain", description=__doc__)
    default = Settings()
    add = result.add_argument
    add("run", metavar="RUN_DIR", type=Path, help="the run folder")
    add("--out", metavar="DIR", type=Path,
        help="retrain a copy there (default: RUN_DIR itself)")  # fmt: skip
    add("--budget", metavar="N", type=whole(1), default=default.budget,
        help="evaluations that retraining may add in all (default: %(default)s)")  # fmt: skip
    add("--tolerance", metavar="X", type=number(1e-12, 0.5),
        help="relative agreement of prediction and truth (default: the case's)")  # fmt: skip
    add("--batch", metavar="Q", type=whole(1), default=default.batch,
        help="points a round (default: %(default)s)")  # fmt: skip
    add("--explore", metavar="SHARE", type=number(0.0, 1.0), default=default.explore,
        help="share of a batch at the largest deviation (default: %(default)s)")  # fmt: skip
    add("--workers", metavar="N", type=whole(1), default=usable_cores(),
        help="worker processes (default: all cores)")  # fmt: skip
    add("--scheduler", metavar="ADDRESS",
        help="evaluate on the cluster at tcp://host:port, if the truth knows clusters; --workers "
        "then has no effect")  # fmt: skip
    add("--seed", metavar="N", type=whole(0), default=0, help="default: 0")
    add("--quiet", action="store_true", help="no progress, no summary")
    add("--no-user-code", action="store_true",
        help="refuse a run folder whose truth is code that comes with it")  # fmt: skip
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
        print(one_line(error), file=sys.stderr)
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
    return ExitCode.of(outcome.status)


if __name__ == "__main__":
    raise SystemExit(main())
