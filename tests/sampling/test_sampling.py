"""Offline sampling: the same samples whatever interrupts it and however many workers there are."""

import math
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.helpers import HZ, INNER, problem

from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.sampling import sampler as module
from ccd_casadi.sampling import unit_kinds, units
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers

ROOT = Path(__file__).parents[2]
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
        sampler.values(THETAS)
        sampler.quantities(X)
        yield path, sampler


def untouchable(*_: Any, **more: Any) -> Any:
    raise AssertionError("this was known already")


def test_rows_do_not_depend_on_the_number_of_workers(
    sampled: tuple[Path, Sampler], tmp_path: Path
) -> None:
    """Nor on the order that is asked for; they go out in chunks and come back in that order."""
    path, first = sampled
    order = np.random.default_rng(0).permutation(len(X))
    assert len(X) > Sampler.chunk
    with Workers(2) as workers:
        with SampleStore(tmp_path / "s.sqlite") as store:
            sampler = Sampler(problem(), store, workers)
            bandwidths = sampler.values(THETAS)
            quantities = sampler.quantities(X)
            assert sampler.syntheses == first.syntheses
        with SampleStore(tmp_path / "other.sqlite") as store:
            shuffled = Sampler(problem(), store, workers).quantities(X[order])
    assert [sample.x for sample in shuffled] == [tuple(x) for x in X[order]]
    assert bandwidths == first.values(THETAS)
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
        turned = sampler.values(THETAS[::-1])
        sampler.values(THETAS[[0, 0, 2]])
        sampler.quantities(np.vstack([X, X]))
        assert sampler.syntheses == spent, "what was found counts as what was computed"
        with pytest.raises(AssertionError, match="known already"):
            sampler.values([[61.0, 61.0]])
    assert [sample.theta for sample in turned] == [tuple(row) for row in THETAS[::-1]]
    assert turned[::-1] == first.values(THETAS)


def test_a_sample_says_what_the_inner_problem_found(sampled: tuple[Path, Sampler]) -> None:
    _, sampler = sampled
    light = sampler.values(THETAS[:1])[0]
    assert light.feasible
    assert light.bandwidth / HZ == pytest.approx(71.9319, abs=1e-3)
    assert light.omega_S / HZ == pytest.approx(1800.0, rel=1e-9)
    assert set(light.active) == {"S_max", "omega_S upper"}
    above = sampler.values([[55.0 + 1e-3, 55.0]])[0]
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
            (sample,) = Sampler(hard, store, Workers(1)).values(THETAS[:1])
            assert not sample.feasible
            assert math.isnan(sample.bandwidth)
            assert all(map(math.isnan, sample.gradient))
            assert "S_max = 1.05" in sample.shortfall
            assert sample.syntheses == store.count() > 0


def test_the_nearest_is_the_infeasible_theta_that_falls_short_least(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shortfalls = {55.0: 0.3, 62.5: 0.1, 70.0: None}  # by m1; None: feasible

    def unit(task: tuple[Any, ...], workers: object = None) -> tuple[str, Any]:
        *_, key, theta = task
        violation = shortfalls[theta[0]]
        met = violation is None
        payload = {"bandwidth": 400.0 if met else None, "gradient": None, "active": []}
        payload |= {"omega_S": 9.0 if met else None, "omega_T": 9.0 if met else None}
        payload |= {"shortfall": "", "violation": 0.0 if met else violation, "syntheses": 1}
        return key, ([], payload)

    monkeypatch.setattr(module, "inner_unit", unit)
    for order in ([0, 1, 2, 3], [1, 3, 0, 2], [2, 3, 1, 0]):
        with SampleStore(tmp_path / f"{order}.sqlite") as store:
            sampler = Sampler(problem(), store, Workers(1))
            sampler.values(THETAS[[2]])
            assert sampler.nearest is None, "a feasible one does not count"
            sampler.values(THETAS[order])
            assert sampler.nearest is not None
            assert sampler.nearest.theta == tuple(THETAS[1])


def test_theta_is_all_but_the_last_two_however_many_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, required = units.true_design(problem(), (60.0, 60.0), 400.0 * HZ, 60.0 * HZ), []
    monkeypatch.setattr(units, "true_design", lambda _, *where: required.append(where) or made)
    for theta in ((1.0,), (1.0, 2.0), (1.0, 2.0, 3.0, 4.0)):
        x = (*theta, np.log(400.0 * HZ), np.log(60.0 * HZ))
        (row,), _ = units.design_unit((problem(), [("d", x)]))
        assert row.theta == theta
        assert required[-1][0] == theta
        assert required[-1][1:] == pytest.approx((400.0 * HZ, 60.0 * HZ))


@pytest.mark.parametrize("violated", [False, True])
def test_a_design_is_worth_its_objective_where_the_hardware_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, violated: bool
) -> None:
    monkeypatch.setattr(module, "violations", lambda *_: ("least mass",) * violated)
    monkeypatch.setattr(module, "objective", lambda problem, _, v: 200.0 + problem.w2 * v)
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


def test_a_trace_reports_bandwidths_where_j_counts_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had the error, in m, for the bandwidth."""

    def unit(task: Any, workers: object = None) -> Any:
        _, _, key, _ = task
        payload: dict[str, Any] = {"bandwidth": 300.0, "error": 2e-9, "gradient": [0.0, 0.0]}
        payload |= {"active": [], "shortfall": "", "violation": 0.0, "syntheses": 1, "kappa": [1.0]}
        return key, ([], payload)

    monkeypatch.setattr(module, "inner_unit", unit)
    monkeypatch.setattr(module, "objective", lambda problem, _, v: 200.0 + problem.w2 * v)
    with SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(problem(w1=2.0, w2=1e9), store, Workers(1))
        sampler.values(THETAS[:1])
    assert sampler.trace[0].bandwidth == 300.0
    assert sampler.trace[0].objective == pytest.approx(202.0)


def test_an_easier_problems_designs_are_counted_and_not_traced(tmp_path: Path) -> None:
    with SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(problem(), store, Workers(1))
        beside, easier = sampler.of(problem()), sampler.of(problem(), traced=False)
        easier._spend("a", 5, (60.0, 60.0), 12.0)
        assert (sampler.syntheses, sampler.trace) == (5, [])
        beside._spend("b", 2, (61.0, 60.0), 10.0)
    assert [entry.syntheses for entry in sampler.trace] == [7]


def test_the_rows_of_a_unit_share_its_seconds() -> None:
    began = time.perf_counter()
    key, (rows, payload) = unit_kinds.inner_unit((problem(), "p", "k", (60.0, 60.0)))
    elapsed = time.perf_counter() - began
    assert (key, payload["syntheses"]) == ("k", len(rows))
    assert len(rows) > 5
    assert 0.0 < sum(row.seconds for row in rows) <= elapsed
    (row,), _ = units.design_unit((problem(), [("d", tuple(X[0]))]))
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
