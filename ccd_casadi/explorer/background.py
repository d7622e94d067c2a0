"""What takes longer than a drag: exact searches, the model of a slow plant, a whole solve."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ccd_casadi.explorer.known_plant import KnownPlant
from ccd_casadi.support.progress import Tell, silent
from ccd_casadi.support.user_code import permit_user_code
from ccd_casadi.support.worker_process import WorkerLost, WorkerProcess, tell

Then = Callable[[Any], None]
Failed = Callable[[BaseException], None]


def _working(given: tuple[bool, Callable[[Any, Tell], Any], Any]) -> Any:
    user_code, work, task = given
    with permit_user_code(user_code):
        return work(task, tell)


class Background:
    """A process for what the user waits for, a thread for what makes dragging better.

    `then`, `failed` and `told` are called in another thread.
    """

    def __init__(self, user_code: bool = True) -> None:
        self._user_code = user_code
        self._process: WorkerProcess | None = None  # made when it is needed
        self._asking, self._thread = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._closed = False

    def ask(self, work: Callable[[Any, Tell], Any], task: Any, told: Tell = silent) -> Future:
        """Do what the user waits for, one after the other; `told` hears how far the work is."""

        def answered() -> Any:
            process = self._process = self._process or WorkerProcess()
            process.begin(_working, (self._user_code, work, task))
            try:
                done, value = process.answer(told=told)
            except WorkerLost:
                self._process = None
                raise
            if not done:
                raise value
            return value

        return self._asking.submit(answered)

    def renew(self, known: KnownPlant, then: Then) -> None:
        """Make the model of a slow plant anew; of megabytes, it stays in this process."""
        self.answer(self._thread.submit(known.renew), then, print_failure)

    def answer(self, future: Future, then: Then, failed: Failed) -> None:
        """Call one of them with what this comes to, unless all is closed by then."""

        def done(future: Future) -> None:
            if self._closed or future.cancelled():
                return
            error = future.exception()
            if error is None:
                then(future.result())
            else:
                failed(error)

        future.add_done_callback(done)

    def close(self) -> None:
        """End what is under way."""
        self._closed = True
        for pool in (self._asking, self._thread):
            pool.shutdown(wait=False, cancel_futures=True)
        if self._process is not None:
            self._process.process.kill()


def print_failure(error: BaseException) -> None:
    """On stderr: what the page can do without."""
    print(f"warning: {error}", file=sys.stderr)


class Solve:
    """`python -m ccd_casadi.solve` of a case, in a process of its own, into a folder."""

    def __init__(
        self, case: Path, folder: Path, options: Sequence[str], tell: Tell,
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
