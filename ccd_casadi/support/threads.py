"""Threads: one for BLAS, and some for work that releases Python's lock, as sparse factorisations.

A command permits as many as it may have workers; a worker process has one, as the others have the
rest of the machine.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ContextDecorator, contextmanager
from contextvars import copy_context
from functools import cache
from typing import TYPE_CHECKING, Generic, TypeVar

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:  # no command needs it to start
    from concurrent.futures import ThreadPoolExecutor

T = TypeVar("T")
R = TypeVar("R")

_permitted = [1]
_here = threading.local()


class _OneBlasThread(ContextDecorator):
    """The limit is the process's: the first to come sets it, and the last to go lifts it."""

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._limits = threadpool_limits(limits=1)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limits.restore_original_limits()


# Around what computes: matrices are small, and results must not depend on the number of cores.
one_blas_thread = _OneBlasThread()


class OwnThreads(Generic[T]):
    """Something that the thread which made it has to free, as SciPy's SuperLU: another leaks it.

    What other threads let go is freed when its thread makes the next one.
    """

    def __init__(self, make: Callable[[], T]) -> None:
        if not hasattr(_here, "let_go"):
            _here.let_go = deque()
        self._let_go: deque[T] = _here.let_go
        self._let_go.clear()
        self.value = make()

    def __del__(self) -> None:
        if getattr(_here, "let_go", None) is not self._let_go and hasattr(self, "value"):
            self._let_go.append(self.value)


@contextmanager
def threads_permitted(count: int) -> Iterator[None]:
    """Let `side_by_side` use up to `count` threads in this process."""
    _permitted.append(max(1, count))
    try:
        yield
    finally:
        _permitted.pop()


@cache
def _threads(count: int) -> "ThreadPoolExecutor":
    """They last: what a thread made it may have to free."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(count, "side_by_side")


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """[function(item), ...] in the items' order, begun in that order: the longest ones first.

    Not from within `function`: its threads would wait for each other.

    >>> with threads_permitted(2):
    ...     side_by_side(abs, [-3, 2, -1])
    [3, 2, 1]
    """
    todo = list(items)
    count = min(_permitted[-1], len(todo))
    if count <= 1:
        return [function(item) for item in todo]
    return list(_threads(count).map(function, todo))


def alongside(function: Callable[[], R]) -> Callable[[], R]:
    """Begin a function in a thread; what is given waits for its result, or raises what it raised.

    For work that processes do: of two that compute here each has the lock half of the time. Nothing
    waits for the thread where its result is not wanted any more, as after Ctrl-C.

    >>> alongside(lambda: 3)()
    3
    """
    from concurrent.futures import Future

    answer: Future[R] = Future()

    def run() -> None:
        try:
            answer.set_result(function())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(None, copy_context().run, "alongside", (run,), daemon=True).start()
    return answer.result
