"""Retraining jobs: to the optimum in few evaluations, resumed, repeated, one at a time."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camel import Camel, true_cost

from ccd_casadi.codesign.acquisition import NEAR
from ccd_casadi.codesign.retraining import Outcome, Settings, retrain, thinned
from ccd_casadi.codesign.truth import Observations
from ccd_casadi.codesign.versions import FOLDER, LOCK, load_version, only_job, version_names
from ccd_casadi.support.errors import UserError
from surrogates import SurrogateFileError, load, sobol

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


def test_a_repeated_job_does_nothing(camel_copy: Path) -> None:
    before = {p: p.read_bytes() for p in camel_copy.rglob("*") if p.is_file()}
    again = retrain(camel_copy, Camel(camel_copy), Settings(batch=3))
    assert (again.status, again.rounds) == ("verified", 0)
    after = {p: p.read_bytes() for p in camel_copy.rglob("*") if p.is_file()}
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
    with pytest.raises(UserError, match="--budget 3 leaves 3 samples"):
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


# ---- versions, and one job at a time -------------------------------------------------------------


def test_every_surrogate_is_kept_with_its_error_and_parent(
    camel_run: tuple[Path, Any, Outcome],
) -> None:
    tmp_path, _, outcome = camel_run
    names = version_names(tmp_path)
    index = [load(tmp_path / FOLDER / f"{name}.json")[1]["version"] for name in names]
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
        load_version(tmp_path, "../surrogate")


JOB = """
import sys
from pathlib import Path
from ccd_casadi.codesign.versions import only_job
with only_job(Path(sys.argv[1]), 7):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_job_is_refused_until_the_first_one_dies(tmp_path: Path) -> None:
    other = subprocess.Popen(
        [sys.executable, "-c", JOB, str(tmp_path)],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    with pytest.raises(UserError, match="wait for the job"):
        retrain(tmp_path, Camel(tmp_path), Settings(budget=9))
    other.kill()
    other.communicate()
    with only_job(tmp_path, 9) as base:
        assert base == 7, "what the first job found"
    (tmp_path / LOCK).write_text("no database " * 100)
    with pytest.raises(UserError, match="not a database"):
        retrain(tmp_path, Camel(tmp_path), Settings(budget=9))
