"""Threads for work that releases Python's lock, such as sparse factorisations.

A command permits as many as it may have workers; a worker process has one, as the others have the
rest of the machine.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

_permitted = [1]


@contextmanager
def threads_permitted(count: int) -> Iterator[None]:
    """Let `side_by_side` use up to `count` threads in this process."""
    _permitted.append(max(1, count))
    try:
        yield
    finally:
        _permitted.pop()


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """[function(item), ...] in the items' order, begun in that order: the longest ones first.

    >>> with threads_permitted(2):
    ...     side_by_side(abs, [-3, 2, -1])
    [3, 2, 1]
    """
    todo = list(items)
    count = min(_permitted[-1], len(todo))
    if count <= 1:
        return [function(item) for item in todo]
    from concurrent.futures import ThreadPoolExecutor  # no command needs it to start

    with ThreadPoolExecutor(count) as threads:
        return list(threads.map(function, todo))
