"""What takes longer than a drag: exact searches, the model of a slow plant, a whole solve."""

import multiprocessing
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from ccd_casadi.explorer.known_plant import KnownPlant
from ccd_casadi.support.user_code import permit_user_code
from ccd_casadi.support.worker_process import become_worker

Progress = Callable[[str], None]
Then = Callable[[Any], None]
Failed = Callable[[BaseException], None]


_words: Any = None  # in a worker: where it tells how far it is


def _prepare(user_code: bool, words: Any) -> None:
    """In a worker: one BLAS thread, Ctrl-C left to the parent, and no life beyond it."""
    global _words
    _words = words
    threadpool_limits(limits=1)
    permit_user_code(user_code).__enter__()
    become_worker()


def _working(given: tuple[Callable[[Any, Progress], Any], Any]) -> Any:
    work, task = given
    return work(task, _words.put)


class Background:
    """A process for what the user waits for, a thread for what makes dragging better.

    `then`, `failed` and `told` are called in another thread.
    """

    def __init__(self, user_code: bool = True) -> None:
        self._user_code = user_code
        self._process: ProcessPoolExecutor | None = None  # made when it is needed
        self._thread = ThreadPoolExecutor(1)
        self._closed = False
        self._context = multiprocessing.get_context("spawn")
        self._words = self._context.SimpleQueue()
        self._told: Progress = lambda words: None
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while (words := self._words.get()) is not None:
            self._told(words)

    def ask(
        self, work: Callable[[Any, Progress], Any], task: Any, then: Then, failed: Failed,
        told: Progress = lambda words: None,
    ) -> Future:  # fmt: skip
        """Do what the user waits for, one after the other; `told` hears how far the work is."""
        self._told = told
        if self._process is None:
            given = (self._user_code, self._words)
            self._process = ProcessPoolExecutor(1, self._context, _prepare, given)
        return self._submit(self._process, _working, (work, task), then, failed)

    def renew(self, known: KnownPlant, then: Then) -> None:
        """Make the model of a slow plant anew; of megabytes, it stays in this process."""
        self._submit(self._thread, lambda _: known.renew(), None, then, print_failure)

    def _submit(
        self, pool: Executor, work: Callable[[Any], Any], task: Any, then: Then, failed: Failed
    ) -> Future:
        def done(future: Future) -> None:
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if error is None:
                then(future.result())
            else:
                failed(error)

        future = pool.submit(work, task)
        future.add_done_callback(done)
        return future

    def close(self) -> None:
        """End what is under way."""
        self._closed = True
        self._words.put(None)
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._process is not None:
            running = list((self._process._processes or {}).values())
            self._process.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()


def print_failure(error: BaseException) -> None:
    """On stderr: what the page can do without."""
    print(f"warning: {error}", file=sys.stderr)


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
