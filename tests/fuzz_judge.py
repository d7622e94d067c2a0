"""What is wrong with how a command took an input: an exception, words, an exit code, a false claim.

A design that is called verified is checked again in SI, from controller.json and the plant's M, D,
K, B, C alone.
"""

import json
import os
import resource
import shutil
import signal
import sqlite3
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from fuzz_cases import case_data, toml
from fuzz_inputs import make
from fuzz_values import ROOT, Input
from helpers import (
    HZ,
    dense_grid,
    reference_plant,
    sensitivity_gain,
    stack_gain,
)

import ccd_casadi.report
from ccd_casadi import samples
from ccd_casadi.case import load_case, problem_of
from ccd_casadi.errors import UserError
from ccd_casadi.inner_command import main as inner
from ccd_casadi.insight import main as insight
from ccd_casadi.known import known_designs
from ccd_casadi.plant import constraint_values, mechanics
from ccd_casadi.problem import plant_of
from ccd_casadi.run_folder import read_run
from ccd_casadi.samples import SampleStore
from ccd_casadi.scaling import StateSpace
from ccd_casadi.solve import main as solve
from surrogates import SurrogateFileError, load
from surrogates.retrain import main as retrain
from surrogates.truth import TruthError, opener_of
from surrogates.versions import Versions

COMMANDS = {"solve": solve, "inner": inner, "retrain": retrain, "insight": insight}
STATUS = {0: "verified", 3: "infeasible", 4: "not_verified"}
NOBODY = 65534
CLOSE = 1e-4  # of a figure against the same from a grid


@dataclass(frozen=True)
class Ending:
    """How a call ended: its exit code, what it printed, the traceback of what came out of it."""

    code: int | None
    out: str
    err: str
    trace: str = ""


class Bench:
    """A place to run inputs in, one at a time, with a finished run to spoil copies of."""

    def __init__(self, place: Path, run: Path | None = None) -> None:
        """`run`: the finished run, made here where it is not given."""
        self.place = place
        place.chmod(0o755)
        self.references: dict[str, dict[str, Any]] = {}
        self.base = place / "base" / "run"
        self.base.parent.mkdir()
        if run is not None:
            shutil.copytree(run, self.base)
            versions = Versions(self.base)
            facts = {"samples": 1, "errors": {}, "at_optimum": None, "objective": None}
            versions.add(load(run / "surrogate.json")[0], {}, **facts, created="")  # type: ignore[arg-type]
            (self.base / "retrain.jsonl").write_text('{"event": "start", "spent": 1}\n')
            return
        case = self.base.parent / "case.toml"
        case.write_text(toml(case_data()))
        quick = ["--workers", "1", "--quiet"]
        words = [str(case), "--out", str(self.base), "--formulation", "lifted", *quick]
        with _without_pictures(True):
            assert captured("solve", words).code == 0
            assert captured("retrain", [str(self.base), "--budget", "4", *quick]).code in (0, 4)

    def judged(self, seed: str, keep: bool = False, only: tuple[str, ...] = ()) -> dict[str, Any]:
        """Make the input of a seed, run it (if its command is among `only`), say what is wrong."""
        folder = self.place / "input"
        folder.mkdir()
        began = time.perf_counter()
        verdict: dict[str, Any] = {"seed": seed}
        try:
            given = make(seed, folder, self.base)
            verdict |= {"family": given.family, "command": given.command, "note": given.note}
            if only and given.command not in only:
                return verdict
            if keep:
                verdict |= {"argv": given.argv, "fault": given.fault, "amount": given.amount}
            ending = self._ended(given, folder)
            verdict |= {"code": ending.code, "line": ending.err[-300:].strip()}
            if keep:
                verdict |= {"trace": ending.trace, "out": ending.out[-2000:]}
                kept = Path(tempfile.gettempdir()) / "fuzz_kept"
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(folder, kept, symlinks=True)
            try:
                wrong, judged = self._wrong(given, ending, folder)
            except Exception as error:  # what is claimed cannot even be looked at
                wrong, judged = [f"not judged: {type(error).__name__}: {error}"[:300]], False
            verdict |= {"judged": judged, "wrong": wrong}
        finally:
            os.chdir(ROOT)
            shutil.rmtree(folder)
        if sorted(p.name for p in self.place.iterdir()) != ["base"]:
            verdict["wrong"].append("escape: something was written outside the input's folder")
        verdict["seconds"] = time.perf_counter() - began
        return verdict

    def _ended(self, given: Input, folder: Path) -> Ending:
        with ExitStack() as stack:
            stack.enter_context(_without_pictures(not given.report))
            if given.fault:
                stack.enter_context(FAULTS[given.fault](folder / "run", given.amount))
            return captured(given.command, given.argv, given.interrupt)

    def _wrong(self, given: Input, ending: Ending, folder: Path) -> tuple[list[str], bool]:
        wrong, judged = misbehaviour(given, ending), False
        if ending.code == 0 and not wrong and given.command in ("solve", "inner"):
            out = folder / "run"
            if given.command == "solve":
                answer = json.loads((out / "result.json").read_text())
            else:
                answer = json.loads(ending.out)
            if "--out" in given.argv:
                out = Path(given.argv[given.argv.index("--out") + 1])
                wrong += refuted(Path(given.argv[0]), out, answer, given.command == "solve")
                judged = True
        if given.family in ("interrupt", "fault") and not wrong:
            wrong += self._recovered(given, folder / "run")
        return wrong, judged

    def _recovered(self, given: Input, folder: Path) -> list[str]:
        """Whether the same command, given again undisturbed, ends as if nothing had happened."""
        with _without_pictures(True):
            again = captured(given.command, given.argv)
            if again.code not in (0, 4):
                return [f"not recovered: {again.code} {again.err[-200:]} {again.trace[-300:]}"]
            if given.command != "solve":
                return []
            formulation = given.argv[given.argv.index("--formulation") + 1]
            if formulation not in self.references:
                other = self.place / "reference"
                words = [str(folder / "case.toml"), "--out", str(other), *given.argv[3:]]
                assert captured("solve", words).code in (0, 4)
                self.references[formulation] = _result(other)
                shutil.rmtree(other)
        if _result(folder) != self.references[formulation]:
            return ["not recovered: another result than undisturbed"]
        return []


def _result(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    found.pop("seconds")
    return found


# ---- running -------------------------------------------------------------------------------------


def captured(command: str, argv: list[str], interrupt: float | None = None) -> Ending:
    """Run a command in this process with everything that it prints, CasADi's prints included."""
    call = read if command == "read" else COMMANDS[command]
    code, trace = None, ""
    texts: list[bytes] = [b"", b""]
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("default")
        for number, name, errors in ((1, "stdout", "strict"), (2, "stderr", "backslashreplace")):
            stack.enter_context(_to_pipe(number, name, errors, texts))
        timer = None
        before = signal.getsignal(signal.SIGINT)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if interrupt is not None:
            timer = threading.Timer(interrupt, os.kill, (os.getpid(), signal.SIGINT))
            timer.start()
        try:
            try:
                code = int(call(argv))
            except BaseException:
                trace = traceback.format_exc()
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        except KeyboardInterrupt:
            pass  # Ctrl-C came when the command had ended
        if timer is not None:
            timer.cancel()
            timer.join()
        signal.signal(signal.SIGINT, before)
    out, err = (text.decode("utf-8", "backslashreplace") for text in texts)
    return Ending(code, out, err, trace)


@contextmanager
def _to_pipe(number: int, name: str, errors: str, texts: list[bytes]) -> Iterator[None]:
    """A file descriptor, and Python's stream of it, into texts[number - 1]; no file is written."""
    stream = getattr(sys, name)
    stream.flush()
    kept = os.dup(number)
    reader, writer = os.pipe()
    os.dup2(writer, number)
    os.close(writer)
    pieces: list[bytes] = []

    def drain() -> None:
        while piece := os.read(reader, 1 << 16):
            pieces.append(piece)

    thread = threading.Thread(target=drain)
    thread.start()
    ours = open(number, "w", encoding="utf-8", errors=errors, closefd=False)  # noqa: SIM115
    setattr(sys, name, ours)
    try:
        yield
    finally:
        ours.flush()
        setattr(sys, name, stream)
        os.dup2(kept, number)
        os.close(kept)
        thread.join()
        os.close(reader)
        texts[number - 1] = b"".join(pieces)


def read(argv: list[str]) -> int:
    """Every reader of a run folder; what each refuses must be one of its worded errors."""
    folder, code = Path(argv[0]), 0

    def store() -> None:
        with SampleStore(folder / "samples.sqlite") as opened:
            opened.select()
            problem = problem_of(load_case(folder / "case.toml"))
            known_designs(opened, problem)

    readers: list[tuple[Any, tuple[type[Exception], ...]]] = [
        (lambda: read_run(folder), (UserError,)),
        (lambda: load(folder / "surrogate.json"), (SurrogateFileError, OSError)),
        (lambda: Versions(folder).newest(), (SurrogateFileError, OSError)),
        (store, (UserError,)),
        (lambda: opener_of(folder), (TruthError,)),
    ]
    for reader, worded in readers:
        try:
            reader()
        except worded as error:
            code = 2
            if "\n" in str(error) or len(str(error)) > 2000:
                raise
    if code:
        print("refused", file=sys.stderr)
    return code


@contextmanager
def _without_pictures(skip: bool) -> Iterator[None]:
    def stub(folder: Path, *_: Any) -> None:
        (folder / "report.html").write_text("left out")

    if not skip:
        yield
        return
    with patch.object(ccd_casadi.report, "write_report", stub):
        yield


# ---- faults --------------------------------------------------------------------------------------


@contextmanager
def _full(folder: Path, amount: float) -> Iterator[None]:
    """No file may grow beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(amount), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def _clock(folder: Path, amount: float) -> Iterator[None]:
    """Every look at the clock shows an earlier time."""
    now, looks = time.time(), iter(range(10**9))
    with patch.object(time, "time", lambda: now - amount * next(looks)):
        yield


@contextmanager
def _locked(folder: Path, amount: float) -> Iterator[None]:
    """Somebody else holds the store."""
    other = sqlite3.connect(folder / "samples.sqlite", isolation_level=None)
    try:
        other.execute("pragma locking_mode = exclusive")
        other.execute("begin exclusive")
        with patch.object(samples, "BUSY_SECONDS", 0.2):
            yield
    finally:
        other.close()


@contextmanager
def _readonly(folder: Path, amount: float) -> Iterator[None]:
    """The folder is somebody else's; without the right to change user, it is left as it is."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


FAULTS = {"full": _full, "clock": _clock, "locked": _locked, "readonly": _readonly}


# ---- judging -------------------------------------------------------------------------------------


def misbehaviour(given: Input, ending: Ending) -> list[str]:
    """An exception, a traceback, an exit code or words that break the commands' promises."""
    wrong = []
    if ending.trace:
        wrong.append(f"traceback: {ending.trace.strip().splitlines()[-1][:200]}")
    if "Traceback (most recent" in ending.err + ending.out:
        wrong.append(f"traceback printed: {ending.err[-200:]}")
    if wrong:
        return wrong
    if ending.code not in (0, 2, 3, 4, 130):
        wrong.append(f"exit code {ending.code}")
    lines = ending.err.splitlines()
    if ending.code in (2, 130):
        if len(lines) != 1 or not lines[0].strip():
            wrong.append(f"{len(lines)} lines on stderr: {ending.err[:300]!r}")
        elif not lines[0].isprintable() or len(lines[0]) > 2000:
            wrong.append(f"an unprintable or endless line: {ending.err[:300]!r}")
        if ending.out:
            wrong.append(f"words on stdout: {ending.out[:200]!r}")
    elif any("Warning" in line for line in lines):
        wrong.append(f"a warning: {ending.err[:300]!r}")
    if ending.code == 130 and given.interrupt is None and "KeyboardInterrupt" not in given.note:
        wrong.append(f"interrupted by nobody: {ending.err[:300]!r}")
    if given.command == "inner" and ending.code in STATUS:
        status = json.loads(ending.out)["status"]
        if status != STATUS[ending.code]:
            wrong.append(f"{status} with exit code {ending.code}")
    return wrong


def refuted(case: Path, folder: Path, answer: dict[str, Any], optimum: bool) -> list[str]:
    """What an independent calculation in SI says against a design that is called verified."""
    problem = problem_of(load_case(folder / "case.toml" if optimum else case))
    theta = tuple(answer["theta"].values())
    system = mechanics(plant_of(problem), theta)
    plant = reference_plant(system, problem.suspension)
    data = json.loads((folder / "controller.json").read_text())
    K = StateSpace(*(np.array(data[name]) for name in "ABCD"))
    wrong = []
    BK, KC = plant.B @ K.C, K.B @ plant.C
    loop = np.block([[plant.A - plant.B @ K.D @ plant.C, BK], [-KC, K.A]])
    pole = np.linalg.eigvals(loop).real.max()
    if not pole < 0.0:
        wrong.append(f"refuted: a pole at {pole:.3g} 1/s")
    weights = problem.weights.at(HZ * answer["omega_S_hz"], HZ * answer["omega_T_hz"])
    grid = dense_grid(plant, K)
    gain = sensitivity_gain(plant, K, grid)
    norm = stack_gain(plant, K, weights, grid).max()
    if not norm <= answer["certificate"]["norm_bound"] * (1.0 + 1e-6):
        wrong.append(f"refuted: norm {norm:.9g} above {answer['certificate']['norm_bound']:.9g}")
    if not gain.max() <= answer["sensitivity_peak"] * (1.0 + CLOSE):
        wrong.append(f"refuted: peak {gain.max():.7g}, not {answer['sensitivity_peak']:.7g}")
    bandwidth = HZ * answer["bandwidth_hz"]
    level = 1.0 / np.sqrt(2.0)
    at = float(sensitivity_gain(plant, K, np.array([bandwidth]))[0])
    if abs(at / level - 1.0) > CLOSE or not (gain[grid < bandwidth] <= level * (1 + CLOSE)).all():
        wrong.append(f"refuted: |S| = {at:.7g} at the bandwidth, or above -3 dB below it")
    low = float(sensitivity_gain(plant, K, np.array([problem.inner.omega_low]))[0])
    if abs(low / answer["sensitivity_low"] - 1.0) > CLOSE:
        wrong.append(f"refuted: |S| at omega_low {low:.7g}, not {answer['sensitivity_low']:.7g}")
    if optimum:
        if not gain.max() <= problem.inner.S_max * (1.0 + CLOSE):
            wrong.append(f"refuted: peak {gain.max():.7g} above S_max")
        if not low <= problem.inner.S_low * (1.0 + CLOSE):
            wrong.append(f"refuted: |S| at omega_low {low:.7g} above S_low")
        box = zip(problem.lower, theta, problem.upper, strict=True)
        if not all(a - 1e-9 * (c - a) <= b <= c + 1e-9 * (c - a) for a, b, c in box):
            wrong.append(f"refuted: theta {theta} outside its bounds")
        if not (constraint_values(plant_of(problem), theta) <= 1e-6).all():
            wrong.append("refuted: a constraint of the plant is not met")
    return wrong
