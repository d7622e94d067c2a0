"""A pool for tasks inside a task of a worker process: workers that are idle help.

The process that sends tasks offers its idle workers to those that still work. A worker that maps
over tasks of its own lends one for each offer, and does the others itself. A lent task comes to
what it comes to here: results do not depend on who was idle.
"""

import pickle
import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager

from ccd_casadi.support.time_budget import InTime
from ccd_casadi.support.worker_process import R, T, offers


class LentWorkers(AbstractContextManager["LentWorkers"]):
    """The pool of a task: this process, and the idle workers that are offered to it.

    Attributes
    ----------
    count : int
        1: no more are certain.
    """

    count = 1

    def __exit__(self, *_: object) -> None:
        """Workers are ended by who started them."""

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """As `Pool` says."""
        todo, lent = deque(range(len(tasks))), dict[int, int]()  # number -> index
        speaks = threading.current_thread() is threading.main_thread()
        while todo or lent:
            if speaks:
                offers.listen(wait=not todo)
            while speaks and len(todo) > 1 and offers.count:
                index = todo.pop()
                lent[offers.lend(InTime(function), tasks[index])] = index
            for number in [one for one in lent if one in offers.back]:
                index, answer = lent.pop(number), offers.back.pop(number)
                if not answer:
                    todo.append(index)
                    continue
                done, value = pickle.loads(answer)  # of another worker of our parent
                if not done:
                    raise value
                yield value
            if todo:
                yield function(tasks[todo.popleft()])
