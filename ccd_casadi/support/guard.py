"""A command whose plant is code runs in a process that another one waits for.

That code, or a library that it calls, may end its process at any call, and with any exit code: 0
would say that a design is verified. Linux only; elsewhere commands run as they are.
"""

import os
import select
import signal
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from ccd_casadi.support.options import ExitCode
from ccd_casadi.support.terminal import say

CRASHES = ("SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE", "SIGABRT")
DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl


def guarded(place: Path) -> Callable[[], object]:
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
