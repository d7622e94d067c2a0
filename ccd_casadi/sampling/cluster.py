"""Sampling on a Dask cluster, by the interface of the process pool: nothing lost, nothing twice.

Dask runs a task again where its worker dies. The rest is done here: after a scheduler's restart
tasks are submitted again, a straggler gets a second copy, and the first answer of a task counts.

Messages are pickled, as Dask's own are: scheduler and workers can run what they like here, so the
address must be one's own; docs/development/cluster.md shows TLS for it. None is stored.
"""

import asyncio
import gc
import logging
import pickle
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Self

from threadpoolctl import threadpool_limits

from ccd_casadi.inner_problem.problem import NUMERICS
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.support.worker_process import R, T, WorkerLost, answered

CONNECT_SECONDS = 10.0  # for the scheduler to answer at first, and for a worker to be there
CLOSE_SECONDS = 1.0  # for a farewell that nobody needs: Ctrl-C ends within 2 s
AHEAD = 3  # tasks in flight for every worker: it has its next while a result travels
SLOW = 10.0  # times the median wait is late
KILLS = 2  # times that Dask may give a task up, each after several workers died on it
TICK = 0.25  # s between two looks at the cluster

_one_at_a_time = threading.Lock()


def pool(scheduler: str | None, count: int, patience: float) -> Pool:
    """The cluster behind a scheduler's address, or without one `count` processes here."""
    return Workers(count, patience) if scheduler is None else Cluster(scheduler)


@dataclass
class _Flight:
    """A task that was submitted and not yet answered; its copies by Dask's key."""

    submitted: float = 0.0  # the latest copy
    copies: dict[str, Any] = field(default_factory=dict)
    kills: int = 0

    def abandon(self) -> None:
        """Forget the copies; Dask drops those that no worker has begun."""
        for future in self.copies.values():
            with suppress(RuntimeError):  # the connection is closed already
                future.release()  # to cancel the wait instead would upset Dask's gathering
        self.copies.clear()


class Cluster:
    """The workers of a Dask scheduler; a single task runs in this process.

    Assumes that the workers have this package, and a user's plant file under the same path.
    """

    def __init__(self, address: str, patience: float = 60.0, absence: float = 300.0) -> None:
        """`patience`: s before a task can be late; `absence`: s to wait for a lost cluster."""
        self.address, self.patience, self.absence, self.count = address, patience, absence, 1
        self._client: Any = None
        self._answers: queue.Queue[tuple[int, str, bytes | Exception]] = queue.Queue()
        self._waits: deque[float] = deque([0.0], maxlen=99)  # of the latest answers
        self._surveyed, self._manned, self._mapping = 0.0, 0.0, False

    def __enter__(self) -> Self:
        """Connect. Raises UserError where Dask is not installed, or nothing answers there."""
        try:
            import distributed  # noqa: F401
        except ImportError:
            words = "Dask, which is not installed; run: python -m pip install dask distributed"
            raise UserError(f"--scheduler needs {words}") from None
        for name in ("distributed", "distributed.client", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # losses are dealt with here
        if not re.fullmatch(r"\w+://.+:\d+", self.address):
            what = "what `dask scheduler` prints, for instance tcp://127.0.0.1:8786"
            raise self._mistake(f"is not an address; give {what}")
        try:
            self._connect(CONNECT_SECONDS)
        except Exception as error:  # whatever the transport of that address raises
            words = f"no Dask scheduler answers there ({error}); start one with `dask scheduler`"
            raise self._mistake(f"{words} and give the address that it prints") from error
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError:
            self._close()
            words = f"has no workers; start some with `dask worker {self.address} --nthreads 1`"
            raise self._mistake(words) from None
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        """Results as they complete, each once, whatever becomes of workers and scheduler.

        Raises as `Pool` says, and WorkerLost where the cluster stays away for `absence`.
        """
        if len(tasks) <= 1:
            yield from map(function, tasks)
            return
        if self._mapping:
            raise RuntimeError("this cluster is busy with another map: finish or close that one")
        self._mapping, self._answers, self._manned = True, queue.Queue(), time.monotonic()
        waiting, flying = deque(range(len(tasks))), dict[int, _Flight]()
        try:
            while waiting or flying:
                self._survey(flying)
                while waiting and len(flying) < AHEAD * self.count:
                    flying[waiting.popleft()] = _Flight()
                self._submit(function, tasks, flying)
                for index, key, answer in self._arrivals():
                    flight = flying.get(index)
                    if flight is None:
                        continue  # another copy was first
                    if isinstance(answer, Exception):
                        self._fail(flight, key, answer)
                        continue
                    del flying[index]
                    self._waits.append(time.monotonic() - flight.submitted)
                    flight.abandon()
                    done, value = pickle.loads(answer)  # of a worker that runs our code anyway
                    if not done:
                        raise value
                    yield value
        finally:
            self._mapping = False
            for flight in flying.values():
                flight.abandon()

    def _submit(
        self, function: Callable[[T], R], tasks: Sequence[T], flying: dict[int, _Flight]
    ) -> None:
        """Submit what has no copy, and once more what is late, where it is not already."""
        now, patience = time.monotonic(), max(self.patience, SLOW * median(self._waits))
        late = []
        for index, flight in flying.items():
            if not flight.copies:
                self._send(index, flight, (function, tasks[index]), [])
            elif now - flight.submitted > patience * 2.0 ** (len(flight.copies) - 1):
                late.append(index)
        if late and self.count > 1:
            with suppress(OSError):  # the next survey finds the scheduler gone
                holding = self._client.processing()
                for index in late:
                    copies = flying[index].copies.keys()
                    others = [name for name, keys in holding.items() if copies.isdisjoint(keys)]
                    self._send(index, flying[index], (function, tasks[index]), others)

    def _send(self, index: int, flight: _Flight, work: object, workers: list[str]) -> None:
        """Submit one copy, to certain workers if any, and queue its answer once it is here."""
        client, answers, message = self._client, self._answers, pickle.dumps(work)
        where = {"workers": workers, "allow_other_workers": True} if workers else {}
        future = client.submit(serve, NUMERICS, message, pure=False, **where)

        async def wait() -> None:
            try:
                answers.put((index, future.key, await client.gather(future, asynchronous=True)))
            except Exception as error:
                answers.put((index, future.key, error))

        asyncio.run_coroutine_threadsafe(wait(), client.loop.asyncio_loop)
        flight.copies[future.key], flight.submitted = future, time.monotonic()

    def _arrivals(self) -> Iterator[tuple[int, str, bytes | Exception]]:
        """What has come; waits a moment for the first."""
        with suppress(queue.Empty):
            yield self._answers.get(timeout=TICK)
            while True:
                yield self._answers.get_nowait()

    def _fail(self, flight: _Flight, key: str, error: Exception) -> None:
        """Drop a copy that brings no answer, so that it is submitted again; or say why not."""
        from distributed import KilledWorker

        if flight.copies.pop(key, None) is None:
            return  # of an earlier connection
        if isinstance(error, KilledWorker):
            flight.kills += 1
            if flight.kills == KILLS:
                raise WorkerLost("worker after worker died on one task (out of memory?)")
        elif not isinstance(error, CancelledError | OSError):  # those: connection lost
            raise self._mistake(
                f"a worker cannot run our tasks ({type(error).__name__}: {error}); "
                "install the same version of this package in every worker's environment"
            ) from error

    def _survey(self, flying: dict[int, _Flight]) -> None:
        """Count the workers now and then; connect again where the scheduler is lost."""
        if self._client.status != "running":
            for flight in flying.values():
                flight.abandon()
            self._close()
            try:
                self._connect(self.absence)
            except Exception as error:
                raise self._away("scheduler") from error
        elif time.monotonic() - self._surveyed > TICK:
            self._count()
            if self._surveyed - self._manned > self.absence:
                raise self._away("worker")

    def _connect(self, seconds: float) -> None:
        from distributed import Client

        gc.collect()  # a client that failed locks up where it is collected as another starts
        self._client = Client(self.address, timeout=seconds, set_as_default=False)
        self._manned = time.monotonic()
        self._count()

    def _count(self) -> None:
        found = int(self._client.scheduler_info(n_workers=0).get("n_workers", 0))
        self.count, self._surveyed = max(found, 1), time.monotonic()
        if found:
            self._manned = self._surveyed

    def _close(self) -> None:
        with suppress(TimeoutError, OSError):
            self._client.close(timeout=CLOSE_SECONDS)

    def _mistake(self, words: str) -> UserError:
        return UserError(f"--scheduler {self.address}: {words}")

    def _away(self, what: str) -> WorkerLost:
        words = f"no {what} for {self.absence:.0f} s; start `dask {what}` again"
        return WorkerLost(f"--scheduler {self.address}: {words}")


def serve(numerics: int, message: bytes) -> bytes:
    """On a worker: the answer to one message, with one BLAS thread.

    One task at a time, even where a worker has several threads: CasADi's functions, and the
    limit on threads, belong to the process.
    """
    if numerics != NUMERICS:
        raise RuntimeError(f"the worker's numerics are version {NUMERICS}, ours are {numerics}")
    with _one_at_a_time, threadpool_limits(limits=1):
        return answered(message)
