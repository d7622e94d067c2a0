"""What takes longer than a drag: exact searches, samples of a slow plant, and a whole solve."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from ccd_casadi.explorer.designs import elements_at
from ccd_casadi.explorer.modes import Theta, fit_modes, plan
from ccd_casadi.explorer.session import Session
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.user_code import permit_user_code
from ccd_casadi.support.worker_process import become_worker

BEHIND = 10  # niceness of what fills the box

Progress = Callable[[str], None]
Then = Callable[[Any], None]
Failed = Callable[[BaseException], None]


_words: Any = None  # in a worker: where it tells how far it is


def _prepare(user_code: bool, behind: bool, words: Any) -> None:
    """In a worker: one BLAS thread, Ctrl-C left to the parent, and no life beyond it."""
    global _words
    _words = words
    if behind and hasattr(os, "nice"):
        os.nice(BEHIND)  # the page comes first
    threadpool_limits(limits=1)
    permit_user_code(user_code).__enter__()
    become_worker()


def _working(given: tuple[Callable[[Any, Progress], Any], Any]) -> Any:
    work, task = given
    return work(task, _words.put)


class Background:
    """One process for what the user waits for, the others for what makes dragging better.

    `then`, `failed` and `told` are called in another thread.
    """

    def __init__(self, workers: int, user_code: bool = True) -> None:
        self._sizes = {"asked": 1, "filling": max(1, workers - 1)}
        self._user_code = user_code
        self._pools: dict[str, ProcessPoolExecutor] = {}  # made when they are needed
        self._closed = False
        self._context = multiprocessing.get_context("spawn")
        self._words = self._context.SimpleQueue()
        self._told: Progress = lambda words: None
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while (words := self._words.get()) is not None:
            self._told(words)

    def _pool(self, name: str) -> ProcessPoolExecutor:
        if name not in self._pools:
            given = (self._user_code, name == "filling", self._words)
            self._pools[name] = ProcessPoolExecutor(
                self._sizes[name], self._context, _prepare, given
            )
        return self._pools[name]

    def ask(
        self, work: Callable[[Any, Progress], Any], task: Any, then: Then, failed: Failed,
        told: Progress = lambda words: None,
    ) -> Future:  # fmt: skip
        """Do what the user waits for, one after the other; `told` hears how far the work is."""
        self._told = told
        return self._submit("asked", _working, (work, task), then, failed)

    def fill(self, session: Session, problem: CoDesignProblem, told: Callable[[], None]) -> None:
        """Sample a slow plant over its box and fit the surrogate of its modes again and again.

        `told` is called after every sample and every fit. What was sampled is kept in the session's
        folder.
        """
        known = session.known
        assert known is not None
        fitted = 0

        def refit() -> None:
            nonlocal fitted
            if known.due(fitted):
                fitted = len(known.exact)
                task = (list(known.exact), list(known.exact.values()))
                self._submit("filling", _fit, task, took, print_failure)
                known.save(session.folder)

        def took(found: Any) -> None:
            known.surrogate = found
            told()

        def sampled(found: tuple[Theta, Mechanics]) -> None:
            known.exact[found[0]] = found[1]
            ended()
            refit()

        def ended(error: BaseException | None = None) -> None:
            known.missing -= 1
            told()

        refit()
        wanted = [t for t in plan(problem.lower, problem.upper) if t not in known.exact]
        known.missing = len(wanted)
        for theta in wanted:
            self._submit("filling", _sample, (problem, theta), sampled, ended)

    def _submit(
        self, pool: str, work: Callable[[Any], Any], task: Any, then: Then,
        failed: Failed,
    ) -> Future:  # fmt: skip
        def done(future: Future) -> None:
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if error is None:
                then(future.result())
            else:
                failed(error)

        future = self._pool(pool).submit(work, task)
        future.add_done_callback(done)
        return future

    def close(self) -> None:
        """End what is under way."""
        self._closed = True
        self._words.put(None)
        for pool in self._pools.values():
            running = list((pool._processes or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()


def print_failure(error: BaseException) -> None:
    """On stderr: what the page can do without."""
    print(f"warning: {error}", file=sys.stderr)


def _sample(task: tuple[CoDesignProblem, Theta]) -> tuple[Theta, Mechanics]:
    return task[1], elements_at(*task).system


def _fit(task: tuple[list[Theta], list[Mechanics]]) -> Any:
    return fit_modes(*task)


class Solve:
    """`python -m ccd_casadi.solve` of a case, in a process of its own, into a folder."""

    def __init__(
        self, case: Path, folder: Path, options: Sequence[str], tell: Callable[[str], None],
        ended: Callable[[int], None],
    ) -> None:  # fmt: skip
        """`tell` is given every line, `ended` the exit code, both in another thread."""
        command = [sys.executable, "-m", "ccd_casadi.solve", str(case), "--out", str(folder)]
        self._process = subprocess.Popen(
            [*command, *options],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            text=True, encoding="utf-8", errors="replace",
        )  # fmt: skip

        def read() -> None:
            assert self._process.stdout is not None
            with self._process.stdout as lines:  # universal newlines: a bar's \r ends one too
                for line in lines:
                    tell(line.rstrip())
            ended(self._process.wait())

        self._asked = False
        threading.Thread(target=read, daemon=True).start()

    def stop(self) -> None:
        """As Ctrl-C does, and what is sampled is kept; asked again, without more ado."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM if self._asked else signal.SIGINT)
            self._asked = True
