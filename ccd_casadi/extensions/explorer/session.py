"""What the explorer knows while it runs, and what is found meanwhile: exact searches, a model."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.cases.tables import Case
from ccd_casadi.extensions.explorer.curves import surface_modes_html
from ccd_casadi.extensions.explorer.designs import (
    Designed,
    Elements,
    ExploredDesign,
    How,
    elements_at,
    judge_design,
    present,
    search_inner,
    with_warm_starts_of,
    without_controller,
)
from ccd_casadi.extensions.explorer.knobs import Knobs, Problems, case_at, knobs_of
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant, nearby_model
from ccd_casadi.reporting.machine import find_lumped
from ccd_casadi.sampling.inner_samples import sample_of
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.units import hashes_of, problem_hash, sample_key, unit_of
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.user_code import permit_user_code
from ccd_casadi.support.worker_process import WorkerLost, WorkerProcess, log
from surrogates.files import write_whole

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


@dataclass(frozen=True)
class SessionOptions:
    """Times that decide what a drag waits for."""

    quick: float = 0.4  # of a full search that a drag of S_max waits for, s
    slow: float = 0.1  # of the plant at a θ from which on it is solved in the background, s


class Session:
    """One case in one folder: `live` answers at once, `full` takes the time of the inner search.

    Parameters
    ----------
    case : Case
    folder : Path
    run : FinishedRun, optional
        Where the session starts.
    """

    def __init__(self, case: Case, folder: Path, run: FinishedRun | None = None) -> None:
        self.case, self.folder, self.run = case, folder, run
        self.problems = Problems(case)
        self.start = knobs_of(case)
        if run is not None:
            self.start = replace(self.start, theta=run.theta)
        # of a fixed structure: the last controller, and the problem that it was designed for
        self.kappa = None if run is None else run.kappa
        self.designed_for = None if self.kappa is None or run is None else run.problem
        problem = self.problems.at(self.start)
        began = perf_counter()
        first = elements_at(problem, self.start.theta)
        self.slow = perf_counter() - began > SessionOptions.slow
        self.search_seconds = np.inf  # of the last full search
        found = find_lumped(first.system)
        self.reference = 1.0 if found is None else float(np.abs(found.masses).max())
        self.known: KnownPlant | None = None
        if self.slow:
            self.known = KnownPlant(plant_of(problem), problem.lower, problem.upper)
            self.known.learn(self.start.theta, first.system)
        inner = problem.inner
        # until something was searched: the middle of the ranges
        self.point = tuple(float(np.sqrt(a * b)) for a, b in (inner.omega_S, inner.omega_T))
        self.store = SampleStore(folder / "samples.sqlite")  # last: what is refused opens none

    @property
    def undesigned(self) -> bool:
        """Whether a controller has to be designed before anything is shown, which takes seconds."""
        return self.start.structured and self.kappa is None and self.known is None

    def elements(self, problem: CoDesignProblem, theta: tuple[float, ...]) -> Elements:
        """The plant's matrices at θ as fast as one drags."""
        return elements_at(problem, theta) if self.known is None else self.known.at(theta)

    def live(self, knobs: Knobs) -> ExploredDesign:
        """One certified synthesis at the weights of the last search.

        Of a fixed structure: the last controller, judged at this θ.
        """
        problem = self.problems.at(knobs)
        if kind_of(problem).as_designed:
            return self._judge_held(problem, knobs)
        elements = self.elements(problem, knobs.theta)
        return present(problem, knobs, elements, (self.point[0], self.point[1]))

    def _judge_held(self, problem: CoDesignProblem, knobs: Knobs) -> ExploredDesign:
        problem = with_warm_starts_of(problem, self.designed_for)
        if self.kappa is None:
            elements = elements_at(problem, knobs.theta)
            words = "no controller yet: design one here"
            return without_controller(problem, knobs, elements, How.STRUCTURED, words)
        return judge_design(problem, knobs, self.kappa, How.HELD)

    def took_designed(self, found: Designed) -> ExploredDesign | None:
        """A design of a fixed structure ended: into the store, and the controller of looks to come.

        None where no controller was found.
        """
        key = problem_hash(found.problem.identity())
        self.store.put_problem(key, found.problem.identity())
        self.store.put_unit(found.rows, found.unit, key)
        if found.kappa is None:
            return None
        self.kappa, self.designed_for = found.kappa, found.problem
        return judge_design(found.problem, found.knobs, found.kappa, How.STRUCTURED)

    def full(self, knobs: Knobs) -> ExploredDesign:
        """The inner problem at θ on the model itself."""
        problem = self.problems.at(knobs)
        design = search_inner(problem, knobs, elements_at(problem, knobs.theta))
        self.search_seconds = design.seconds
        self.took(design)
        return design

    @property
    def quick(self) -> bool:
        """Whether a full search is over within a drag's patience."""
        return self.known is None and self.search_seconds < SessionOptions.quick

    def took(self, design: ExploredDesign) -> float | None:
        """A full search ended: its weights are those of the syntheses to come.

        How far off the model of a slow plant was at this θ, relative; None where there was none.
        """
        self.point = (design.figures.omega_S, design.figures.omega_T)
        if self.known is None or not design.elements.exact:
            return None
        return self.known.learn(design.theta, design.elements.system)

    def keep(self, drawn_designs: Sequence[ExploredDesign]) -> None:
        """Write designs that were looked at into the store: a search with every synthesis of it.

        What was made on other matrices than the model's is kept as another problem's.
        """
        for design in drawn_designs:
            problem = design.problem.identity()
            if design.how is How.STRUCTURED:
                continue  # with its unit, or there is none
            if design.kappa is not None:
                problem = problem | {"held": [float(v) for v in design.kappa]}
            if not design.elements.exact:
                problem = problem | {"elements": design.elements.words}
            key = problem_hash(problem)
            self.store.put_problem(key, problem)
            if design.result is None:
                f = design.figures
                own = sample_key(key, design.theta, f.omega_S, f.omega_T)
                self.store.put([sample_of(own, design.theta, f, design.seconds)], key)
                continue
            each = design.seconds / max(design.result.syntheses, 1)
            rows, payload = unit_of(key, design.theta, design.result, design.problem.inner, each)
            optimum = design.result.optimum
            if optimum is not None and optimum.to_theta.shape[1] != len(design.theta):
                self.store.put(rows, key)  # of matrices without derivatives: no sample of ω_b*(θ)
                continue
            inner = hashes_of(design.problem)[1]
            unit = (sample_key(inner, design.theta), inner, design.theta, payload)
            self.store.put_unit(rows, unit, key)

    def save(self, knobs: Knobs) -> Path:
        """The sliders as a case file, beside the store, under a number of its own."""
        place = self._number("explored", ".toml")
        write_whole(place, case_to_toml(case_at(self.case, knobs)))
        return place

    def folder_for_solve(self, knobs: Knobs) -> tuple[Path, Path]:
        """A new folder for a solve from the sliders' θ, and its case file."""
        folder = self._number("solved", "")
        folder.mkdir()
        place = folder / "from_here.toml"
        write_whole(place, case_to_toml(case_at(self.case, knobs)))
        return folder, place

    def _number(self, name: str, suffix: str) -> Path:
        places = (self.folder / f"{name}_{number}{suffix}" for number in count(1))
        return next(place for place in places if not place.exists())


def search_exactly(task: tuple[CoDesignProblem, Knobs], log: Log) -> tuple[ExploredDesign, str]:
    """A full search on the model of a slow plant, and the pictures of its modes: for a worker."""
    problem, knobs = task
    elements = elements_at(problem, knobs.theta)
    return search_inner(problem, knobs, elements), surface_modes_html(problem, knobs.theta)
