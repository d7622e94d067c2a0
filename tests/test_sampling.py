"""Offline sampling: the same samples whatever interrupts it and however many workers there are."""

import json
import math
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from busy import HANGS
from commands import changed, run
from helpers import HZ, INNER, problem

from ccd_casadi.inner_problem.problem import PlantSource
from ccd_casadi.sampling import sampler as module
from ccd_casadi.sampling.sampler import CHUNK, Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers

ROOT = Path(__file__).parent.parent
TWO_MASS = ROOT / "runs" / "two_mass.toml"
THETAS = np.array([[55.0, 55.0], [62.5, 58.0], [70.0, 70.0], [55.0, 70.0]])
X = np.array([[55.0 + i, 70.0 - i, np.log(400.0 + 90.0 * i), np.log(200.0)] for i in range(11)])


def table(path: Path) -> dict[str, list[tuple[Any, ...]]]:
    """All that a store holds but the seconds, which no two runs share."""
    database = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    names = [row[1] for row in database.execute("pragma table_info(samples)")]
    names.remove("seconds")
    found = {"samples": database.execute(f"select {', '.join(names)} from samples").fetchall()}
    for other in ("meta", "problems", "results"):
        found[other] = database.execute(f"select * from {other}").fetchall()
    database.close()
    return {name: sorted(rows, key=repr) for name, rows in found.items()}


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Sampler]]:
    path = tmp_path_factory.mktemp("sampled") / "s.sqlite"
    with SampleStore(path) as store:
        sampler = Sampler(problem(), store, Workers(1))
        sampler.bandwidths(THETAS)
        sampler.quantities(X)
        yield path, sampler


def untouchable(*_: Any) -> Any:
    raise AssertionError("this was known already")


def test_rows_do_not_depend_on_the_number_of_workers(
    sampled: tuple[Path, Sampler], tmp_path: Path
) -> None:
    """Nor on the order that is asked for; they go out in chunks and come back in that order."""
    path, first = sampled
    order = np.random.default_rng(0).permutation(len(X))
    assert len(X) > CHUNK
    with Workers(2) as workers:
        with SampleStore(tmp_path / "s.sqlite") as store:
            sampler = Sampler(problem(), store, workers)
            bandwidths = sampler.bandwidths(THETAS)
            quantities = sampler.quantities(X)
            assert sampler.syntheses == first.syntheses
        with SampleStore(tmp_path / "other.sqlite") as store:
            shuffled = Sampler(problem(), store, workers).quantities(X[order])
    assert [sample.x for sample in shuffled] == [tuple(x) for x in X[order]]
    assert bandwidths == first.bandwidths(THETAS)
    for ours, theirs in zip(quantities, first.quantities(X), strict=True):
        assert ours.x == theirs.x
        assert ours.values.tobytes() == theirs.values.tobytes()
        assert ours.gradients.tobytes() == theirs.gradients.tobytes()
    found = table(tmp_path / "s.sqlite")
    assert found == table(path)
    assert len(found["samples"]) > 50


def test_nothing_is_computed_twice(
    sampled: tuple[Path, Sampler], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, first = sampled
    spent = first.syntheses
    monkeypatch.setattr(module, "inner_unit", untouchable)
    monkeypatch.setattr(module, "design_unit", untouchable)
    with SampleStore(path) as store:
        sampler = Sampler(problem(), store, Workers(1))
        assert sampler.syntheses == 0
        turned = sampler.bandwidths(THETAS[::-1])
        sampler.bandwidths(THETAS[[0, 0, 2]])
        sampler.quantities(np.vstack([X, X]))
        assert sampler.syntheses == spent, "what was found counts as what was computed"
        with pytest.raises(AssertionError, match="known already"):
            sampler.bandwidths([[61.0, 61.0]])
    assert [sample.theta for sample in turned] == [tuple(row) for row in THETAS[::-1]]
    assert turned[::-1] == first.bandwidths(THETAS)


def test_a_sample_says_what_the_inner_problem_found(sampled: tuple[Path, Sampler]) -> None:
    _, sampler = sampled
    light = sampler.bandwidths(THETAS[:1])[0]
    assert light.feasible
    assert light.bandwidth / HZ == pytest.approx(72.0452, abs=1e-3)
    assert light.omega_S / HZ == pytest.approx(1800.0, rel=1e-9)
    assert set(light.active) == {"S_max", "omega_S upper"}
    above = sampler.bandwidths([[55.0 + 1e-3, 55.0]])[0]
    slope = (above.bandwidth - light.bandwidth) / 1e-3
    assert light.gradient[0] == pytest.approx(slope, rel=1e-3)


def test_quantities_are_the_rows_figures_with_their_slopes(sampled: tuple[Path, Sampler]) -> None:
    path, sampler = sampled
    sample = sampler.quantities(X[:1])[0]
    for i, h in enumerate([0.02, 0.02, 1e-4, 1e-4]):
        step = h * np.eye(4)[i]
        ends = sampler.quantities(np.array([X[0] + step, X[0] - step]))
        slope = (ends[0].values - ends[1].values) / (2 * h)
        np.testing.assert_allclose(sample.gradients[:, i], slope, rtol=2e-3, atol=1e-5)
    with SampleStore(path) as store:
        near = [s for s in store.select() if s.theta == tuple(X[0, :2]) and s.gradients]
    omega = tuple(np.exp(X[0, 2:]))
    row = next(s for s in near if (s.omega_S, s.omega_T) == omega)
    assert sample.values[0] == row.bandwidth
    assert sample.values[1] == np.log(row.sensitivity_peak)


def test_an_infeasible_theta_is_a_sample_too(tmp_path: Path) -> None:
    hard = problem(inner=replace(INNER, S_max=1.05))
    with SampleStore(tmp_path / "s.sqlite") as store:
        for _ in range(2):  # computed, then read
            (sample,) = Sampler(hard, store, Workers(1)).bandwidths(THETAS[:1])
            assert not sample.feasible
            assert math.isnan(sample.bandwidth)
            assert all(map(math.isnan, sample.gradient))
            assert "S_max = 1.05" in sample.shortfall
            assert sample.syntheses == store.count() > 0


def test_the_nearest_is_the_infeasible_theta_that_falls_short_least(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shortfalls = {55.0: 0.3, 62.5: 0.1, 70.0: None}  # by m1; None: feasible

    def unit(task: tuple[Any, ...]) -> tuple[list[Any], tuple[Any, ...]]:
        *_, key, theta = task
        violation = shortfalls[theta[0]]
        met = violation is None
        payload = {"bandwidth": 400.0 if met else None, "gradient": None, "active": []}
        payload |= {"omega_S": 9.0 if met else None, "omega_T": 9.0 if met else None}
        payload |= {"shortfall": "", "violation": 0.0 if met else violation, "syntheses": 1}
        return [], (key, theta, payload)

    monkeypatch.setattr(module, "inner_unit", unit)
    for order in ([0, 1, 2, 3], [1, 3, 0, 2], [2, 3, 1, 0]):
        with SampleStore(tmp_path / f"{order}.sqlite") as store:
            sampler = Sampler(problem(), store, Workers(1))
            sampler.bandwidths(THETAS[[2]])
            assert sampler.nearest is None, "a feasible one does not count"
            sampler.bandwidths(THETAS[order])
            assert sampler.nearest is not None
            assert sampler.nearest.theta == tuple(THETAS[1])


def test_theta_is_all_but_the_last_two_however_many_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, asked = module.true_design(problem(), (60.0, 60.0), 400.0 * HZ, 60.0 * HZ), []
    monkeypatch.setattr(module, "true_design", lambda _, *where: asked.append(where) or made)
    for theta in ((1.0,), (1.0, 2.0), (1.0, 2.0, 3.0, 4.0)):
        x = (*theta, np.log(400.0 * HZ), np.log(60.0 * HZ))
        (row,), _ = module.design_unit((problem(), [("d", x)]))
        assert row.theta == theta
        assert asked[-1][0] == theta
        assert asked[-1][1:] == pytest.approx((400.0 * HZ, 60.0 * HZ))


@pytest.mark.parametrize("violated", [False, True])
def test_a_design_is_worth_its_objective_where_the_hardware_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, violated: bool
) -> None:
    monkeypatch.setattr(module, "constraint_values", lambda *_: np.array([-1.0, float(violated)]))
    monkeypatch.setattr(module, "hardware_cost", lambda *_: 100.0)
    with SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(problem(w1=2.0, w2=-3.0), store, Workers(1))
        sampler._spend("a", 5, (60.0, 60.0), 10.0)
        sampler._spend("a", 5, (60.0, 60.0), 10.0)
        sampler._spend("b", 2, (61.0, 60.0), math.nan)
    assert [entry.syntheses for entry in sampler.trace] == [5, 7]
    assert sampler.trace[0].bandwidth == 10.0
    if violated:
        assert math.isnan(sampler.trace[0].objective)
    else:
        assert sampler.trace[0].objective == 170.0
    assert math.isnan(sampler.trace[1].objective)


def test_the_rows_of_a_unit_share_its_seconds() -> None:
    began = time.perf_counter()
    rows, (key, theta, payload) = module.inner_unit((problem(), "p", "k", (60.0, 60.0)))
    elapsed = time.perf_counter() - began
    assert (key, theta, payload["syntheses"]) == ("k", (60.0, 60.0), len(rows))
    assert len(rows) > 5
    assert 0.0 < sum(row.seconds for row in rows) <= elapsed
    (row,), _ = module.design_unit((problem(), [("d", tuple(X[0]))]))
    assert 0.0 < row.seconds <= time.perf_counter() - began


def test_what_determines_a_synthesis_and_nothing_else_is_in_its_key(tmp_path: Path) -> None:
    def hashes(**changes: Any) -> tuple[str, str]:
        sampler = Sampler(problem(**changes), store, Workers(1))
        return sampler.hash, sampler.inner_hash

    with SampleStore(tmp_path / "s.sqlite") as store:
        base = hashes()
        for same in ({"w1": 3.0}, {"lower": (50.0, 50.0)}, {"start": (60.0, 60.0)}):
            assert hashes(**same) == base
        for inner in (replace(INNER, S_max=1.5), replace(INNER, S_low=0.02)):
            assert hashes(inner=inner)[0] == base[0], "the same designs answer another bound"
            assert hashes(inner=inner)[1] != base[1]
        assert hashes(method="sweep")[1] != base[1]
        other = PlantSource("two_mass", None, None, (("zeta", 0.02),))
        assert hashes(source=other)[0] != base[0]
        assert hashes(inner=replace(INNER, gamma_backoff=1.03))[0] != base[0]
        file = tmp_path / "plant.py"
        own = PlantSource(None, str(file), "model", ())
        file.write_text("def model(theta): return 1\n")
        before = hashes(source=own)
        file.write_text("def model(theta): return 2\n")
        assert hashes(source=own)[0] != before[0], "a plant is known by what its file says"


# ---- interruptions -------------------------------------------------------------------------------


def command(folder: Path, *more: str, case: Path = TWO_MASS) -> list[str]:
    words = ["-m", "ccd_casadi.solve", str(case), "--out", str(folder), "--quiet", *more]
    words += ["--no-report"]
    return [sys.executable, *words]


def started(words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def rows(path: Path) -> int:
    """Samples in the store so far; 0 where it is not made yet."""
    try:
        database = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
        try:
            return int(database.execute("select count(*) from samples").fetchone()[0])
        finally:
            database.close()
    except sqlite3.OperationalError:
        return 0


def wait_for_rows(process: subprocess.Popen[str], path: Path, least: int) -> None:
    limit = time.monotonic() + HANGS
    while rows(path) < least and process.poll() is None:
        assert time.monotonic() < limit
        time.sleep(0.02)


def result(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "result.json").read_text())
    assert found.pop("seconds") > 0.0
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Callable[..., list[str]], Path]:
    """The command on a small case in one process, and the folder that it leaves undisturbed."""
    folder = tmp_path_factory.mktemp("runs")
    small = "\n[sampling]\npoints = 3\nlifted_points = 24\n[outer]\nbox_points = 0\n"
    case = changed(folder, more=small)

    def words(into: Path, *more: str) -> list[str]:
        return command(into, "--workers", "1", *more, case=case)

    assert run(folder / "run", "--no-report", case=case) == 0
    return words, folder / "run"


def interrupted_runs(
    words: list[str], folder: Path, kills: int, seed: int, span: float
) -> list[int]:
    """Kill and resume until `kills` kills have met a running command; rows left by each."""
    rng, left = random.Random(seed), []
    store = folder / "samples.sqlite"
    while len(left) < kills:
        process = started(words)
        if len(left) < 2 or rng.random() < 0.7:  # while it samples
            wait_for_rows(process, store, rows(store) + 1)
            time.sleep(rng.uniform(0.0, 0.3))
        else:  # at any moment: while it starts, fits, verifies or writes
            time.sleep(rng.uniform(0.5, 0.5 + span))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode in (0, -signal.SIGKILL)
        if process.returncode == 0:  # it had finished: begin again
            for path in folder.iterdir():
                path.unlink()
        else:
            left.append(rows(store))
    return left


@pytest.mark.parametrize(
    ("kills", "seed", "span"),
    [(2, 1, 1.0), pytest.param(20, 2, 1.5, marks=pytest.mark.slow)],
)
def test_killed_and_resumed_ends_as_if_undisturbed(
    undisturbed: tuple[Callable[..., list[str]], Path],
    tmp_path: Path,
    kills: int,
    seed: int,
    span: float,
) -> None:
    (words, whole), folder = undisturbed, tmp_path / "run"
    left = interrupted_runs(words(folder), folder, kills, seed, span)
    assert len(set(left)) >= 2, "the kills met the sampling at different points"
    done = subprocess.run(
        words(folder, "--resume"), cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert table(folder / "samples.sqlite") == table(whole / "samples.sqlite")
    assert result(folder) == result(whole)
    for name in ("controller.json", "surrogate.json", "case.toml"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()


POOL = f"""
import sys
import numpy as np
from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.sampler import Sampler

if __name__ == "__main__":
    problem = problem_of(load_case({str(TWO_MASS)!r}))
    with SampleStore(sys.argv[1]) as store, Workers(int(sys.argv[2])) as workers:
        sampler = Sampler(problem, store, workers)
        sampler.bandwidths(np.random.default_rng(0).uniform(55.0, 70.0, (40, 2)))
        print(sampler.syntheses)
"""


@pytest.mark.slow
def test_a_killed_pool_resumes_to_the_same_samples(tmp_path: Path) -> None:
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    seen: list[int] = []
    for _ in range(20):  # until two kills have met the sampling; it may be faster than we are
        process = started([sys.executable, str(script), str(tmp_path / "a.sqlite"), "2"])
        wait_for_rows(process, tmp_path / "a.sqlite", (seen[-1] if seen else 0) + 1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if process.returncode == -signal.SIGKILL:
            seen.append(rows(tmp_path / "a.sqlite"))
        else:
            for path in tmp_path.glob("a.sqlite*"):
                path.unlink()
            seen.clear()
        if len(seen) == 2:
            break
    assert 0 < seen[0] < seen[1], "the second run went on from the first"
    told = []
    for name, workers in (("a", "2"), ("b", "1")):
        words = [sys.executable, str(script), str(tmp_path / f"{name}.sqlite"), workers]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        told.append(done.stdout)
    assert told[0] == told[1], "as many syntheses are counted as if nothing had happened"
    assert table(tmp_path / "a.sqlite") == table(tmp_path / "b.sqlite")


@pytest.mark.parametrize(
    "formulation",
    ["nested", pytest.param("lifted", marks=pytest.mark.slow), "direct"],
)
def test_ctrl_c_is_resumable(
    undisturbed: tuple[Callable[..., list[str]], Path], tmp_path: Path, formulation: str
) -> None:
    """In the middle of sampling, or of IPOPT on the truth."""
    (words, whole), folder = undisturbed, tmp_path / "run"
    process = started(words(folder, "--formulation", formulation))
    wait_for_rows(process, folder / "samples.sqlite", 20)
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=HANGS)
    assert (process.returncode, output) == (130, "")
    assert len(errors.splitlines()) == 1, errors
    assert errors.startswith("interrupted: what is sampled is kept; the same command resumes")
    assert not (folder / "result.json").exists()
    if formulation == "nested":
        kept = rows(folder / "samples.sqlite")
        assert 20 <= kept < rows(whole / "samples.sqlite")
        assert run(folder, "--no-report", case=Path(words(folder)[3])) == 0
        assert result(folder) == result(whole)
