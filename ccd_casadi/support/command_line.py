"""What every command shares: its options, its exit codes, a line for a mistake, and its process.

A command whose plant is code runs in a process that another one waits for. That code, or a library
that it calls, may end its process at any call, and with any exit code: 0 would say that a design is
verified. Linux only; elsewhere commands run as they are.
"""

import argparse
import gc
import os
import select
import signal
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any, NoReturn

from ccd_casadi.support.errors import (
    PlantError,
    UserError,
    ctrl_c_noticed,
    raise_on_ctrl_c,
    was_ctrl_c,
)
from ccd_casadi.support.options import (
    DEFAULT_CASE,
    ExitCode,
    Option,
    Parser,
    integer,
    one_line,
    usable_cores,
)
from ccd_casadi.support.options import option as option
from ccd_casadi.support.terminal import keep_quiet, say
from ccd_casadi.support.user_code import permit_user_code
from ccd_casadi.support.worker_process import (
    WorkerLost,
    import_ahead,
    one_blas_thread,
    threads_permitted,
)

CRASHES = ("SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE", "SIGABRT")
DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl


def run_guarded(place: Path) -> Callable[[], object]:
    """Go on in another process where the plant of a case or run folder is code; what is given is to
    be called before that ends in order. The process that waits does not return."""
    if not (sys.platform.startswith("linux") and _is_command() and _is_code(place)):
        return lambda: None
    watched = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, watched)
    parent, (read, write) = os.getpid(), os.pipe()
    child = os.fork()  # nothing has begun: this process has one thread
    if child == 0:
        import ctypes  # slow to import

        ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(ExitCode.INTERRUPTED)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return lambda: os.write(write, b".")
    os.close(write)
    while True:
        info = signal.sigwaitinfo(watched)
        if info.si_signo == signal.SIGCHLD:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                _end_as(os.waitstatus_to_exitcode(status), read, place)
        elif info.si_code <= 0:  # by kill; a terminal's goes to both
            os.kill(child, info.si_signo)


def _end_as(code: int, read: int, place: Path) -> NoReturn:
    """End as a process did, unless it never said that it would."""
    in_order = bool(select.select([read], [], [], 0.0)[0]) and bool(os.read(read, 1))
    crash = code < 0 and signal.Signals(-code).name in CRASHES
    if code < 0 and not crash:
        signal.signal(-code, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {-code})
        os.kill(os.getpid(), -code)
    if crash or not (in_order or code == ExitCode.INTERRUPTED):
        how = signal.Signals(-code).name if crash else f"exit code {code}"
        words = f"its function, or a library that it calls, ended the program ({how}); correct it"
        say(f"{place}: plant: {words}", sys.stderr)
        code = ExitCode.BAD_INPUT
    os._exit(code)


def _is_command() -> bool:
    """Whether this process is a command, not a program that calls one."""
    main = getattr(sys.modules["__main__"], "__spec__", None)
    package = "" if main is None else main.name.partition(".")[0]
    return package in ("ccd_casadi", "surrogates") or Path(sys.argv[0]).stem == "ccd"


def _is_code(place: Path) -> bool:
    """Whether the plant of a case is a function; a file that is no case is read elsewhere."""
    try:
        file = place / "case.toml" if place.is_dir() else place
        return "function" in tomllib.loads(file.read_text(encoding="utf-8-sig"))["plant"]
    except (OSError, ValueError, LookupError, TypeError):
        return False


_DISK = "free the disk or choose another --out, then repeat the command: it resumes"
_NO_MEMORY = "not enough memory; give the plant fewer modes, or fewer --workers"
Body = Callable[[argparse.Namespace], ExitCode]  # what a command does; `seconds()`: since it began
_RESUMABLE = "what is sampled is kept; the same command resumes from there"
# What a command is about, as argparse takes its positional.
CASE = {"dest": "case", "metavar": "CASE.toml", "nargs": "?", "default": Path(DEFAULT_CASE),
        "help": f"the case file (default: {DEFAULT_CASE})"}  # fmt: skip
RUN = {"dest": "run", "metavar": "RUN_DIR", "help": "the folder of a finished solve"}


def program(command: str) -> str:
    """Return how a command was called: `ccd solve` or `python -m ccd_casadi.solve`.

    Parameters
    ----------
    command : str
        Dotted name of its module.

    Returns
    -------
    str
    """
    called = Path(sys.argv[0]).stem if sys.argv else ""
    return f"ccd {command.rpartition('.')[2]}" if called == "ccd" else f"python -m {command}"


def parser(
    command: str,
    description: str,
    place: Mapping[str, Any] = CASE,
    *,
    without_effect: Sequence[str] = (),
) -> argparse.ArgumentParser:
    """A parser with the positional `place` and --out, --workers, --seed, --quiet, --no-user-code.

    What is `without_effect` is accepted, as scripts give every command the same options, and is
    not in --help.
    """
    codes = "Exit codes: " + ", ".join(f"{code:d} {code.words}" for code in ExitCode)
    result = Parser(prog=program(command), description=description, epilog=codes)
    result.add_argument(type=Path, **place)

    shared: dict[str, dict[str, Any]] = {
        "--out": {"metavar": "DIR", "type": _folder, "help": "the folder to write into"},
        "--workers": {"metavar": "N", "type": integer(1), "default": usable_cores(),
                      "help": "worker processes (default: all cores)"},
        "--seed": {"metavar": "N", "type": integer(0), "default": 0,
                   "help": "seed of all random numbers (default: 0)"},
        "--quiet": {"action": "store_true", "help": "print no progress and no summary"},
        "--no-user-code": {"action": "store_true",
                           "help": "refuse a case whose plant is a Python function"},
    }  # fmt: skip
    for name, how in shared.items():
        reported = argparse.SUPPRESS if name in without_effect else how["help"]
        result.add_argument(name, **how | {"help": reported})
    return result


SCHEDULER = option(
    "--scheduler", metavar="ADDRESS",
    help="sample on the Dask cluster at tcp://host:port; --workers then has no effect",
)  # fmt: skip


def command(
    name: str, description: str, *options: Option, needs: Sequence[str],
    early: Callable[[argparse.Namespace], Sequence[str]] = lambda options: (), **how: Any,
) -> Callable[[Body], Callable[..., int]]:  # fmt: skip
    """Decorate a function of parsed options as the entry point of a command.

    Parameters
    ----------
    name, description : str
        Dotted name of the module, and the first line of --help.
    *options : Option
        What is added to the options of every command.
    needs, early
        As in `run`.
    **how
        As in `parser`.

    Returns
    -------
    callable
        The decorator; the entry point takes a list of words and returns an exit code.
    """

    def entry_of(body: Body) -> Callable[..., int]:
        @wraps(body)
        def main(argv: Sequence[str] | None = None) -> int:
            arguments = parser(name, description, **how)
            for add in options:
                add(arguments)
            return run(body, arguments, argv, needs=needs, early=early)

        return main

    return entry_of


def run(
    main: Body,
    arguments: argparse.ArgumentParser,
    argv: Sequence[str] | None = None,
    *,
    needs: Sequence[str] = (),
    early: Callable[[argparse.Namespace], Sequence[str]] = lambda options: (),
) -> int:
    """Parse, run, and turn a user's mistakes and Ctrl-C into an exit code and one line.

    The modules `needs` are what `main` imports that takes time: they are imported once the options
    are known to be right, and while a Ctrl-C still finds nothing begun. Meanwhile those of `early`
    are imported for the worker processes of `main`.
    """
    code = ExitCode.INTERRUPTED
    try:
        options = arguments.parse_args(argv)
    except SystemExit as ended:  # after --help or a wrong option
        raise_on_ctrl_c()
        return ended.code if isinstance(ended.code, int) else ExitCode.DONE
    in_order = run_guarded(Path(str(_place(options))))
    # Libraries make a million objects that last, and few cycles: looking for those after every 700
    # new ones was a twelfth of a short solve.
    gc.set_threshold(50_000, 20, 100)
    if (of_workers := early(options)) and options.workers > 1:
        import_ahead(of_workers)
    for module in needs:
        import_module(module)
    gc.freeze()  # what modules made lasts: a collection without it takes a seventh of the time
    raise_on_ctrl_c()
    try:
        with (
            one_blas_thread,
            threads_permitted(getattr(options, "workers", 1)),
            permit_user_code(not options.no_user_code),
            keep_quiet(options.quiet),
            ctrl_c_noticed(),
        ):
            began = perf_counter()
            options.seconds = lambda: perf_counter() - began
            code = main(options)
        sys.stdout.flush()  # here, where a reader that went away can still be dealt with
    except PlantError as error:  # at some θ: what evaluates a plant knows of no case file
        say(one_line(f"{_place(options)}: plant: {error}"), sys.stderr)
        return ExitCode.BAD_INPUT
    except UserError as error:
        say(one_line(error), sys.stderr)
        return ExitCode.BAD_INPUT
    except WorkerLost as error:
        say(f"interrupted: {one_line(error)}; {_RESUMABLE}", sys.stderr)
    except MemoryError:
        say(f"{_place(options)}: {_NO_MEMORY}", sys.stderr)
        return ExitCode.BAD_INPUT
    except BrokenPipeError:
        # The reader of stdout went away; point it elsewhere so that the exit stays quiet.
        # What main concluded stands; if it was cut short, it was interrupted.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:  # the disk is full, or a file became unreadable
        where = error.filename or _place(options)
        say(one_line(f"{where}: {error.strerror or error}; {_DISK}"), sys.stderr)
        return ExitCode.BAD_INPUT
    except BaseException as error:
        if not was_ctrl_c(error):
            raise
        say(f"interrupted: {_RESUMABLE}", sys.stderr)
    finally:
        gc.unfreeze()  # cycles that an earlier command had left were frozen too
        in_order()
    return int(code)


def _place(options: argparse.Namespace) -> object:
    """The case file or run folder that a command was given."""
    return getattr(options, "case", None) or getattr(options, "run", "")


def run_folder(case: Path, out: Path | None) -> Path:
    """Make the run folder: --out, or the case file's path without its suffix.

    Parameters
    ----------
    case : Path
    out : Path, optional

    Returns
    -------
    Path

    Raises
    ------
    UserError
        It cannot be made or written.
    """
    folder = case.with_suffix("") if out is None else out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UserError(f"{folder}: exists and is not a folder; choose another --out") from None
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be made: {error.strerror}; choose another --out"
        ) from None
    if not os.access(folder, os.W_OK):
        raise UserError(f"{folder}: is not writable; choose another --out")
    return folder


def _folder(text: str) -> Path:
    """A directory that is there and writable, or could be made; nothing is made yet."""
    place = os.path.abspath(text)
    while not os.path.lexists(place):
        place = os.path.dirname(place)
    if not os.path.isdir(place):
        raise argparse.ArgumentTypeError(f"{place} is not a directory; choose another")
    if not os.access(place, os.W_OK | os.X_OK):
        raise argparse.ArgumentTypeError(f"{place} is not writable; choose another")
    return Path(text)
