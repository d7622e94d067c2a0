"""A pool of worker processes, one BLAS thread each, that ends promptly and leaves no orphans.

A task whose worker dies is tried once more, in a new one. Tasks inside a task of a worker are done
with the help of workers that are idle. The process that sends tasks offers its idle workers to
those that still work. A worker that maps over tasks of its own lends one for each offer, and does
the others itself. A lent task comes to what it comes to here: results do not depend on who was
idle.
"""

import pickle
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from multiprocessing import connection
from reprlib import Repr
from typing import Any, Protocol, Self, TypeVar, cast

from ccd_casadi.support import extensions
from ccd_casadi.support.errors import UserError, raise_dropped
from ccd_casadi.support.time_budget import InTime
from ccd_casadi.support.worker_process import (
    BACK,
    LEND,
    OFFER,
    R,
    T,
    WorkerLost,
    WorkerProcess,
    imported_ahead,
    interrupts_held,
    offers,
)


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


K = TypeVar("K")
Running = dict[connection.Connection, tuple[WorkerProcess, int]]  # by pipe, and the task's number
_SHORT = Repr()
_SHORT.maxother = _SHORT.maxstring = 60


@dataclass(frozen=True)
class PoolOptions:
    """Thresholds from which worker processes pay.

    Attributes
    ----------
    patience : float
        Work in s below which no processes are started.
    forked_patience : float
        The same in s where processes are forked and need not import.
    """

    patience: float = 2.0
    forked_patience: float = 0.3


class Pool(Protocol):
    """A context manager that spreads tasks over processes: `Workers`, or a `Cluster` (Dask).

    Leaving it ends or abandons the tasks in flight.

    Attributes
    ----------
    count : int
        Tasks that run at a time.
    """

    @property
    def count(self) -> int:
        """The number of tasks that run at a time."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Every task's result exactly once, as they complete; one map at a time.

        Raises WorkerLost where a task's workers die again and again, and whatever `function`
        raises (with the worker's traceback as a note).
        """


class Workers(AbstractContextManager["Workers"]):
    """A process pool that starts on demand; with one worker the tasks run in this process.

    Processes import NumPy with one BLAS thread. They ignore Ctrl-C, which the parent handles, and
    end when the parent does, however it ends.

    Parameters
    ----------
    count : int
        Processes at most.
    patience : float
        Work in s below which no processes are started.
    """

    def __init__(self, count: int, patience: float = 0.0) -> None:
        self.count = max(1, count)
        self.patience = patience
        self._workers: list[WorkerProcess] = []
        self._mapping, self._ended = False, 0.0

    def __exit__(self, *_: object) -> None:
        self._end(self._workers)

    @property
    def processor_seconds(self) -> float:
        """The processor time of its processes up to now, s."""
        return self._ended + sum(worker.processor_seconds for worker in self._workers)

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Map as `Pool` states. A task whose worker dies is tried once more, in a new one.

        A worker holds one task, and has its next before a result is handed out. Raises RuntimeError
        where another map is not yet finished.
        """
        began, done_here = time.monotonic(), 0
        alone = self.count == 1 or len(tasks) <= 1
        patience = (
            min(self.patience, PoolOptions.forked_patience) if imported_ahead() else self.patience
        )
        while done_here < len(tasks) and (alone or not self._workers):
            raise_dropped()
            each = (time.monotonic() - began) / done_here if done_here else 0.0
            left = each * (len(tasks) - done_here)
            if not alone and (patience == 0.0 or left > patience):
                break
            yield function(tasks[done_here])
            done_here += 1
        if done_here == len(tasks):
            return
        if self._mapping:
            raise RuntimeError("these workers are busy with another map: finish or close that one")
        self._mapping = True
        waiting, retried = deque(range(done_here, len(tasks))), set[int]()
        running: Running = {}
        helping = _Helping()
        in_time = InTime(function)
        try:
            while waiting or running:
                raise_dropped()
                self._feed(in_time, tasks, waiting, running, helping)
                if not waiting:
                    helping.offer(running, self.count)
                for pipe in connection.wait([*running, *helping.busy]):
                    assert isinstance(pipe, connection.Connection)
                    if pipe in helping.busy:
                        self._end(helping.give_back(pipe))
                        continue
                    worker, index = running[pipe]
                    try:
                        done, value = worker.answer()
                        if done == LEND:
                            helping.lend(worker, self._idle([*running, *helping.busy]), *value)
                            continue
                    except WorkerLost:
                        code = worker.process.exitcode
                        self._end([worker])
                        del running[pipe]
                        if index in retried:
                            words = f"exit code {code}; -9: killed, perhaps out of memory"
                            held = _SHORT.repr(tasks[index])
                            raise WorkerLost(
                                f"a worker process died twice ({words}) on the task {held}"
                            ) from None
                        retried.add(index)
                        waiting.appendleft(index)
                        continue
                    # Only now: an interrupted answer leaves the worker among those to be ended.
                    del running[pipe]
                    self._feed(in_time, tasks, waiting, running, helping)
                    if not done:
                        raise value
                    yield value
        finally:
            self._mapping = False
            self._end([worker for worker, _ in running.values()])
            self._end([helper for helper, _, _ in helping.busy.values()])

    def _feed(
        self, function: Callable[[T], R], tasks: Sequence[T], waiting: deque[int],
        running: Running, helping: "_Helping",
    ) -> None:  # fmt: skip
        """Give every idle worker a task, starting processes up to `count`."""
        while waiting and len(running) + len(helping.busy) < self.count:
            worker, index = self._idle([*running, *helping.busy]), waiting[0]
            running[worker.pipe] = (worker, waiting.popleft())
            worker.begin(function, tasks[index])

    def _idle(self, busy: Sequence[connection.Connection]) -> WorkerProcess:
        """A worker with nothing to do, started where there is none."""
        idle = [worker for worker in self._workers if worker.pipe not in busy]
        dead = [worker for worker in idle if not worker.process.is_alive()]
        self._end(dead)  # between two tasks: no task is to blame
        if len(idle) == len(dead):
            with interrupts_held():
                self._workers.append(WorkerProcess())
            idle = self._workers[-1:]
        return next(one for one in idle if one not in dead)

    def _end(self, workers: list[WorkerProcess]) -> None:
        with interrupts_held():
            for worker in [worker for worker in workers if worker in self._workers]:
                self._ended += worker.processor_seconds
                worker.end()
                self._workers.remove(worker)


class _Helping:
    """Idle workers that are offered to those at work on the last tasks of a map, and lent tasks.

    A worker at work has one offer or one helper at most: else both ends of its pipe might wait to
    be read.

    `busy`: by the pipe of a helper itself, whom it helps and the number of its task; `offered`:
    pipes of workers with an offer.
    """

    def __init__(self) -> None:
        self.busy: dict[connection.Connection, tuple[WorkerProcess, WorkerProcess, int]] = {}
        self.offered: set[connection.Connection] = set()

    def offer(self, running: Running, count: int) -> None:
        """Offer the workers that are idle."""
        self.offered &= running.keys()
        helped = {to.pipe for _, to, _ in self.busy.values()}
        free = count - len(running) - len(self.busy) - len(self.offered)
        alone = [pipe for pipe in running if pipe not in self.offered | helped]
        for pipe in alone[: max(free, 0)]:
            self.offered.add(pipe)
            running[pipe][0].send(OFFER)

    def lend(self, to: WorkerProcess, helper: WorkerProcess, number: int, payload: bytes) -> None:
        """Let a helper go on with a task of a worker."""
        self.offered.discard(to.pipe)
        self.busy[helper.pipe] = (helper, to, number)
        helper.send(payload)

    def give_back(self, pipe: connection.Connection) -> list[WorkerProcess]:
        """Send what a helper found to whom it helps; the helper, where it has died."""
        helper, to, number = self.busy.pop(pipe)
        try:
            answer = pipe.recv_bytes()
        except (EOFError, OSError):
            answer = b""
        to.send(BACK + pickle.dumps((number, answer)))
        return [] if answer else [helper]


def results(
    workers: Pool | None, function: Callable[..., R], tasks: Mapping[K, tuple[Any, ...]]
) -> Generator[tuple[K, R], None, None]:
    """Run tasks on a pool and yield results as they complete.

    Parameters
    ----------
    workers : Pool or None
        None: in this process.
    function : callable
    tasks : mapping
        Key -> positional arguments of `function`.

    Yields
    ------
    key, result

    Raises
    ------
    WorkerLost
        The workers of a task died twice.
    """
    calls = [(key, function, arguments) for key, arguments in tasks.items()]
    return (workers or Workers(1)).map_unordered(_run_keyed, calls)


def _run_keyed(task: tuple[K, Callable[..., R], tuple[Any, ...]]) -> tuple[K, R]:
    key, function, arguments = task
    return key, function(*arguments)


def pool(scheduler: str | None, count: int, patience: float) -> Pool:
    """Make the pool of a command: local processes, or a Dask cluster.

    Parameters
    ----------
    scheduler : str or None
        Address of a Dask scheduler; None: local processes.
    count : int
        Local processes at most.
    patience : float
        Work in s below which no local processes are started.

    Returns
    -------
    Pool
        A context manager that has not been entered.

    Raises
    ------
    UserError
        The extension `cluster` was removed.
    """
    if scheduler is None:
        return Workers(count, patience)
    cluster = extensions.function("cluster")
    if cluster is None:
        raise UserError(extensions.missing("--scheduler", "functions", "cluster"))
    return cast(Pool, cluster(scheduler))
