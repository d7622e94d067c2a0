"""Sampling on a Dask cluster, with the interface of the process pool (`process_pool.Pool`).

Each task gives exactly one result. Dask repeats a task whose worker died. If the scheduler or all
workers remain unreachable, the command ends with `WorkerLost`; the same command resumes from the
samples in its store.

Security: messages are pickled, as Dask's own are, so a scheduler or a worker can execute any code
in this process. Connect only to your own; docs/development/cluster.md shows TLS for it. No pickle
is stored.
"""

import logging
import pickle
import re
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

from ccd_casadi.inner_problem.problem import NUMERICS
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.worker_process import R, T, WorkerLost, answer_message, one_blas_thread


@dataclass(frozen=True)
class ClusterOptions:
    """Times of a connection to a cluster, s."""

    connect: float = 10.0  # at most, until the scheduler answers and until it has a worker
    close: float = 1.0  # at most, to disconnect: Ctrl-C must end the command within 2 s
    poll: float = 0.02  # between two checks for results and for workers


_one_task = threading.Lock()


class Cluster:
    """A pool of the workers of a Dask scheduler; a single task runs in this process.

    Every worker needs this package, and the user's plant file under the same path.
    """

    def __init__(
        self, address: str, absence: float = 300.0, options: ClusterOptions = ClusterOptions()
    ) -> None:
        """`absence`: time in s without any worker after which a map raises WorkerLost."""
        self.options = options
        self.address, self.absence, self.count = address, absence, 1
        self._client: Any = None
        self._last_worker_seen, self._mapping = 0.0, False  # by the monotonic clock, s

    def __enter__(self) -> Self:
        """Connect. Raises UserError where Dask is not installed, the address is none, or there is
        no scheduler or no worker."""
        try:
            import distributed
        except ImportError:
            message = "Dask, which is not installed; run: python -m pip install dask distributed"
            raise UserError(f"--scheduler needs {message}") from None
        for name in ("distributed", "distributed.client", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # losses are reported here
        if not re.fullmatch(r"\w+://.+:\d+", self.address):
            example = "what `dask scheduler` prints, for instance tcp://127.0.0.1:8786"
            raise self._user_error(f"is not an address; give {example}")
        try:
            self._client = distributed.Client(
                self.address, timeout=self.options.connect, set_as_default=False
            )
        except Exception as error:  # each transport of Dask (tcp, tls, ucx) raises its own
            message = f"no Dask scheduler answers there ({error}); start one with `dask scheduler`"
            raise self._user_error(f"{message} and give the address that it prints") from error
        try:
            self._client.wait_for_workers(1, timeout=self.options.connect)
        except TimeoutError:
            self._close()
            message = f"has no workers; start some with `dask worker {self.address} --nthreads 1`"
            raise self._user_error(message) from None
        self._count_workers()
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Yield results as they complete, each once.

        Raises as `Pool.map_unordered`, and WorkerLost where scheduler or workers are gone for good.
        """
        if len(tasks) <= 1:
            yield from map(function, tasks)
            return
        if self._mapping:
            raise RuntimeError("this cluster is busy with another map: finish or close that one")
        from distributed import as_completed

        self._mapping, self._last_worker_seen = True, time.monotonic()
        messages = [pickle.dumps((function, task)) for task in tasks]
        # pure=False: Dask may not take a result from an equal task of an earlier map
        futures = [self._client.submit(serve, NUMERICS, m, pure=False) for m in messages]
        completed = as_completed(futures, loop=self._client.loop)
        try:
            while not completed.is_empty():
                for future in completed.next_batch(block=False):
                    yield self._result(future)
                self._count_workers()
                time.sleep(self.options.poll)
        finally:
            self._mapping = False
            with suppress(Exception):  # the connection may be closed already
                self._client.cancel(futures)

    def _result(self, future: Any) -> Any:
        """The value of a task, or its exception raised."""
        from distributed import KilledWorker

        try:
            succeeded, value = pickle.loads(future.result())  # trusted: see the module
        except KilledWorker:
            raise WorkerLost("worker after worker died on one task (out of memory?)") from None
        except (CancelledError, OSError) as error:
            raise self._lost("scheduler") from error
        except Exception as error:  # of `serve` itself: exceptions of a task are values
            raise self._user_error(
                f"a worker cannot run our tasks ({type(error).__name__}: {error}); "
                "install the same version of this package in every worker's environment"
            ) from error
        if not succeeded:
            raise value
        return value

    def _count_workers(self) -> None:
        """Update `count`. Raises WorkerLost without a scheduler, or without workers for too long.

        A short absence is tolerated: workers may restart.
        """
        if self._client.status != "running":
            raise self._lost("scheduler")
        workers = int(self._client.scheduler_info(n_workers=0).get("n_workers", 0))
        self.count, now = max(workers, 1), time.monotonic()
        if workers:
            self._last_worker_seen = now
        elif now - self._last_worker_seen > self.absence:
            raise self._lost("worker")

    def _close(self) -> None:
        with suppress(TimeoutError, OSError):
            self._client.close(timeout=self.options.close)

    def _user_error(self, message: str) -> UserError:
        return UserError(f"--scheduler {self.address}: {message}")

    def _lost(self, part: str) -> WorkerLost:
        message = f"the {part} is gone; start `dask {part}` again"
        return WorkerLost(f"--scheduler {self.address}: {message}, and the same command resumes")


def serve(numerics: int, message: bytes) -> bytes:
    """Run one task on a worker, with one BLAS thread: pickled (function, task) to pickled
    (succeeded, result or exception).

    `numerics` is the client's version; a worker with another would return other digits. One task at
    a time, even if a worker has several threads: CasADi's functions and the limit on BLAS threads
    are shared by the process.
    """
    if numerics != NUMERICS:
        raise RuntimeError(f"the worker's numerics are version {NUMERICS}, ours are {numerics}")
    with _one_task, one_blas_thread:
        return answer_message(message)
