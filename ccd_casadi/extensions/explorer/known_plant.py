"""What takes longer than a drag: exact searches, and the model of a slow plant while one drags."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.extensions.explorer.designs import Elements
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant, nearby_model
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.user_code import permit_user_code
from ccd_casadi.support.worker_process import WorkerLost, WorkerProcess, log

Theta = tuple[float, ...]


@dataclass
class KnownPlant:
    """Exact matrices by θ in the order of their solution, and the model made of the newest ones.

    `checked`: share of the box from the nearest θ known, and relative error of a frequency, where
    the model was last compared with the plant itself.
    """

    plant: Plant
    lower: Theta
    upper: Theta
    exact: dict[Theta, Mechanics] = field(default_factory=dict)
    model: Evaluate | None = None
    used: tuple[Theta, ...] = ()
    checked: tuple[float, float] = (0.0, np.inf)

    def learn(self, theta: Theta, system: Mechanics) -> float | None:
        """Take the plant's own matrices at θ; how far off the model was, if there was one."""
        off = None
        if theta not in self.exact and self.model is not None:
            off = frequency_error(self.model(theta), system)
            self.checked = (self._nearest(theta), off)
        self.exact[theta] = system
        return off

    def renew(self, *, most: int = 6) -> None:
        """Make the model of the θ known nearest to the newest: seconds, for its own thread.

        More than `most` θ make it slower than a drag.
        """
        known = list(self.exact)
        most = 1 if self.plant.nearby is None else most  # to first order: of the newest alone
        close = sorted(known, key=lambda theta: self.distance(theta, known[-1]))[:most]
        used = tuple(theta for theta in known if theta in close)  # a basis grows in one order
        self.model, self.used = nearby_model(self.plant, used, known[-1]), used

    def at(self, theta: Theta) -> Elements:
        """Return what is known at θ without solving the plant.

        The error is the one last measured, infinite farther away than that or before any.
        """
        if theta in self.exact:
            return Elements(self.exact[theta])
        if self.model is None:
            nearest = min(self.exact, key=lambda other: self.distance(theta, other))
            share = 100.0 * self.distance(theta, nearest)
            words = f"those of the nearest solved θ, {share:.2g} % of the box away"
            return Elements(self.exact[nearest], np.inf, words)
        away, (reached, off) = self._nearest(theta), self.checked
        words = (
            f"a model made of {len(self.used)} solved θ, the nearest {100.0 * away:.2g} % of the "
            "box away"
        )
        if np.isfinite(off):
            words += f"; {100.0 * reached:.2g} % away it was off by {100.0 * off:.2g} %"
        return Elements(self.model(theta), off if away <= reached else np.inf, words)

    def _nearest(self, theta: Theta) -> float:
        return min(self.distance(theta, other) for other in self.used)

    def distance(self, one: Theta, other: Theta) -> float:
        """Largest difference as a share of the box."""
        width = np.array(self.upper) - np.array(self.lower)
        return float(np.abs((np.array(one) - np.array(other)) / width).max())


def frequency_error(one: Mechanics, exact: Mechanics) -> float:
    """Largest relative difference of the flexible frequencies of two plants."""
    a, b = (eigh(system.K, system.M, eigvals_only=True) for system in (one, exact))
    flexible = b > 1e-6 * b.max()  # below, it is a rigid motion's, rounded
    return float(np.abs(np.sqrt(np.maximum(a, 0.0)[flexible] / b[flexible]) - 1.0).max())


Then = Callable[[Any], None]
Failed = Callable[[BaseException], None]


def _working(given: tuple[bool, Callable[[Any, Log], Any], Any]) -> Any:
    user_code, work, task = given
    with permit_user_code(user_code):
        return work(task, log)


class Background:
    """A process for what the user waits for, a thread for what makes dragging better.

    `then`, `failed` and `heard` are called in another thread.
    """

    def __init__(self, user_code: bool = True) -> None:
        self._user_code = user_code
        self._process: WorkerProcess | None = None  # made when it is needed
        self._asking, self._thread = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._closed = False

    def ask(self, work: Callable[[Any, Log], Any], task: Any, heard: Log = silent) -> Future:
        """Do what the user waits for, one after the other; `heard` is given how far it is."""

        def answered() -> Any:
            process = self._process = self._process or WorkerProcess()
            process.begin(_working, (self._user_code, work, task))
            try:
                done, value = process.answer(reported=heard)
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
    """Warn on stderr of a failure that the page can do without."""
    print(f"warning: {error}", file=sys.stderr)


class Solve:
    """`python -m ccd_casadi.solve` of a case, in a process of its own, into a folder."""

    def __init__(
        self, case: Path, folder: Path, options: Sequence[str], log: Log,
        ended: Callable[[int], None],
    ) -> None:  # fmt: skip
        """`log` is given every line, `ended` the exit code, both in another thread."""
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
                    log(line.rstrip())
            ended(self._process.wait())

        self._interrupted = False
        threading.Thread(target=read, daemon=True).start()

    def stop(self) -> None:
        """Stop as Ctrl-C does, and keep what is sampled; a second call ends the process at once."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM if self._interrupted else signal.SIGINT)
            self._interrupted = True
