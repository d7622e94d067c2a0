"""A pool of worker processes, one BLAS thread each, that ends promptly and leaves no orphans.

Each worker has a pipe of its own: nothing is shared, so a worker may be killed at any moment and
its death concerns the one task that it held. What goes through a pipe is pickled, which is how
Python's processes speak: it comes from processes that this one started, and is never stored.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import connection, resource_tracker
from reprlib import Repr
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from surrogates.interrupts import raise_dropped

T = TypeVar("T")
R = TypeVar("R")

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
PATIENCE = 2.0  # s of work that is not worth starting processes for
_SPAWN = multiprocessing.get_context("spawn")  # a fork would copy locks that threads hold
_SHORT = Repr()
_SHORT.maxother = _SHORT.maxstring = 60


class WorkerLost(RuntimeError):
    """Workers died again and again on one task (killed, or out of memory), or never came back."""


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Pool(Protocol):
    """What spreads tasks over processes: `Workers` here, `cluster.Cluster` over Dask.

    A context manager; leaving it ends or abandons what is in flight.
    """

    @property
    def count(self) -> int:
        """How many tasks run at a time."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Every task's result exactly once, as they complete; one map at a time.

        Raises WorkerLost where a task's workers die again and again, and whatever `function`
        raises (with the worker's traceback as a note).
        """


class Workers:
    """A lazily started process pool; with one worker the tasks run in this process.

    Processes are spawned, never forked, and import NumPy with one BLAS thread. They ignore
    Ctrl-C, which the parent handles, and end when the parent does, however it ends.
    """

    def __init__(self, count: int, patience: float = 0.0) -> None:
        """`patience`: seconds of work below which starting processes does not pay."""
        self.count = max(1, count)
        self.patience = patience
        self._workers: list[_Worker] = []
        self._mapping = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end(self._workers)

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Results as they complete. A task whose worker dies is tried once more, in a new one.

        A worker holds one task, and has its next before a result is handed out. Leaving the
        loop early ends what is in flight.

        Raises WorkerLost where a task's worker dies again, whatever `function` raises (with the
        worker's traceback as a note), and RuntimeError where another map is not yet finished.
        """
        if self.count == 1 or len(tasks) <= 1:
            for task in tasks:
                raise_dropped()
                yield function(task)
            return
        began, done_here = time.monotonic(), 0
        while not self._workers and done_here < len(tasks):
            each = (time.monotonic() - began) / done_here if done_here else 0.0
            raise_dropped()
            if self.patience == 0.0 or each * (len(tasks) - done_here) > self.patience:
                break
            yield function(tasks[done_here])
            done_here += 1
        if self._mapping:
            raise RuntimeError("these workers are busy with another map: finish or close that one")
        self._mapping = True
        running: dict[connection.Connection, tuple[_Worker, int]] = {}
        try:
            yield from self._map(function, tasks, deque(range(done_here, len(tasks))), running)
        finally:
            self._mapping = False
            self._end([worker for worker, _ in running.values()])

    def _map(
        self,
        function: Callable[[T], R],
        tasks: Sequence[T],
        waiting: deque[int],
        running: dict[connection.Connection, tuple["_Worker", int]],
    ) -> Iterator[R]:
        retried: set[int] = set()
        while waiting or running:
            raise_dropped()
            self._feed(function, tasks, waiting, running)
            for pipe in connection.wait(list(running)):
                assert isinstance(pipe, connection.Connection)
                worker, index = running[pipe]
                answer = worker.answer()
                # Only now: an interrupted answer leaves the worker among those to be ended.
                del running[pipe]
                if answer is None:
                    code = worker.exit_code()
                    self._end([worker])
                    if index in retried:
                        raise WorkerLost(
                            f"a worker process died twice (exit code {code}; -9: killed, perhaps "
                            f"out of memory) on the task {_SHORT.repr(tasks[index])}"
                        )
                    retried.add(index)
                    waiting.appendleft(index)
                    continue
                self._feed(function, tasks, waiting, running)
                done, value = pickle.loads(answer)  # our own child wrote it, into its pipe
                if not done:
                    raise value
                yield value

    def _feed(
        self,
        function: Callable[[T], R],
        tasks: Sequence[T],
        waiting: deque[int],
        running: dict[connection.Connection, tuple["_Worker", int]],
    ) -> None:
        """Give every idle worker a task, starting processes up to `count`."""
        while waiting and len(running) < self.count:
            message = pickle.dumps((function, tasks[waiting[0]]))
            worker = self._idle(running)
            running[worker.pipe] = (worker, waiting.popleft())
            worker.send(message)

    def _idle(self, running: dict[connection.Connection, tuple["_Worker", int]]) -> "_Worker":
        for worker in list(self._workers):
            if worker.pipe not in running:
                if worker.process.is_alive():
                    return worker
                self._end([worker])  # died between two tasks: no task is to blame
        resource_tracker.ensure_running()  # by itself it starts later, and unblocks SIGINT
        with _interrupts_held():
            self._workers.append(_Worker())
        return self._workers[-1]

    def _end(self, workers: list["_Worker"]) -> None:
        with _interrupts_held():
            ended = [worker for worker in workers if worker in self._workers]
            for worker in ended:
                worker.process.kill()
            for worker in ended:
                worker.process.join()
                worker.process.close()
                worker.pipe.close()
                self._workers.remove(worker)


class Ahead:
    """A process that gets ready while this one is at work, for a task at the end of it.

    It begins with `ready()`, imports as a rule. A context manager; leaving it ends the process.
    """

    def __init__(self, ready: Callable[[], object]) -> None:
        resource_tracker.ensure_running()
        with _interrupts_held():
            self._worker = _Worker()
        self._worker.send(pickle.dumps((_called, ready)))
        self._waiting = 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with _interrupts_held():
            self._worker.process.kill()
            self._worker.process.join()
            self._worker.process.close()
            self._worker.pipe.close()

    def begin(self, function: Callable[[T], object], task: T) -> None:
        """Let it go on with this task."""
        self._worker.send(pickle.dumps((function, task)))
        self._waiting += 1

    def result(self) -> Any:
        """What the last task came to. Raises WorkerLost if it died, and what the task raised."""
        value = None
        while self._waiting:
            answer = self._worker.answer()
            if answer is None:
                raise WorkerLost(f"a worker process died (exit code {self._worker.exit_code()})")
            self._waiting -= 1
            done, value = pickle.loads(answer)  # our own child wrote it, into its pipe
            if not done:
                raise value
        return value


def _called(function: Callable[[], object]) -> None:
    function()


class _Worker:
    """One spawned process and the parent's end of its pipe."""

    def __init__(self) -> None:
        self.pipe, theirs = _SPAWN.Pipe()
        # A daemon: it is ended at exit even where the pool was not left properly.
        self.process = _SPAWN.Process(target=_serve, args=(theirs,), daemon=True)
        with _one_thread_each():
            self.process.start()
        theirs.close()  # the process holds it alone: its death is an end of file here

    def send(self, message: bytes) -> None:
        with suppress(OSError):  # it is dead: its answer will say so
            self.pipe.send_bytes(message)

    def answer(self) -> bytes | None:
        """What the process sent; None where it died."""
        try:
            return self.pipe.recv_bytes()
        except (EOFError, OSError):
            return None

    def exit_code(self) -> int | None:
        self.process.join(1.0)
        return self.process.exitcode


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """An environment for processes to inherit: NumPy and Numba read it as they are imported."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C comes at the end of the block; processes started in it are born with it blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: connection.Connection) -> None:
    """A worker's life: answer tasks until the pipe or the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(answered(pipe.recv_bytes()))


def answered(message: bytes) -> bytes:
    """The pickled (True, result) or (False, exception) of a pickled (function, task)."""
    try:
        function, task = pickle.loads(message)  # of the parent, through our pipe
        return pickle.dumps((True, function(task)))
    except BaseException as error:
        text = "".join(traceback.format_exception(error))
        error.add_note(f"in a worker process:\n{text}")
        try:
            answer = pickle.dumps((False, error))
            pickle.loads(answer)  # some exceptions pickle but cannot be made again
            return answer
        except Exception:
            return pickle.dumps((False, RuntimeError(text)))


def _end_with_parent() -> None:
    """End this worker as soon as its parent has ended, even by SIGKILL and in mid-task."""
    parent: Any = multiprocessing.parent_process()
    parent.join()
    os._exit(1)
