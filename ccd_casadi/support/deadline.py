"""A process for calls that may never return: killed at its deadline, started anew.

Compiled code that loops cannot be interrupted from Python; its process can. What goes through
the pipe is pickled between this process and its own child, and never stored.
"""

import math
import pickle
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ParamSpec, Self, TypeVar

from ccd_casadi.support.worker_process import WorkerProcess, interrupts_held, track_resources

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

    def __exit__(self, *_: object) -> None:
        if self._worker is not None:
            with interrupts_held():
                self._worker.end()
        self._worker = None

    def call(
        self, seconds: float, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """function(*args, **kwargs), in that process; whatever it raises is raised here.

        Raises Overrun after `seconds`, and where the process dies.
        """
        try:
            if self._worker is None or not self._worker.process.is_alive():
                self.__exit__()
                track_resources()
                with interrupts_held():
                    self._worker = WorkerProcess()
                _answer(self._worker, bool, None, STARTING)
            done, value = _answer(self._worker, _apply, (seconds, function, args, kwargs), seconds)
        except BaseException:  # what it is doing is of no use any more
            self.__exit__()
            raise
        if not done:
            raise value
        result: R = value
        return result


def _answer(
    worker: WorkerProcess, function: Callable[[Any], object], task: object, seconds: float
) -> tuple[bool, Any]:
    """(True, what a task comes to) or (False, what it raises)."""
    worker.send(pickle.dumps((function, task)))
    with suppress(OSError):  # it is dead: its answer says so
        if not worker.pipe.poll(seconds):
            raise Overrun(f"no answer within {seconds:g} s")
    answer = worker.answer()
    if answer is None:
        raise Overrun("the process died")
    found: tuple[bool, Any] = pickle.loads(answer)  # our own child wrote it, into its pipe
    return found


def _apply(task: tuple) -> object:
    """The call, and the end of this process should it go on when its parent is gone."""
    seconds, function, args, kwargs = task
    with suppress(ImportError):  # Windows has no such limit: the parent alone ends the process
        import resource

        spent = math.ceil(time.process_time() + seconds + GRACE)
        resource.setrlimit(resource.RLIMIT_CPU, (spent, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    return function(*args, **kwargs)
