"""Runs a command on an input, in this process, and says what was wrong with how it took it."""

import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import ccd_casadi.reporting.solve_page
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.codesign.retraining import keep_version, only_job, stored_designs
from ccd_casadi.inner import main as inner
from ccd_casadi.insight import main as insight
from ccd_casadi.retrain import formulation_in
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.solve import main as solve
from ccd_casadi.support.errors import UserError
from oracles.fuzz_cases import case_data, toml
from oracles.fuzz_faults import FAULTS
from oracles.fuzz_inputs import make
from oracles.fuzz_judge import Ending, misbehaviour
from oracles.fuzz_refute import refuted
from oracles.fuzz_values import ROOT, Input
from surrogates import SurrogateFileError, load
from surrogates.retrain import main as retrain

COMMANDS = {"solve": solve, "inner": inner, "retrain": retrain, "insight": insight}


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
            keep_version(self.base, load(run / "surrogate.json")[0], {}, samples=1)  # type: ignore[arg-type]
            with only_job(self.base, 1):
                pass
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
            stored_designs(opened, problem)

    readers: list[tuple[Any, tuple[type[Exception], ...]]] = [
        (lambda: read_run(folder), (UserError,)),
        (lambda: load(folder / "surrogate.json"), (SurrogateFileError, OSError)),
        (lambda: load(folder / "surrogates/0001.json"), (SurrogateFileError, OSError)),
        (store, (UserError,)),
        (lambda: formulation_in(folder), (UserError,)),
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
    with patch.object(ccd_casadi.reporting.solve_page, "write_report", stub):
        yield
