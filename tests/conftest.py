"""One BLAS thread: the matrices are small, and figures then repeat to the last digit."""

import fcntl
import gc
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from ccd_casadi.drawing import charts
from ccd_casadi.support import time_budget

PAINTS = {name: getattr(charts, name) for name in ("_draw", "to_svg")}

# A shell's background job, or a CI runner, may have Ctrl-C ignored, and children inherit that.
# The tests of interrupts are about how commands behave where it is not.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# What every property test has in common; a test only says how many examples it wants. "same" draws
# the same examples each time; "study" (HYPOTHESIS_PROFILE=study) draws anew, for
# `make test-processors`. No wall clock anywhere: the machine may be busy.
for profile, repeat in (("same", True), ("study", False)):
    settings.register_profile(
        profile,
        derandomize=repeat,
        deadline=None,
        database=None,
        print_blob=not repeat,
        suppress_health_check=[HealthCheck.too_slow],
    )
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


def pytest_collection_finish() -> None:
    """What is collected lasts: without this the garbage collector walks it a thousand times."""
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


@pytest.fixture(scope="session", autouse=True)
def timeless() -> None:
    """No time budget ends a search here, however busy the machine is: the clock of budgets stands,
    and for worker processes far ahead."""
    time_budget.time = SimpleNamespace(monotonic=lambda: 1e9)  # type: ignore[attr-defined]


@contextmanager
def painting(on: bool) -> Iterator[None]:
    """Pages of this process with pictures, or without: these take seconds a page."""
    with pytest.MonkeyPatch.context() as patch:
        for name, own in PAINTS.items():
            patch.setattr(charts, name, own if on else lambda *_: "")
        yield


@pytest.fixture(scope="module", autouse=True)
def pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Pictures are drawn in the room of pages and by studies; other tests read the words."""
    room, study = request.path.parent.name, request.config.option.markexpr == "slow"
    with painting(room == "pages" or study):
        yield


@pytest.fixture(scope="session", autouse=True)
def short_verdicts() -> Iterator[None]:
    """Every line of a verdict that any test makes has 25 words at most, and none had to be cut; as
    result.json has it, it renders to the same words but of what is not finite. No figure has the
    name of what words are derived to."""
    from ccd_casadi.codesign.reasons import DERIVED
    from ccd_casadi.codesign.verdict import Check
    from ccd_casadi.support.json_files import json_values

    made, reading = Check.__init__, False

    def checked(self: Check, *args: Any, **named: Any) -> None:
        nonlocal reading
        made(self, *args, **named)
        if reading:
            return
        reading = True
        again = Check.read(self.name, json_values(self.entry)).clauses
        reading = False
        finite = re.search(r"\b(inf|nan)\b", "; ".join(self.clauses)) is None
        assert again == self.clauses or not finite, again
        long = [one for one in self.clauses if len(one.split()) > 25 or one.endswith(" ...")]
        assert not long, long
        named_figures = [self.figures, *(one.figures for one in self.findings)]
        assert not any(set(figures) & set(DERIVED) for figures in named_figures), self.name

    Check.__init__ = checked  # type: ignore[method-assign]
    yield
    Check.__init__ = made  # type: ignore[method-assign]


@pytest.fixture(scope="session")
def common_folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """A folder by name for all processes of pytest-xdist, in a `with` that one enters at a time."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    @contextmanager
    def folder(name: str) -> Iterator[Path]:
        place = base / f"shared_{name}"
        place.mkdir(exist_ok=True)
        with (base / f"{name}.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed
            yield place

    return folder


@pytest.fixture(scope="session")
def solved(common_folder: Callable[[str], Any]) -> Callable[[str], Path]:
    """The run folder of case study 1 in a formulation, its pages where that is "lifted"; it is
    not to be changed."""

    def solve(formulation: str) -> Path:
        from oracles.commands import run

        with common_folder(f"two_mass_{formulation}") as place:
            folder: Path = place / "run"
            if not folder.exists():
                pages = [] if formulation == "lifted" else ["--no-report"]
                with painting(True):
                    assert run(place / "making", "--formulation", formulation, *pages) == 0
                (place / "making").rename(folder)
        return folder

    return solve


@pytest.fixture(scope="session")
def examined(common_folder: Callable[[str], Any], solved: Callable[[str], Path]) -> Path:
    """The run folder of case study 1 with every page that commands write; not to be changed."""
    from importlib import import_module

    with common_folder("examined") as place:
        folder: Path = place / "run"
        if not folder.exists():
            making, other = place / "making", solved("lifted")
            shutil.copytree(other, making, ignore=shutil.ignore_patterns("*-shm", "*-wal"))
            with painting(True):
                for command, *words in (
                    ("robustness", making), ("deploy", making),
                    ("insight", making, "--points", "3", "--workers", "1"),
                    ("feedforward", making, "--controller", making / "deploy/controller.json",
                     "--taps", "1"),
                    ("report", making, "--brief"), ("report", other, making),
                ):  # fmt: skip
                    main = import_module(f"ccd_casadi.{command}").main
                    main([*map(str, words), "--quiet"])
            making.rename(folder)
    return folder


@pytest.fixture(scope="session")
def two_mass_run(solved: Callable[[str], Path]) -> Path:
    """The run folder of case study 1 by the lifted formulation; it is not to be changed."""
    return solved("lifted")


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from oracles.dask_processes import Processes

    processes = Processes(tmp_path_factory.mktemp("dask"))
    try:
        yield processes
    finally:
        processes.kill()


@pytest.fixture
def shared(lasting: Any) -> Any:
    """A scheduler and two workers, started anew only where the test before has broken them."""
    if not lasting.whole():
        lasting.kill()
        lasting.start()
        lasting.answers()
    return lasting


@pytest.fixture
def nannies(tmp_path: Path) -> Iterator[Any]:
    """The same with nannies, which restart workers."""
    from oracles.dask_processes import Processes

    processes = Processes(tmp_path, nanny=True)
    try:
        processes.start()
        yield processes
    finally:
        processes.kill()


@pytest.fixture  # of one test: other event loops cannot run in this thread beside the browser's
def browser() -> Iterator[Any]:
    """Headless Chromium, where there is one."""
    from oracles.chromium import chromium

    with chromium() as made:
        yield made
