"""Retraining jobs: to the optimum in few evaluations, resumed, repeated, side by side."""

import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import surrogates.truth as truth_module
from ccd_casadi import sampling
from ccd_casadi.retraining import open_run
from ccd_casadi.solve import main as solve
from surrogates import GaussianProcess, SurrogateFileError, load, sobol
from surrogates.acquisition import NEAR, distances
from surrogates.claims import Claims
from surrogates.interface import Array
from surrogates.journal import Journal
from surrogates.retrain import main
from surrogates.retraining import Outcome, Settings, retrain, thinned
from surrogates.truth import Observations, TruthError, TruthInterrupted
from surrogates.versions import Versions

ROOT = Path(__file__).parent.parent
TWO_MASS = ROOT / "runs" / "two_mass.toml"


class Camel:
    """min y_0 s.t. y_1 <= 0 over a box, kept in a JSON-lines file: any expensive function.

    y_0 is least on the border that y_1 draws.
    """

    names, outputs, tolerance = ("a", "b"), ("cost", "limit"), 1e-3
    lower, upper = np.array([0.0, -2.0]), np.array([1.0, 2.0])
    x, y = ca.MX.sym("x", 2), ca.MX.sym("y", 2)
    objective = ca.Function("J", [x, y], [y[0]])
    constraints = ca.Function("g", [x, y], [y[1]])
    describe: dict[str, Any] = {"about": "a camel"}  # noqa: RUF012

    def __init__(self, folder: Path, hole: bool = False, die_after: int = 10**9) -> None:
        self.path, self.hole, self.die_after = folder / "truth.jsonl", hole, die_after
        self.finished: list[Any] = []

    def _rows(self) -> list[list[float]]:
        return [json.loads(line) for line in self.path.read_text().splitlines()] if (
            self.path.exists()
        ) else []  # fmt: skip

    @property
    def spent(self) -> int:
        return len(self._rows())

    def samples(self) -> Observations:
        return self._at(np.array(self._rows()).reshape(-1, 2))

    def evaluate(self, X: Array) -> Observations:
        known = np.array(self._rows()).reshape(-1, 2)
        assert (distances(self, X, known) > NEAR).all(), "this is known already"
        with self.path.open("a") as stream:
            for x in X:
                if self.die_after == 0:
                    raise KeyboardInterrupt
                self.die_after -= 1
                stream.write(json.dumps(list(x)) + "\n")
        return self._at(X)

    def finish(
        self, x: Array | None, surrogates: Sequence[GaussianProcess], version: str | None
    ) -> str:
        self.finished.append((x, version))
        if x is None:
            return "infeasible"
        y = self._at(x[None]).Y[0]
        predicted = [float(process.predict(x[None])[0]) for process in surrogates]
        return "verified" if np.abs(y - predicted).max() <= self.tolerance else "not_verified"

    def _at(self, X: Array) -> Observations:
        a, b = X[:, 0], (X[:, 1] + 2.0) / 4.0
        u, v = a - 0.5, b - 0.25
        Y = np.column_stack([u**2 + v**2 - 2.0 * u - v + 0.3 * np.sin(9.0 * u * v) - 1.0,
                             np.expm1(u) + 0.5 * v])  # fmt: skip
        if self.hole:  # over the best point without the constraint's border
            Y[np.hypot(u - 0.02, v - 0.02) < 0.15] = np.nan
        return Observations(X, Y)


def entries(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "retrain.jsonl").read_text().splitlines()]


def true_cost(truth: Any, x: Array) -> float:
    return float(truth._at(x[None]).Y[0, 0])


# ---- the loop, on a function that knows nothing of control ---------------------------------------


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, Outcome]:
    """A job that ran to its end; its folder is not to be changed."""
    folder = tmp_path_factory.mktemp("camel")
    truth: Any = Camel(folder)
    return folder, truth, retrain(folder, truth, Settings(batch=3))


@pytest.fixture
def copied(undisturbed: tuple[Path, Any, Outcome], tmp_path: Path) -> Path:
    return Path(shutil.copytree(undisturbed[0], tmp_path / "run"))


def test_few_evaluations_reach_the_optimum(undisturbed: tuple[Path, Any, Outcome]) -> None:
    _, truth, outcome = undisturbed
    assert (outcome.status, outcome.reason) == ("verified", "converged")
    assert outcome.spent == truth.spent <= 40
    ((x, version),) = truth.finished
    grid = sobol(truth.lower, truth.upper, 1 << 14, 0)
    Y = truth._at(grid).Y
    least = Y[Y[:, 1] <= 0.0, 0].min()
    assert true_cost(truth, x) <= least + 1e-3 * abs(least)
    assert truth._at(x[None]).Y[0, 1] <= 1e-3
    assert version == outcome.version


def test_the_log_tells_every_round(undisturbed: tuple[Path, Any, Outcome]) -> None:
    start, *rounds, end = entries(undisturbed[0])
    assert (start["event"], end["event"], end["status"]) == ("start", "end", "verified")
    assert [line["round"] for line in rounds] == list(range(1, len(rounds) + 1))
    for line in rounds:
        assert 1 <= len(line["batch"]) == len(line["true"]) <= 3
        assert line["seconds"] > 0.0
    for line in rounds[2:]:  # after the first design
        assert set(line["errors"]) == {"cost", "limit"}
        assert {"samples", "version", "predicted", "error", "step", "improvement"} <= set(line)
    assert rounds[-1]["spent"] == end["spent"]


def test_a_repeated_job_does_nothing(copied: Path) -> None:
    before = {p: p.read_bytes() for p in copied.rglob("*.json*") if p.name != "retrain.jsonl"}
    again = retrain(copied, Camel(copied), Settings(batch=3))
    assert (again.status, again.rounds) == ("verified", 0)
    after = {p: p.read_bytes() for p in copied.rglob("*.json*") if p.name != "retrain.jsonl"}
    assert after == before


@pytest.mark.parametrize("after", [3, 10])
def test_an_interrupted_job_resumes(
    undisturbed: tuple[Path, Any, Outcome], tmp_path: Path, after: int
) -> None:
    with pytest.raises(KeyboardInterrupt):
        retrain(tmp_path, Camel(tmp_path, die_after=after), Settings())
    assert Camel(tmp_path).spent == after
    resumed: Any = Camel(tmp_path)
    outcome = retrain(tmp_path, resumed, Settings())
    assert outcome.status == "verified"
    assert outcome.spent == resumed.spent, "counted from the first job on"
    found, expected = resumed.finished[-1][0], undisturbed[1].finished[-1][0]
    assert true_cost(resumed, found) == pytest.approx(true_cost(resumed, expected), rel=1e-3)


def test_a_budget_is_kept_and_is_the_folders(tmp_path: Path) -> None:
    truth = Camel(tmp_path)
    truth.tolerance = 1e-9
    outcome = retrain(tmp_path, truth, Settings(budget=9, batch=4))
    assert outcome.reason == "budget"
    assert truth.spent == outcome.spent == 9
    again = retrain(tmp_path, truth, Settings(budget=9, batch=4))
    assert (again.rounds, truth.spent) == (0, 9)
    more = retrain(tmp_path, truth, Settings(budget=11, batch=4))
    assert (more.rounds, truth.spent) == (1, 11)


def test_a_budget_too_small_for_anything_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TruthError, match="--budget 3 leaves 3 samples"):
        retrain(tmp_path, Camel(tmp_path), Settings(budget=3))


def test_points_without_truth_do_not_hold_it_up(tmp_path: Path) -> None:
    truth: Any = Camel(tmp_path, hole=True)
    outcome = retrain(tmp_path, truth, Settings(budget=60))
    assert not truth.samples().known.all(), "it ran into the hole"
    x = truth.finished[-1][0]
    assert np.isfinite(true_cost(truth, x))
    assert outcome.status == "verified"
    grid = sobol(truth.lower, truth.upper, 1 << 14, 0)
    Y = truth._at(grid).Y
    least = Y[Y[:, 1] <= 0.0, 0].min()  # NaN is no less than 0
    assert true_cost(truth, x) <= least + 0.05


def test_a_truth_that_has_no_value_at_all(tmp_path: Path) -> None:
    truth: Any = Camel(tmp_path)
    truth._at = lambda X: Observations(X, np.full((len(X), 2), np.nan))
    outcome = retrain(tmp_path, truth, Settings())
    assert outcome.status == "infeasible"
    assert "too few points" in outcome.reason
    assert truth.finished == [(None, None)]


def test_near_duplicates_are_fitted_once(tmp_path: Path) -> None:
    truth: Any = Camel(tmp_path)
    X = sobol(truth.lower, truth.upper, 8, 0)
    close = X + 0.3 * NEAR * (truth.upper - truth.lower)
    observed, failed = thinned(truth, truth._at(np.vstack([X, close])))
    assert len(observed.X) == 8
    assert {tuple(x) for x in observed.X} == {tuple(x) for x in X}, "the first counts"
    assert len(failed) == 0
    turned, _ = thinned(truth, truth._at(X[::-1]))
    np.testing.assert_array_equal(turned.X, observed.X)


# ---- versions, claims, the journal ---------------------------------------------------------------


def test_every_surrogate_is_kept_with_its_error_and_parent(
    undisturbed: tuple[Path, Any, Outcome],
) -> None:
    tmp_path, _, outcome = undisturbed
    versions = Versions(tmp_path)
    names = versions.names()
    index = json.loads((tmp_path / "surrogates" / "index.json").read_text())["versions"]
    assert [record["version"] for record in index] == names
    assert names == [f"{i + 1:04d}" for i in range(len(names))]
    assert [record["parent"] for record in index] == [None, *names[:-1]]
    samples = [record["samples"] for record in index]
    assert samples == sorted(set(samples))
    for record in index:
        assert set(record["errors"]) == {"cost", "limit"}
        assert record["errors"]["cost"]["rms"] > 0.0
    assert index[-1]["at_optimum"] <= 1e-3
    assert outcome.version == names[-1]
    newest, extra = load(tmp_path / "surrogate.json")
    assert extra["about"] == "a camel"
    assert len(newest[0].X) == index[-1]["samples"]
    with pytest.raises(SurrogateFileError, match="no such version; known are 0001 to"):
        versions.load("../surrogate")


def test_numbers_are_never_shared(copied: Path) -> None:
    versions = Versions(copied)
    processes, record = versions.load("0001")
    facts = {k: v for k, v in vars(record).items() if k not in ("version", "parent")}
    count = len(versions.names())
    script = (
        "import sys; from surrogates.versions import Versions\n"
        "v = Versions(__import__('pathlib').Path(sys.argv[1]))\n"
        "p, r = v.load('0001')\n"
        "facts = {k: x for k, x in vars(r).items() if k not in ('version', 'parent')}\n"
        "v.publish = lambda: None\n"
        "for _ in range(15): v.add(p, {}, **facts)\n"
    )
    other = subprocess.Popen([sys.executable, "-c", script, str(copied)], cwd=ROOT)
    for _ in range(15):
        versions.add(processes, {}, **facts)
    assert other.wait(60) == 0
    versions.publish()
    names = versions.names()
    assert len(names) == count + 30
    assert [int(name) for name in names] == list(range(1, len(names) + 1))
    index = json.loads((copied / "surrogates" / "index.json").read_text())["versions"]
    assert [item["version"] for item in index] == names


CLAIM = """
import sys, time
import numpy as np
from pathlib import Path
from surrogates.claims import Claims
claims = Claims(Path(sys.argv[1]), 2)
with claims.deciding():
    claim = claims.claim(np.array([[0.1, 0.2]]))
print("claimed", flush=True)
time.sleep(60)
"""


def test_points_in_flight_elsewhere_are_known_until_their_job_dies(tmp_path: Path) -> None:
    claims = Claims(tmp_path, 2)
    other = subprocess.Popen(
        [sys.executable, "-c", CLAIM, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "claimed\n"
    with claims.deciding():
        np.testing.assert_array_equal(claims.others(), [[0.1, 0.2]])
        with claims.claim(np.array([[0.5, 0.5]])):
            assert len(list(claims.folder.glob("*.json"))) == 2
    other.kill()
    other.communicate()
    with claims.deciding():
        assert len(claims.others()) == 0
    assert list(claims.folder.glob("*.json")) == []


def test_a_spoilt_log_line_spoils_no_other(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "log.jsonl")
    journal.append(event="start", value=np.float64("nan"), X=np.eye(2))
    with journal.path.open("a") as stream:
        stream.write('{"event": "rou')
    journal.append(event="end")
    assert [entry["event"] for entry in journal.entries()] == ["start", "end"]
    assert journal.entries()[0] == {"event": "start", "value": None, "X": [[1, 0], [0, 1]]}


# ---- the command ---------------------------------------------------------------------------------


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Install a truth as the only one, under the name "camel"."""

    def install(make: Any) -> None:
        @contextmanager
        def opened(folder: Path, **_: Any) -> Iterator[Any]:
            yield make(folder)

        class Point:
            name = "camel"

            def load(self) -> Any:
                return opened

        monkeypatch.setattr(truth_module, "entry_points", lambda group: [Point()])

    return install


def test_exit_codes(
    copied: Path,
    tmp_path: Path,
    installed: Callable[[Any], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    installed(Camel)
    assert main([str(copied), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert main([str(copied)]) == 0
    assert capsys.readouterr().out.startswith("verified (converged): 0 rounds")

    class Empty(Camel):
        def _at(self, X: Array) -> Observations:
            return Observations(X, np.full((len(X), 2), np.nan))

    class Killed(Camel):
        def evaluate(self, X: Array) -> Observations:
            raise TruthInterrupted("a worker died twice")

    class Doubtful(Camel):
        def finish(self, *_: Any) -> str:
            return "not_verified"

    shutil.copytree(copied, tmp_path / "Doubtful")
    for kind, code in ((Empty, 3), (Doubtful, 4), (Killed, 130)):
        folder = tmp_path / kind.__name__
        folder.mkdir(exist_ok=True)
        installed(kind)
        assert main([str(folder), "--quiet"]) == code
        output, errors = capsys.readouterr()
        assert output == ""
        assert len(errors.splitlines()) == 1
        assert ("resumes" in errors) == (code == 130)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "is missing, and there is not one truth installed but: camel, other"),
        ("{", "is no readable JSON"),
        ("[]", "truth: is missing"),
        ('{"truth": 3}', "truth: is missing"),
        ('{"truth": "os:system"}', "truth: 'os:system' is not installed (known: camel, other)"),
        ('{"truth": "../evil.py"}', "is not installed"),
        ('{"truth": "a\\u001b[2J"}', "'a\\x1b[2J' is not installed"),
    ],
)
def test_a_folder_that_names_no_known_truth_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    text: str | None,
    words: str,
) -> None:
    points = [type("Point", (), {"name": name})() for name in ("other", "camel")]
    monkeypatch.setattr(truth_module, "entry_points", lambda group: points)
    if text is not None:
        (tmp_path / "truth.json").write_text(text)
    assert main([str(tmp_path)]) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert errors.startswith(f"{tmp_path / 'truth.json'}: ")
    assert words in errors


@pytest.mark.parametrize(
    "more",
    [["--budget", "0"], ["--budget", "many"], ["--tolerance", "nan"], ["--tolerance", "-1"],
     ["--batch", "0"], ["--explore", "1.5"], ["--workers", "0"], ["--seed", "-1"], ["--no"]],
)  # fmt: skip
def test_wrong_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    assert main([str(tmp_path), *more]) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert more[0] in errors
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "absent")]) == 2
    assert "there is no such run folder" in capsys.readouterr().err


# ---- case study 1 --------------------------------------------------------------------------------


def started_from(folder: Path, n: int = 16, case: Path = TWO_MASS) -> Path:
    """A run folder with a case and a few samples, and nothing else."""
    folder.mkdir()
    shutil.copy(case, folder / "case.toml")
    with open_run(folder, tolerance=None, workers=1, seed=0, quiet=True) as truth:
        truth.evaluate(sobol(truth.lower, truth.upper, n, 0))
    return folder


def job(folder: Path, **settings: Any) -> Any:
    with open_run(folder, tolerance=None, workers=1, seed=0, quiet=True) as truth:
        return retrain(folder, truth, Settings(**settings))


@pytest.fixture(scope="module")
def retrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = started_from(tmp_path_factory.mktemp("two_mass") / "run")
    outcome = job(folder)
    assert (outcome.status, outcome.reason) == ("verified", "converged")
    return folder


def result(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


def test_sixteen_samples_are_enough_to_begin_with(retrained: Path) -> None:
    found = result(retrained)
    assert found["status"] == "verified"
    assert found["objective"] == pytest.approx(-439.4648, abs=1e-3)
    assert found["formulation"] == "lifted"
    assert set(found["active"]) == {"m1 lower", "m2 lower", "S_max", "omega_S upper"}
    assert found["retraining"]["version"] == Versions(retrained).names()[-1]
    rounds = [line for line in entries(retrained) if line["event"] == "round"]
    assert 16 + sum(len(line["batch"]) for line in rounds) <= 40
    for name in ("controller.json", "report.html", "surrogate.json", "truth.json"):
        assert (retrained / name).stat().st_size > 0


def test_nothing_is_computed_a_second_time(
    retrained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def untouchable(*_: Any) -> None:
        raise AssertionError("this was sampled already")

    for name in ("inner_unit", "design_unit", "true_design"):
        monkeypatch.setattr(sampling, name, untouchable)
    before = result(retrained)
    outcome = job(retrained)
    assert (outcome.status, outcome.rounds) == ("verified", 0)
    assert result(retrained) == before


@pytest.mark.parametrize("name", ["0001", pytest.param("0002", marks=pytest.mark.slow)])
def test_solve_starts_from_a_named_version(retrained: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "run"
    shutil.copytree(retrained / "surrogates", folder / "surrogates")
    words = [str(TWO_MASS), "--out", str(folder), "--workers", "1", "--quiet"]
    assert solve([*words, "--formulation", "lifted", "--surrogate", name]) == 0
    found = result(folder)
    assert found["objective"] == pytest.approx(-439.4648, abs=1e-3)
    assert found["syntheses"] < 16 + 48, "without the 24 samples of the usual start"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--surrogate", "0099"], "there is no such version; known are 0001 to"),
        (["--surrogate", "../../x"], "there is no such version"),
        (["--surrogate", "0001", "--formulation", "nested"], "no surrogate of the nested form"),
        (["--surrogate", "0001", "--formulation", "direct"], "no surrogate of the direct form"),
    ],
)
def test_solve_refuses_a_version_that_is_none(
    retrained: Path, capsys: pytest.CaptureFixture[str], more: list[str], words: str
) -> None:
    line = [str(TWO_MASS), "--out", str(retrained), "--quiet", "--formulation", "lifted", *more]
    before = result(retrained)
    assert solve(line) == 2
    output, errors = capsys.readouterr()
    assert (output, len(errors.splitlines())) == ("", 1)
    assert words in errors
    assert result(retrained) == before


def test_a_nested_run_is_retrained_over_theta(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(TWO_MASS, folder / "case.toml")
    (folder / "truth.json").write_text('{"truth": "ccd_casadi", "formulation": "nested"}')
    outcome = job(folder)
    assert outcome.status == "verified"
    found = result(folder)
    assert found["formulation"] == "nested"
    assert found["objective"] == pytest.approx(-439.4648, abs=1e-3)
    newest, _ = load(folder / "surrogate.json")
    assert newest[0].X.shape[1] == 2
    count = found["syntheses"]
    words = [str(TWO_MASS), "--out", str(folder), "--workers", "1", "--quiet"]
    assert solve([*words, "--surrogate", "0001"]) == 0
    with sqlite3.connect(folder / "samples.sqlite") as database:
        (after,) = database.execute("select count(*) from samples").fetchone()
    assert after <= count + 200, "its thetas were found in the store"


def test_a_damaged_case_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "truth.json").write_text('{"truth": "ccd_casadi"}')
    if "ccd_casadi" not in {p.name for p in truth_module.entry_points(group=truth_module.GROUP)}:
        pytest.skip("the package was installed before it had the entry point: run make setup")
    assert main([str(tmp_path)]) == 2
    assert f"{tmp_path / 'case.toml'}: there is no such file" in capsys.readouterr().err
    (tmp_path / "case.toml").write_text("[plant]\n")
    assert main([str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    shutil.copy(TWO_MASS, tmp_path / "case.toml")
    (tmp_path / "truth.json").write_text('{"truth": "ccd_casadi", "formulation": "both"}')
    assert main([str(tmp_path)]) == 2
    assert "formulation: 'both' is unknown" in capsys.readouterr().err
    (tmp_path / "truth.json").write_text('{"truth": "ccd_casadi"}')
    (tmp_path / "samples.sqlite").write_text("no samples\n" * 100)
    assert main([str(tmp_path)]) == 2
    assert "samples.sqlite" in capsys.readouterr().err


# ---- real processes ------------------------------------------------------------------------------


JOB = """
import sys
from pathlib import Path
from ccd_casadi.retraining import open_run
import surrogates.truth as module

class Point:
    name = "ccd_casadi"
    def load(self):
        return open_run

module.entry_points = lambda group: [Point()]
import surrogates.retrain
raise SystemExit(surrogates.retrain.main(sys.argv[1:]))
"""


def launched(folder: Path, *more: str) -> subprocess.Popen[str]:
    """The command, with its entry point whether or not the package is installed anew."""
    return subprocess.Popen(
        [sys.executable, "-c", JOB, str(folder), "--quiet", "--workers", "1", *more],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def keys(folder: Path) -> list[str]:
    with sqlite3.connect(folder / "samples.sqlite") as database:
        return [row[0] for row in database.execute("select key from samples")]


@pytest.mark.slow
def test_ctrl_c_ends_it_soon_and_it_resumes(tmp_path: Path) -> None:
    folder = started_from(tmp_path / "run")
    process = launched(folder)
    limit = time.monotonic() + 60.0
    while not (folder / "retrain.jsonl").exists() and process.poll() is None:
        assert time.monotonic() < limit
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    began = time.monotonic()
    output, errors = process.communicate(timeout=30)
    if process.returncode == 0:
        pytest.skip("it had finished")
    assert (process.returncode, output) == (130, "")
    assert time.monotonic() - began < 2.0
    assert len(errors.splitlines()) == 1
    assert "resumes" in errors
    assert not (folder / "result.json").exists()


@pytest.mark.slow
def test_killed_at_random_it_ends_the_same(retrained: Path, tmp_path: Path) -> None:
    folder = started_from(tmp_path / "run")
    rng, killed = random.Random(4), 0
    began = time.monotonic()
    plain = launched(started_from(tmp_path / "plain"))
    plain.communicate()
    whole = time.monotonic() - began
    while killed < 20:
        process = launched(folder)
        time.sleep(rng.uniform(0.2, 1.0) * whole)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if process.returncode == -signal.SIGKILL:
            killed += 1
        else:
            assert process.returncode == 0
            shutil.rmtree(folder)
            started_from(folder)
    assert job(folder).status == "verified"
    assert len(set(keys(folder))) == len(keys(folder))
    ours, theirs = result(folder), result(retrained)
    assert ours["objective"] == pytest.approx(theirs["objective"], rel=1e-6)
    assert ours["theta"] == pytest.approx(theirs["theta"], rel=1e-6)
    assert ours["active"] == theirs["active"]
    for path in (folder / "surrogates").glob("*.json"):
        json.loads(path.read_text())


@pytest.mark.slow
def test_two_jobs_lose_and_double_nothing(retrained: Path, tmp_path: Path) -> None:
    folder = started_from(tmp_path / "run")
    both = [launched(folder, "--batch", "2") for _ in range(2)]
    assert [process.communicate()[1] for process in both] == ["", ""]
    assert [process.returncode for process in both] == [0, 0]
    rounds = [line for line in entries(folder) if line["event"] == "round"]
    X = np.array([x for line in rounds for x in line["batch"]])
    with open_run(folder, tolerance=None, workers=1, seed=0, quiet=True) as truth:
        gaps = [distances(truth, X[i : i + 1], np.delete(X, i, axis=0))[0] for i in range(len(X))]
        known = truth.samples().X
        assert (distances(truth, X, known) <= 1e-9).all(), "nothing is lost"
    assert min(gaps) > NEAR, "no point was asked twice"
    names = Versions(folder).names()
    assert [int(name) for name in names] == list(range(1, len(names) + 1))
    index = json.loads((folder / "surrogates" / "index.json").read_text())["versions"]
    assert [record["version"] for record in index] == names
    assert len({record["samples"] for record in index}) == len(index)
    assert result(folder)["objective"] == pytest.approx(result(retrained)["objective"], rel=1e-6)
    assert job(folder).rounds == 0
