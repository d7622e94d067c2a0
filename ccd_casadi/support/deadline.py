"""A process for calls that may never return: killed at its deadline, started anew.

Compiled code that loops cannot be interrupted from Python; its process can. What goes through
the pipe is pickled between this process and its own child, and never stored.
"""

import math
import pickle
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

from ccd_casadi.support.worker_process import WorkerProcess, called, interrupts_held

P = ParamSpec("P")
R = TypeVar("R")

GRACE = 2.0  # s of processor time beyond the deadline, after which the system ends the process
STARTING = 60.0  # seconds that the process itself may take to come up


class Overrun(RuntimeError):
    """The call did not return within its time, or its process died."""


class Runner:
    """One process for calls with a deadline each; a context manager."""

    def __init__(self) -> None:
        self._worker: WorkerProcess | None = None

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
        pipe = self._ready().pipe
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

    def _ready(self) -> WorkerProcess:
        if self._worker is None or not self._worker.process.is_alive():
            self._end()
            with interrupts_held():
                self._worker = WorkerProcess()
            self._worker.send(pickle.dumps((called, int)))  # answered as soon as it is up
            if not self._worker.pipe.poll(STARTING):
                self._end()
                raise Overrun(f"the process did not start within {STARTING:g} s")
            self._worker.answer()
        return self._worker

    def _end(self) -> None:
        if self._worker is not None:
            self._worker.end()
        self._worker = None


def _apply(task: tuple) -> object:
    """The call, and the end of this process should it go on when its parent is gone."""
    seconds, function, args, kwargs = task
    with suppress(ImportError):  # Windows has no such limit: the parent alone ends the process
        import resource

        spent = math.ceil(time.process_time() + seconds + GRACE)
        resource.setrlimit(resource.RLIMIT_CPU, (spent, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    return function(*args, **kwargs)
