"""A process for calls that may never return: killed at its deadline, started anew.

Compiled code that loops cannot be interrupted from Python; its process can. What goes through
the pipe is pickled between this process and its own child, and never stored.
"""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import ParamSpec, Self, TypeVar

from ccd_casadi.support.worker_process import Ahead, WorkerLost
from ccd_casadi.support.worker_process import Overrun as Overrun

P = ParamSpec("P")
R = TypeVar("R")

GRACE = 2.0  # s of processor time beyond the deadline, after which the system ends the process
STARTING = 60.0  # seconds that the process itself may take to come up


class Runner:
    """One process for calls with a deadline each; a context manager."""

    def __init__(self) -> None:
        self._process: Ahead | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.__exit__()
        self._process = None

    def call(
        self, seconds: float, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """function(*args, **kwargs), in that process; whatever it raises is raised here.

        Raises Overrun after `seconds`, and where the process dies.
        """
        try:
            if self._process is None or not self._process.alive():
                self.__exit__()
                self._process = Ahead(int)
                self._process.answer(STARTING)
            self._process.begin(_apply, (seconds, function, args, kwargs))
            done, value = self._process.answer(seconds)
        except BaseException as error:  # what it is doing is of no use any more
            self.__exit__()
            if isinstance(error, WorkerLost):
                raise Overrun("the process died") from None
            raise
        if not done:
            raise value
        result: R = value
        return result


def _apply(task: tuple) -> object:
    """The call, and the end of this process should it go on when its parent is gone."""
    seconds, function, args, kwargs = task
    with suppress(ImportError):  # Windows has no such limit: the parent alone ends the process
        import resource

        spent = math.ceil(time.process_time() + seconds + GRACE)
        resource.setrlimit(resource.RLIMIT_CPU, (spent, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    return function(*args, **kwargs)
