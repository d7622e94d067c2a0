"""Sampling on a Dask cluster, by the interface of the process pool: nothing lost, nothing twice.

Dask runs a task again where its worker dies. Where scheduler or workers stay away the command ends,
and the same command resumes from the samples that it has kept.

Messages are pickled, as Dask's own are: scheduler and workers can run what they like here, so the
address must be one's own; docs/development/cluster.md shows TLS for it. None is stored.
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
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.support.worker_process import R, T, WorkerLost, answer_message, one_blas_thread


@dataclass(frozen=True)
class ClusterOptions:
    """Times of a connection to a cluster, s."""

    connect: float = 10.0  # for the scheduler to answer at first, and for a worker to be there
    close: float = 1.0  # at the end, when nothing depends on it: Ctrl-C ends within 2 s
    poll: float = 0.02  # between two checks of the answers, and of the workers


_one_at_a_time = threading.Lock()


def pool(scheduler: str | None, count: int, patience: float) -> Pool:
    """The processes of a command.

    Parameters
    ----------
    scheduler : str or None
        Address of a Dask scheduler.
    count : int
        Processes here, without a scheduler.
    patience : float
        Work that starting these is not worth, s.

    Returns
    -------
    Pool
        To be entered.
    """
    return Workers(count, patience) if scheduler is None else Cluster(scheduler)


class Cluster:
    """The workers of a Dask scheduler; a single task runs in this process.

    Assumes that the workers have this package, and a user's plant file under the same path.
    """

    def __init__(
        self, address: str, absence: float = 300.0, options: ClusterOptions = ClusterOptions()
    ) -> None:
        """`absence`: s to wait for workers where all are gone."""
        self.options = options
        self.address, self.absence, self.count = address, absence, 1
        self._client: Any = None
        self._manned, self._mapping = 0.0, False

    def __enter__(self) -> Self:
        """Connect. Raises UserError where Dask is not installed, or nothing answers there."""
        try:
            import distributed
        except ImportError:
            words = "Dask, which is not installed; run: python -m pip install dask distributed"
            raise UserError(f"--scheduler needs {words}") from None
        for name in ("distributed", "distributed.client", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # losses are dealt with here
        if not re.fullmatch(r"\w+://.+:\d+", self.address):
            what = "what `dask scheduler` prints, for instance tcp://127.0.0.1:8786"
            raise self._mistake(f"is not an address; give {what}")
        try:
            self._client = distributed.Client(
                self.address, timeout=self.options.connect, set_as_default=False
            )
        except Exception as error:  # whatever the transport of that address raises
            words = f"no Dask scheduler answers there ({error}); start one with `dask scheduler`"
            raise self._mistake(f"{words} and give the address that it prints") from error
        try:
            self._client.wait_for_workers(1, timeout=self.options.connect)
        except TimeoutError:
            self._close()
            words = f"has no workers; start some with `dask worker {self.address} --nthreads 1`"
            raise self._mistake(words) from None
        self._survey()
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Results as they complete, each once.

        Raises as `Pool` says, and WorkerLost where scheduler or workers stay away.
        """
        if len(tasks) <= 1:
            yield from map(function, tasks)
            return
        if self._mapping:
            raise RuntimeError("this cluster is busy with another map: finish or close that one")
        from distributed import as_completed

        self._mapping, self._manned = True, time.monotonic()
        messages = [pickle.dumps((function, task)) for task in tasks]
        futures = [self._client.submit(serve, NUMERICS, m, pure=False) for m in messages]
        arriving = as_completed(futures, loop=self._client.loop)
        try:
            while not arriving.is_empty():
                for future in arriving.next_batch(block=False):
                    yield self._answer(future)
                self._survey()
                time.sleep(self.options.poll)
        finally:
            self._mapping = False
            with suppress(Exception):  # the connection is closed already
                self._client.cancel(futures)

    def _answer(self, future: Any) -> Any:
        from distributed import KilledWorker

        try:
            done, value = pickle.loads(future.result())  # of a worker that runs our code anyway
        except KilledWorker:
            raise WorkerLost("worker after worker died on one task (out of memory?)") from None
        except (CancelledError, OSError) as error:
            raise self._away("scheduler") from error
        except Exception as error:
            raise self._mistake(
                f"a worker cannot run our tasks ({type(error).__name__}: {error}); "
                "install the same version of this package in every worker's environment"
            ) from error
        if not done:
            raise value
        return value

    def _survey(self) -> None:
        """Count the workers. Raises WorkerLost where nobody is there any more."""
        if self._client.status != "running":
            raise self._away("scheduler")
        found = int(self._client.scheduler_info(n_workers=0).get("n_workers", 0))
        self.count, now = max(found, 1), time.monotonic()
        if found:
            self._manned = now
        elif now - self._manned > self.absence:
            raise self._away("worker")

    def _close(self) -> None:
        with suppress(TimeoutError, OSError):
            self._client.close(timeout=self.options.close)

    def _mistake(self, words: str) -> UserError:
        return UserError(f"--scheduler {self.address}: {words}")

    def _away(self, what: str) -> WorkerLost:
        words = f"the {what} is gone; start `dask {what}` again"
        return WorkerLost(f"--scheduler {self.address}: {words}, and the same command resumes")


def serve(numerics: int, message: bytes) -> bytes:
    """On a worker: the answer to one message, with one BLAS thread.

    One task at a time, even where a worker has several threads: CasADi's functions, and the
    limit on threads, belong to the process.
    """
    if numerics != NUMERICS:
        raise RuntimeError(f"the worker's numerics are version {NUMERICS}, ours are {numerics}")
    with _one_at_a_time, one_blas_thread:
        return answer_message(message)
