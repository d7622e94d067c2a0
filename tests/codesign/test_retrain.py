"""Retraining jobs: to the optimum in few syntheses, resumed, repeated, one at a time."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.busy import HANGS

import ccd_casadi as ccd
from ccd_casadi.codesign.outer_mixed import MixedOuter
from ccd_casadi.codesign.retraining import FOLDER, LOCK, Job, RetrainingEnd, only_job, version_names
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers
from surrogates import load, sobol

ROOT = Path(__file__).parents[2]
CASE = ccd.load_case(ccd.TWO_MASS)
FIRST = 12  # samples that a first fit takes: three an input


def job(
    folder: Path, formulation: str = "lifted", problem: CoDesignProblem | None = None, **more: Any
) -> tuple[RetrainingEnd, list[Solution]]:
    """A job that keeps result.json alone, and the solutions that it wrote."""
    written: list[Solution] = []

    def write(solution: Solution) -> None:
        written.append(solution)
        (folder / "result.json").write_text(json.dumps(solution.result))
        (folder / "report.html").write_text("")

    with Workers(1) as workers, SampleStore(folder / "samples.sqlite") as store:
        sampler = Sampler(problem or ccd.problem_of(CASE), store, workers, quiet=True)
        base = more.pop("base", 0)
        found = Job(folder, CASE, MixedOuter(sampler), formulation, base, **more).run(write)
    return found, written


@pytest.fixture(scope="module")
def retrained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RetrainingEnd, Solution]:
    folder = tmp_path_factory.mktemp("run")
    outcome, (solution,) = job(folder)
    return folder, outcome, solution


@pytest.fixture
def copy(retrained: tuple[Path, RetrainingEnd, Solution], tmp_path: Path) -> Path:
    return Path(shutil.copytree(retrained[0], tmp_path / "run"))


@pytest.mark.slow
def test_few_syntheses_reach_the_optimum(retrained: tuple[Path, RetrainingEnd, Solution]) -> None:
    _, outcome, solution = retrained
    assert (outcome.status, outcome.reason) == ("verified", "converged")
    assert outcome.spent <= 60
    assert solution.result["objective"] == pytest.approx(-438.7564, abs=1e-3)
    assert solution.result["syntheses"] == outcome.spent
    assert solution.result["retraining"]["version"] == outcome.version == "0001"


def test_a_repeated_job_does_nothing(copy: Path) -> None:
    before = {p: p.read_bytes() for p in copy.rglob("*.json")}
    again, written = job(copy)
    assert (again.status, again.reason, again.rounds) == ("verified", "nothing new", 0)
    assert not written
    assert {p: p.read_bytes() for p in copy.rglob("*.json")} == before


def test_a_tighter_tolerance_goes_on_from_the_samples(copy: Path) -> None:
    again, (solution,) = job(copy, tolerance=1e-6)
    assert (again.status, again.version) == ("verified", "0002")
    assert solution.result["retraining"]["tolerance"] == 1e-6
    old, new = (load(copy / FOLDER / f"{name}.json") for name in version_names(copy))
    assert len(new[0][0].X) > len(old[0][0].X)
    assert new[1]["version"]["parent"] == "0001"


def test_an_interrupted_job_resumes(
    retrained: tuple[Path, RetrainingEnd, Solution], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, required = Sampler.quantities, []

    def dies(self: Sampler, X: Any, *label: str) -> Any:
        required.append(X)
        if len(required) == 3:
            raise KeyboardInterrupt
        return real(self, X, *label)

    with monkeypatch.context() as patched:
        patched.setattr(Sampler, "quantities", dies)
        with pytest.raises(KeyboardInterrupt):
            job(tmp_path)
    with SampleStore(tmp_path / "samples.sqlite") as store:
        kept = store.count()
    assert kept > FIRST
    outcome, (solution,) = job(tmp_path)
    assert outcome.status == "verified"
    expected = retrained[2].result["objective"]
    assert solution.result["objective"] == pytest.approx(expected, rel=1e-5)
    assert outcome.spent <= retrained[1].spent + 5, "what was sampled is used"


@pytest.mark.slow
def test_a_budget_ends_a_job_and_is_the_folders(tmp_path: Path) -> None:
    """A `direct` run keeps its name; it was called `lifted` once it had been trained again."""
    outcome, (solution,) = job(tmp_path, "direct", budget=FIRST + 1, tolerance=1e-12)
    assert (outcome.reason, outcome.rounds) == ("budget", 1)
    assert solution.outcome.surrogates
    assert solution.result["formulation"] == "direct"
    again, written = job(tmp_path, "direct", budget=FIRST + 1, tolerance=1e-12)
    assert (again.reason, written) == ("nothing new", [])
    more, _ = job(tmp_path, "direct", budget=outcome.spent + 3, tolerance=1e-12)
    assert more.rounds == 3


def test_a_budget_too_small_for_a_first_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--budget 3 leaves \d samples, too few for a first fit"):
        job(tmp_path, budget=3)


def test_a_problem_without_any_design_says_why(tmp_path: Path) -> None:
    problem = ccd.problem_of(CASE)
    problem = replace(problem, inner=replace(problem.inner, S_max=1.001))
    outcome, (solution,) = job(tmp_path, "nested", problem=problem)
    assert (outcome.status, outcome.version) == ("infeasible", None)
    assert solution.result["reason"]


def test_near_duplicates_are_fitted_once(tmp_path: Path) -> None:
    problem = ccd.problem_of(CASE)
    with Workers(1) as workers, SampleStore(tmp_path / "samples.sqlite") as store:
        outer = MixedOuter(Sampler(problem, store, workers, quiet=True))
        lower, upper = outer.bounds
        X = sobol(lower, upper, 16, 0)
        outer.sampler.quantities(np.vstack([X, X + 3e-5 * (upper - lower) * (upper - 1.0 > X)]))
        known = Job(tmp_path, CASE, outer, "lifted", 0)._read_known()
    assert known is not None
    assert len(known) <= 16
    np.testing.assert_allclose([s.x for s in known], X[: len(known)], rtol=1e-9)


# ---- versions, and one job at a time -------------------------------------------------------------


def test_a_surrogate_is_kept_with_its_error(
    retrained: tuple[Path, RetrainingEnd, Solution],
) -> None:
    folder, *_ = retrained
    (name,) = version_names(folder)
    processes, extra = load(folder / FOLDER / f"{name}.json")
    record = extra["version"]
    assert (record["version"], record["parent"]) == (name, None)
    assert set(record["errors"]) == set(extra["outputs"])
    assert record["errors"]["bandwidth"]["rms"] > 0.0
    assert record["at_optimum"] <= 1e-3
    assert record["samples"] == len(processes[0].X) >= FIRST


HOLDS = """
import sys
from pathlib import Path
from ccd_casadi.codesign.retraining import only_job
with only_job(Path(sys.argv[1]), 7):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_job_is_refused_until_the_first_one_dies(tmp_path: Path) -> None:
    other = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path)],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    with pytest.raises(UserError, match="wait for the job"), only_job(tmp_path, 9):
        pass
    other.kill()
    other.communicate(timeout=HANGS)
    with only_job(tmp_path, 9) as base:
        assert base == 7, "what the first job found"
    (tmp_path / LOCK).write_text("no database " * 100)
    with pytest.raises(UserError, match="not a database"), only_job(tmp_path, 9):
        pass
