"""A pool of worker processes, one BLAS thread each, that ends promptly and leaves no orphans."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import TracebackType
from typing import Any, Self, TypeVar

T = TypeVar("T")
R = TypeVar("R")

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
IN_FLIGHT = 2  # tasks submitted per worker: enough to keep it busy, few to lose


class WorkerLost(RuntimeError):
    """A worker process died twice on the same task (killed, or out of memory)."""


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """A lazily started process pool; with one worker the tasks run in this process.

    Processes are spawned, never forked, and import NumPy with one BLAS thread. They ignore
    Ctrl-C, which the parent handles, and end when the parent does, however it ends.
    """

    def __init__(self, count: int, patience: float = 0.0) -> None:
        """`patience`: seconds of work below which starting processes does not pay."""
        self.count = max(1, count)
        self.patience = patience
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop()

    def map_unordered(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[R]:
        """Results as they complete. A task whose worker dies is tried once more.

        Raises WorkerLost where it dies again, and whatever `function` raises.
        """
        if self.count == 1 or len(tasks) <= 1:
            yield from map(function, tasks)
            return
        began, done_here = time.monotonic(), 0
        while self._pool is None and done_here < len(tasks):
            each = (time.monotonic() - began) / done_here if done_here else 0.0
            if self.patience == 0.0 or each * (len(tasks) - done_here) > self.patience:
                break
            yield function(tasks[done_here])
            done_here += 1
        waiting = list(range(len(tasks) - 1, done_here - 1, -1))
        retried: set[int] = set()
        running: dict[Future[R], int] = {}
        try:
            while waiting or running:
                pool = self._started()
                try:
                    while waiting and len(running) < IN_FLIGHT * self.count:
                        running[pool.submit(function, tasks[waiting[-1]])] = waiting[-1]
                        waiting.pop()
                except BrokenProcessPool:
                    pass  # seen below; the task still waits
                done, _ = wait(running, return_when=FIRST_COMPLETED) if running else (set(), None)
                lost = [f for f in done if isinstance(f.exception(), BrokenProcessPool)]
                for future in done - set(lost):
                    del running[future]
                    yield future.result()
                if lost or self._broken():
                    # One death breaks the whole pool: every task in flight goes again, once.
                    for index in running.values():
                        if index in retried:
                            task = repr(tasks[index])[:200]
                            raise WorkerLost(f"a worker process died twice on the task {task}")
                        retried.add(index)
                        waiting.append(index)
                    running.clear()
                    self._stop()
        except BaseException:
            self._stop()
            raise

    def _broken(self) -> bool:
        return self._pool is not None and bool(getattr(self._pool, "_broken", False))

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            before = {name: os.environ.get(name) for name in _THREADS}
            os.environ.update(dict.fromkeys(_THREADS, "1"))
            try:
                self._pool = ProcessPoolExecutor(
                    self.count, multiprocessing.get_context("spawn"), initializer=_prepare
                )
                # Processes start on demand: make them start while the environment is set, and
                # deaf to Ctrl-C from their first instruction, before they can ignore it.
                with _interrupts_held():
                    started = self._pool.map(_nothing, range(self.count))
                list(started)
            except BrokenProcessPool:
                raise WorkerLost("the worker processes died as they started") from None
            finally:
                for name, value in before.items():
                    if value is None:
                        del os.environ[name]
                    else:
                        os.environ[name] = value
        return self._pool

    def _stop(self) -> None:
        if self._pool is None:
            return
        pool, self._pool = self._pool, None
        processes = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        for process in processes:
            process.join()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold SIGINT back here, delivered at the end; processes started inside never get it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # it would unblock the signal where it is started later
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _nothing(value: Any) -> Any:
    return value


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    """End this worker as soon as its parent has ended, even by SIGKILL."""
    parent.join()
    os._exit(1)
