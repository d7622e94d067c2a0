"""The inner problem: both methods, the prototype's optimum, dense sweeps, infeasibility."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from oracles.chain_plants import chain_problem
from oracles.helpers import HZ, INNER, PAPER, log_uniform, problem, two_mass

from ccd_casadi.inner_problem import search
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.problem import plant_of, scaled_plant, true_inner
from ccd_casadi.inner_problem.search import search_inner
from ccd_casadi.inner_problem.sweep import (
    InnerBounds,
    InnerResult,
    active_constraints,
    evaluate,
    sweep_inner,
    sweep_starts,
)
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.support.worker_process import threads_permitted
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import sweep

BUDGET = 40


def check_result(result: InnerResult, inner: InnerBounds) -> None:
    """Feasible, counted, named by what binds, and stationary in what does not."""
    assert result.optimum is not None
    assert result.optimum is not None
    best = result.optimum.figures
    assert inner.feasible(best)
    assert inner.omega_S[0] <= best.omega_S <= inner.omega_S[1]
    assert inner.omega_T[0] <= best.omega_T <= inner.omega_T[1]
    assert result.syntheses == len(result.rows)
    # a swept design is synthesised again for its derivatives, from another guess of γ_opt
    best_row = max(r.bandwidth for r in result.rows if inner.feasible(r))
    assert result.bandwidth == pytest.approx(best_row, rel=1e-9, abs=0.0)
    assert result.active == active_constraints(inner, best)
    assert result.active  # ω_b grows with ω_S: something must bind


def compare(theta: tuple[float, float], inner: InnerBounds) -> float:
    """Difference of the two methods, relative; the search's budget is checked on the way."""
    plant = two_mass(*theta)
    swept, searched = (solve(plant, PAPER, inner) for solve in (sweep_inner, search_inner))
    if swept.optimum is None:
        assert searched.optimum is None
        return 0.0
    assert searched.syntheses <= BUDGET
    check_result(swept, inner)
    check_result(searched, inner)
    return searched.bandwidth / swept.bandwidth - 1.0


@pytest.mark.parametrize("count", [3, pytest.param(200, marks=pytest.mark.slow)])
def test_search_finds_the_optimum_of_the_sweep(count: int) -> None:
    rng = np.random.default_rng(2)
    errors = [compare(tuple(rng.uniform(55.0, 70.0, 2)), INNER) for _ in range(count)]
    assert np.abs(errors).max() < 1e-6


@pytest.mark.parametrize("count", [3, pytest.param(100, marks=pytest.mark.slow)])
def test_search_finds_the_optimum_under_other_constraints(count: int) -> None:
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(count):
        inner = replace(
            INNER,
            S_max=rng.uniform(1.7, 2.2),
            S_low=log_uniform(rng, 0.012, 0.05),
            omega_S=(10.0 * HZ, rng.uniform(800.0, 2000.0) * HZ),
            omega_T=(25.0 * HZ, rng.uniform(200.0, 1000.0) * HZ),
        )
        errors.append(compare(tuple(rng.uniform(55.0, 70.0, 2)), inner))
    assert np.abs(errors).max() < 1e-6


def test_first_designs_are_made_in_threads_and_change_no_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    places = list[str]()

    def evaluate_noted(*arguments: Any) -> Sensitivities:
        places.append(threading.current_thread().name)
        return evaluate(*arguments)

    monkeypatch.setattr(search, "evaluate", evaluate_noted)
    alone = search_inner(two_mass(60.0, 60.0), PAPER, INNER)
    assert set(places) == {"MainThread"}
    with threads_permitted(2):
        beside = search_inner(two_mass(60.0, 60.0), PAPER, INNER)
    assert set(places) > {"MainThread"}
    assert beside.rows == alone.rows
    assert beside.bandwidth == alone.bandwidth


@pytest.mark.parametrize("method", ["search", "sweep"])
def test_optimum_of_the_prototype(method: str) -> None:
    case = problem(method=method)
    result = true_inner(case, (55.0, 55.0))
    check_result(result, case.inner)
    cost = hardware_cost(plant_of(case), (55.0, 55.0))
    assert cost == 110.0
    assert case.w1 * cost + case.w2 * result.bandwidth == pytest.approx(-438.756, abs=1e-3)
    assert result.active == ("S_max", "omega_S upper")
    best = result.optimum.figures
    assert best.bandwidth / HZ == pytest.approx(71.9319, abs=1e-4)
    assert best.omega_T / HZ == pytest.approx(26.042, abs=0.005)
    assert best.sensitivity_peak == pytest.approx(1.75, abs=2e-8)


def check_against_dense_sweep(theta: tuple[float, float], points: int) -> float:
    """How far the optimum lies below the best of a dense certified sweep, relative."""
    plant = two_mass(*theta)
    rows = sweep(
        plant,
        PAPER,
        np.geomspace(*INNER.omega_S, points),
        np.geomspace(*INNER.omega_T, points),
        omega_low=INNER.omega_low,
        gamma_backoff=INNER.gamma_backoff,
    )
    assert all(row.certified for row in rows)
    dense = max(row.bandwidth for row in rows if INNER.feasible(row))
    best = search_inner(plant, PAPER, INNER).bandwidth
    assert best < dense * 1.05  # the sweep is dense enough to mean something
    return 1.0 - best / dense


@pytest.mark.parametrize(
    "theta", [(60.0, 60.0), pytest.param((58.33, 55.0), marks=pytest.mark.slow)]
)
def test_optimum_is_not_below_a_dense_sweep(theta: tuple[float, float]) -> None:
    assert check_against_dense_sweep(theta, 40) < 1e-6


@pytest.mark.slow
def test_optimum_is_nowhere_below_a_denser_sweep() -> None:
    rng = np.random.default_rng(9)
    short = [check_against_dense_sweep(tuple(rng.uniform(55.0, 70.0, 2)), 200) for _ in range(20)]
    assert max(short) < 1e-6


@pytest.mark.parametrize(
    "seed", [32, *(pytest.param(other, marks=pytest.mark.slow) for other in (2, 9, 36))]
)
def test_search_goes_on_beside_uncertified_designs(seed: int) -> None:
    """On a set of plants: no design is asked for twice, and the best is no worse than on a grid.

    A search that ended at the first uncertified design was 1 to 22 % below it on these chains.
    """
    drawn = chain_problem(seed)
    shift = float(np.random.default_rng([seed, 9]).uniform(0.005, 0.04))
    case = replace(drawn, robust=RobustSet(shift, 3, (0.7, 1.5), -shift))
    plant, inner = scaled_plant(case, case.start), replace(case.inner, sweep_points=(12, 12))
    found = search_inner(plant, case.weights, inner)
    rows = sweep(plant, case.weights, *inner.axes(), omega_low=inner.omega_low)
    assert any(not row.certified for row in found.rows)
    lost = [(row.omega_S, row.omega_T) for row in found.rows if not row.certified]
    assert len(set(lost)) == len(lost)
    best = max(row.bandwidth for row in rows if inner.feasible(row))
    assert found.bandwidth > best * (1.0 - 1e-6)


@pytest.mark.parametrize("solve", [sweep_inner, search_inner])
def test_infeasible_problem_names_what_cannot_be_met(solve) -> None:
    plant = two_mass(60.0, 60.0)
    result = solve(plant, PAPER, replace(INNER, S_max=1.05))
    assert result.optimum is None
    assert np.isnan(result.bandwidth)
    least = min(row.sensitivity_peak for row in result.rows)
    assert "where S_max = 1.05 is required" in result.shortfall
    assert f"the least peak of S of all is {least:.4g}" in result.shortfall
    assert least > 1.05
    result = solve(plant, PAPER, replace(INNER, S_low=1e-4))
    assert "where S_low = 0.0001 is required" in result.shortfall
    assert "the least |S(j omega_low)| of all is" in result.shortfall
    # each bound is met by some, both by none that was tried
    result = solve(plant, PAPER, replace(INNER, S_max=1.3, S_low=0.012))
    assert "others keep" in result.shortfall
    assert "cannot" not in result.shortfall


def test_sweep_starts_are_the_local_maxima_of_the_merit_best_first() -> None:
    """ln ω_b - 3 times the violation in logarithms, over the eight neighbours of a grid point."""
    inner = replace(INNER, sweep_points=(12, 9))
    rows = sweep(two_mass(57.0, 66.0), PAPER, *inner.axes(), omega_low=inner.omega_low)
    peaks = np.array([row.sensitivity_peak for row in rows]).reshape(12, 9)
    low = np.array([row.sensitivity_low for row in rows]).reshape(12, 9)
    excess = np.maximum(np.log(peaks / inner.S_max), np.log(low / inner.S_low)).clip(0.0)
    merit = np.log([row.bandwidth for row in rows]).reshape(12, 9) - 3.0 * excess
    expected = {
        (rows[i * 9 + j].omega_S, rows[i * 9 + j].omega_T): merit[i, j]
        for i in range(12)
        for j in range(9)
        if merit[i, j] == merit[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].max()
    }
    starts = sweep_starts(inner, rows)
    assert starts == sorted(expected, key=lambda point: -expected[point])[:6]
