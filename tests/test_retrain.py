"""Retraining jobs: to the optimum in few evaluations, resumed, repeated, side by side."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camel import Camel, entries, true_cost

from surrogates import SurrogateFileError, load, sobol
from surrogates.acquisition import NEAR
from surrogates.journal import Journal
from surrogates.pending_points import PendingPoints
from surrogates.retraining import Outcome, Settings, retrain, thinned
from surrogates.truth import Observations, TruthError
from surrogates.versions import Versions

ROOT = Path(__file__).parent.parent


# ---- the loop, on a function that knows nothing of control ---------------------------------------


def test_few_evaluations_reach_the_optimum(camel_run: tuple[Path, Any, Outcome]) -> None:
    _, truth, outcome = camel_run
    assert (outcome.status, outcome.reason) == ("verified", "converged")
    assert outcome.spent == truth.spent <= 40
    ((x, version),) = truth.finished
    grid = sobol(truth.lower, truth.upper, 1 << 14, 0)
    Y = truth._at(grid).Y
    least = Y[Y[:, 1] <= 0.0, 0].min()
    assert true_cost(truth, x) <= least + 1e-3 * abs(least)
    assert truth._at(x[None]).Y[0, 1] <= 1e-3
    assert version == outcome.version


def test_the_log_tells_every_round(camel_run: tuple[Path, Any, Outcome]) -> None:
    start, *rounds, end = entries(camel_run[0])
    assert (start["event"], end["event"], end["status"]) == ("start", "end", "verified")
    assert [line["round"] for line in rounds] == list(range(1, len(rounds) + 1))
    for line in rounds:
        assert 1 <= len(line["batch"]) == len(line["true"]) <= 3
        assert line["seconds"] > 0.0
    for line in rounds[2:]:  # after the first design
        assert set(line["errors"]) == {"cost", "limit"}
        assert {"samples", "version", "predicted", "error", "step", "improvement"} <= set(line)
    assert rounds[-1]["spent"] == end["spent"]


def test_a_repeated_job_does_nothing(camel_copy: Path) -> None:
    before = {p: p.read_bytes() for p in camel_copy.rglob("*.json*") if p.name != "retrain.jsonl"}
    again = retrain(camel_copy, Camel(camel_copy), Settings(batch=3))
    assert (again.status, again.rounds) == ("verified", 0)
    after = {p: p.read_bytes() for p in camel_copy.rglob("*.json*") if p.name != "retrain.jsonl"}
    assert after == before


@pytest.mark.parametrize("after", [pytest.param(3, marks=pytest.mark.slow), 10])
def test_an_interrupted_job_resumes(
    camel_run: tuple[Path, Any, Outcome], tmp_path: Path, after: int
) -> None:
    with pytest.raises(KeyboardInterrupt):
        retrain(tmp_path, Camel(tmp_path, die_after=after), Settings())
    assert Camel(tmp_path).spent == after
    resumed: Any = Camel(tmp_path)
    outcome = retrain(tmp_path, resumed, Settings())
    assert outcome.status == "verified"
    assert outcome.spent == resumed.spent, "counted from the first job on"
    found, expected = resumed.finished[-1][0], camel_run[1].finished[-1][0]
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


@pytest.mark.slow
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


# ---- versions, pending points, the journal -------------------------------------------------------


def test_every_surrogate_is_kept_with_its_error_and_parent(
    camel_run: tuple[Path, Any, Outcome],
) -> None:
    tmp_path, _, outcome = camel_run
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


def test_numbers_are_never_shared(camel_copy: Path) -> None:
    versions = Versions(camel_copy)
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
    other = subprocess.Popen([sys.executable, "-c", script, str(camel_copy)], cwd=ROOT)
    for _ in range(15):
        versions.add(processes, {}, **facts)
    assert other.wait(60) == 0
    versions.publish()
    names = versions.names()
    assert len(names) == count + 30
    assert [int(name) for name in names] == list(range(1, len(names) + 1))
    index = json.loads((camel_copy / "surrogates" / "index.json").read_text())["versions"]
    assert [item["version"] for item in index] == names


CLAIM = """
import sys, time
import numpy as np
from pathlib import Path
from surrogates.pending_points import PendingPoints
pending = PendingPoints(Path(sys.argv[1]), 2)
with pending.deciding():
    reservation = pending.reserve(np.array([[0.1, 0.2]]))
print("reserved", flush=True)
time.sleep(60)
"""


def test_points_in_flight_elsewhere_are_known_until_their_job_dies(tmp_path: Path) -> None:
    pending = PendingPoints(tmp_path, 2)
    other = subprocess.Popen(
        [sys.executable, "-c", CLAIM, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "reserved\n"
    with pending.deciding():
        np.testing.assert_array_equal(pending.others(), [[0.1, 0.2]])
        with pending.reserve(np.array([[0.5, 0.5]])):
            assert len(list(pending.folder.glob("*.json"))) == 2
    other.kill()
    other.communicate()
    with pending.deciding():
        assert len(pending.others()) == 0
    assert list(pending.folder.glob("*.json")) == []


def test_a_spoilt_log_line_spoils_no_other(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "log.jsonl")
    journal.append(event="start", value=np.float64("nan"), X=np.eye(2))
    with journal.path.open("a") as stream:
        stream.write('{"event": "rou')
    journal.append(event="end")
    assert [entry["event"] for entry in journal.entries()] == ["start", "end"]
    assert journal.entries()[0] == {"event": "start", "value": None, "X": [[1, 0], [0, 1]]}
