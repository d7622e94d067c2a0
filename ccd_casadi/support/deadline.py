"""A process for calls that may never return: killed at its deadline, started anew.

Compiled code that loops cannot be interrupted from Python; its process can. What goes through
the pipe is pickled between this process and its own child, and never stored.
"""

import math
import multiprocessing
import pickle
import resource
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

from threadpoolctl import threadpool_limits

from ccd_casadi.support.worker_process import answered

P = ParamSpec("P")
R = TypeVar("R")

GRACE = 2.0  # s of processor time beyond the deadline, after which the system ends the process
STARTING = 60.0  # seconds that the process itself may take to come up
_SPAWN = multiprocessing.get_context("spawn")


class Overrun(RuntimeError):
    """The call did not return within its time, or its process died."""


class Runner:
    """One process for calls with a deadline each; a context manager."""

    def __init__(self) -> None:
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    def call(
        self, seconds: float, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """function(*args, **kwargs), in that process; whatever it raises is raised here.

        Raises Overrun after `seconds`, and where the process dies.
        """
        pipe = self._ready()
        try:
            pipe.send_bytes(pickle.dumps((_apply, (seconds, function, args, kwargs))))
            if not pipe.poll(seconds):
                raise Overrun(f"no answer within {seconds:g} s")
            done, value = pickle.loads(pipe.recv_bytes())  # our own child wrote it
        except (EOFError, OSError):
            self._end()
            raise Overrun("the process died") from None
        except BaseException:  # an overrun, or Ctrl-C: what it is doing is of no use any more
            self._end()
            raise
        if not done:
            raise value
        result: R = value
        return result

    def _ready(self) -> Connection:
        if self._pipe is None or self._process is None or not self._process.is_alive():
            self._end()
            self._pipe, theirs = _SPAWN.Pipe()
            self._process = _SPAWN.Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()
            if not self._pipe.poll(STARTING):
                self._end()
                raise Overrun(f"the process did not start within {STARTING:g} s")
            self._pipe.recv_bytes()
        return self._pipe

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None


def _apply(task: tuple) -> object:
    """The call, and the end of this process should it go on when its parent is gone."""
    seconds, function, args, kwargs = task
    spent = math.ceil(time.process_time() + seconds + GRACE)
    resource.setrlimit(resource.RLIMIT_CPU, (spent, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    return function(*args, **kwargs)


def _serve(pipe: Connection) -> None:
    """Answer until the pipe ends; a first message says that the process is up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to deal with
    try:
        with threadpool_limits(limits=1):
            pipe.send_bytes(b"")
            while True:
                pipe.send_bytes(answered(pipe.recv_bytes()))
    except (EOFError, OSError):
        return
