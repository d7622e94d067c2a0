"""Exchanges of listed values: what they find, and what they cost."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few, problem

from ccd_casadi.codesign.exchange import ExchangeOptions, best_exchange
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.time_budget import TimeBudget, until, within_budget

COUNT, CHOSEN = 7, 3
PLACES = f"""
import casadi as ca

def model(theta):
    there = sum(theta[f"p{{i}}"] for i in range({COUNT}))
    return {{"mass": ca.DM([[1.0]]), "stiffness": ca.DM([[1e4]]), "input": ca.DM([1.0]),
            "output": ca.DM([[1.0]]), "damping_ratio": 0.01, "hardware_cost": theta["m"],
            "constraints": {{"chosen": there - {CHOSEN}, "at least": {CHOSEN} - there}}}}
"""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> CoDesignProblem:
    """Three of seven places, and a mass."""
    file = tmp_path_factory.mktemp("places") / "own.py"
    file.write_text(PLACES)
    names = ("m", *(f"p{i}" for i in range(COUNT)))
    return problem(
        source=PlantSource(None, str(file), "model", ()), names=names, units=("",) * len(names),
        lower=(1.0, *[0.0] * COUNT), upper=(2.0, *[1.0] * COUNT),
        start=(1.5, *[CHOSEN / COUNT] * COUNT),
    )  # fmt: skip


class Inner:
    """Values of an inner problem that is known, as the search reads them of a sampler."""

    def __init__(self, problem: CoDesignProblem, weights: np.ndarray) -> None:
        self.problem, self.weights = problem, weights
        self.workers = SimpleNamespace(count=2)
        self.seen: list[tuple[float, ...]] = []

    def bandwidth(self, theta: np.ndarray) -> float:
        return 1e3 + float(self.weights @ theta[1:])

    def values(self, thetas: np.ndarray, label: str) -> list[SimpleNamespace]:
        self.seen += [tuple(theta) for theta in thetas]
        return [SimpleNamespace(theta=tuple(theta), feasible=True, searched=True, violation=0.0,
                                value=self.bandwidth(theta)) for theta in thetas]  # fmt: skip


LISTED = {f"p{i}": (0.0, 1.0) for i in range(COUNT)}


def at(theta: dict[str, float], chosen: tuple[int, ...]) -> dict[str, float]:
    return {name: float(i in chosen) for i, name in enumerate(LISTED)}


@few(max_examples=8)
@given(st.integers(0, 2**31))
def test_the_best_places_are_found_where_each_counts_for_itself(
    places: CoDesignProblem, seed: int
) -> None:
    """A sum over places has no other local optimum under exchanges than the best."""
    rng = np.random.default_rng(seed)
    inner = Inner(places, rng.normal(size=COUNT))
    theta = dict(zip(places.names, places.start, strict=True))
    begin = at(theta, tuple(rng.choice(COUNT, CHOSEN, replace=False)))
    found, tried = best_exchange(inner, LISTED, theta, begin)  # type: ignore[arg-type]
    best = np.argsort(inner.weights)[-CHOSEN:]
    assert found == at(theta, tuple(best))
    assert tried == len(inner.seen) == len(set(inner.seen))  # nothing is solved twice
    assert tried <= len(list(itertools.combinations(range(COUNT), CHOSEN)))
    for point in inner.seen:
        assert sum(point[1:]) == CHOSEN
        assert point[0] == theta["m"]


def test_without_time_the_first_combination_is_kept(places: CoDesignProblem) -> None:
    theta = dict(zip(places.names, places.start, strict=True))
    begin = at(theta, (0, 1, 2))
    inner = Inner(places, np.arange(COUNT, dtype=float))
    with within_budget(5.0) as spent, until(0.0):
        spent.began -= 300.0 * ExchangeOptions.share + 1.0
        found, _ = best_exchange(inner, LISTED, theta, begin)  # type: ignore[arg-type]
    assert found == begin
    assert isinstance(spent, TimeBudget)
    assert spent.left["listed exchange"] > 0
