"""What every command shares: its options, its exit codes, and one line for a user's mistake."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from enum import IntEnum
from pathlib import Path

from ccd_casadi.errors import UserError
from ccd_casadi.parallel import usable_cores

DEFAULT_CASE = "runs/two_mass.toml"


class ExitCode(IntEnum):
    """How a command ended."""

    DONE = 0
    BAD_INPUT = 2
    INFEASIBLE = 3
    NOT_VERIFIED = 4
    INTERRUPTED = 130


def parser(command: str, description: str, *, case_required: bool = False) -> argparse.ArgumentParser:
    """A parser with the positional CASE and --out, --workers, --seed, --quiet."""
    result = argparse.ArgumentParser(prog=f"python -m {command}", description=description)
    if case_required:
        result.add_argument("case", metavar="CASE.toml", type=Path, help="the case file")
    else:
        result.add_argument(
            "case",
            metavar="CASE.toml",
            nargs="?",
            type=Path,
            default=Path(DEFAULT_CASE),
            help=f"the case file (default: {DEFAULT_CASE})",
        )
    result.add_argument("--out", metavar="DIR", type=Path, help="the run folder")
    result.add_argument(
        "--workers", metavar="N", type=_positive, default=usable_cores(),
        help="worker processes (default: all cores)",
    )  # fmt: skip
    result.add_argument("--seed", metavar="N", type=_natural, default=0, help="default: 0")
    result.add_argument("--quiet", action="store_true", help="no progress, no summary")
    return result


def run(
    main: Callable[[argparse.Namespace], ExitCode],
    arguments: argparse.ArgumentParser,
    argv: Sequence[str] | None = None,
) -> int:
    """Parse, run, and turn a user's mistakes and Ctrl-C into an exit code and one line."""
    options = arguments.parse_args(argv)
    try:
        return int(main(options))
    except UserError as error:
        print(error, file=sys.stderr)
        return ExitCode.BAD_INPUT
    except KeyboardInterrupt:
        print(
            "\ninterrupted: what is sampled is kept; the same command goes on from there",
            file=sys.stderr,
        )
        return ExitCode.INTERRUPTED
    except BrokenPipeError:
        # The reader of stdout went away; point it elsewhere so that the exit stays quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.DONE


def run_folder(case: Path, out: Path | None) -> Path:
    """Make the run folder: --out, or the case file's path without its suffix.

    Raises UserError where it cannot be made or written.
    """
    folder = case.with_suffix("") if out is None else out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UserError(f"{folder}: exists and is no folder; choose another --out") from None
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be made: {error.strerror}; choose another --out"
        ) from None
    if not os.access(folder, os.W_OK):
        raise UserError(f"{folder}: is not writable; choose another --out")
    return folder


def _positive(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return value


def _natural(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)
