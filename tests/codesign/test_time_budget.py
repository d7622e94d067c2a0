"""A search ends with its time budget, with the best design that was found, judged."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import fuzz_budget
from oracles.kinds import kinds

import ccd_casadi as ccd
from ccd_casadi.codesign.exchange import nearest_combination
from ccd_casadi.codesign.verdict import clauses_of
from ccd_casadi.support import time_budget
from ccd_casadi.support.process_pool import Workers, results
from ccd_casadi.support.time_budget import (
    StageOptions,
    budget,
    ends_early,
    not_searched,
    stage,
    time_is_up,
    until,
    within_budget,
)

Clock = Callable[[float], None]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Sets what a look at the clock adds, s: time that does not depend on the machine."""

    def every(step: float) -> None:
        ticks = count()
        monkeypatch.setattr(
            time_budget, "time", SimpleNamespace(monotonic=lambda: step * next(ticks))
        )

    return every


def test_without_a_budget_the_time_is_never_up(clock: Clock) -> None:
    clock(1e9)
    with within_budget(None) as own:
        assert not time_is_up()
        assert not ends_early("theta")
        with stage(StageOptions.start):
            assert not time_is_up()
    assert not own.ended
    assert not own.ended
    assert own.entry["minutes"] is None


@given(minutes=st.floats(0.01, 100.0), share=st.floats(0.0, 1.0))
def test_stages_end_in_their_order(minutes: float, share: float) -> None:
    now = 60.0 * minutes * share
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time_budget, "time", SimpleNamespace(monotonic=lambda: 0.0))
        with within_budget(minutes) as own:
            patch.setattr(time_budget, "time", SimpleNamespace(monotonic=lambda: now))
            up = now > own.until(StageOptions.search)
            assert time_is_up() == up
            for name, least in vars(StageOptions()).items():
                with stage(least):
                    assert time_is_up() == (now > own.until(least)), name
            not_searched("theta", 3)
            assert own.left == ({"theta": 3} if up else {})
            assert own.ended == up
            assert own.share == pytest.approx(StageOptions.search if up else 0.0)
    assert not budget().ended


def test_tasks_of_worker_processes_have_the_deadline_of_who_sends_them() -> None:
    tasks: dict[int, tuple[()]] = dict.fromkeys(range(4), ())
    with Workers(2) as workers:
        for deadline, up in ((-math.inf, True), (math.inf, False)):
            with until(deadline):
                assert set(dict(results(workers, time_is_up, tasks)).values()) == {up}


SMALL = ccd.Direct(starts=2, box_points=2)


@pytest.fixture(scope="module")
def whole() -> ccd.Solution:
    """Without a budget."""
    return ccd.solve(kinds()["mixed"], SMALL)


@pytest.mark.parametrize("step", [60.0, 5.0])
def test_what_a_budget_ends_is_judged_and_says_what_was_left(
    step: float, clock: Clock, whole: ccd.Solution
) -> None:
    problem = kinds()["mixed"]
    clock(step)  # of five minutes
    found = ccd.solve(problem, SMALL, budget=5.0).result
    own = found["time_budget"]
    assert own["not_searched"]
    assert own["minutes"] == 5.0
    words = found["notes"][-1]
    assert "budget of 5 min, not searched" in words
    assert found["status"] == "verified"
    clauses = "; ".join(clauses_of(found["verdict"]["optimal"]))
    known = "warned" if "not optimal: " in clauses else "unknown"
    assert found["verdict"]["optimal"]["state"] == known
    assert words in clauses
    assert found["checks"]["certificate"]
    assert found["checks"]["optimality"] is None
    assert found["objective"] >= whole.result["objective"] - 1e-6 * abs(found["objective"])


def test_who_resumes_a_search_that_its_budget_ended_ends_as_without_one(
    clock: Clock, tmp_path: Path, whole: ccd.Solution
) -> None:
    problem, store = kinds()["mixed"], tmp_path / "samples.sqlite"
    clock(60.0)
    assert ccd.solve(problem, SMALL, budget=5.0, store=store).result["time_budget"]["ended"]
    clock(0.0)
    again = ccd.solve(problem, SMALL, budget=5.0, store=store).result
    assert again["objective"] == whole.result["objective"]
    assert again["theta"] == whole.result["theta"]
    assert not again["time_budget"]["ended"]


LIST = (58.0, 59.5, 61.0, 62.0)


@given(st.floats(58.0, 62.0), st.floats(58.0, 62.0))
def test_a_combination_near_a_theta_is_of_its_lists(m1: float, m2: float) -> None:
    own = replace(kinds()["mixed"], listed=(("m1", LIST), ("m2", LIST[:2])))
    found = nearest_combination(own, {"m1": m1, "m2": m2})
    for name, value, values in (("m1", m1, LIST), ("m2", m2, LIST[:2])):
        assert abs(found[name] - value) == min(abs(one - value) for one in values)


def test_of_lists_a_combination_is_designed_in_any_time(clock: Clock) -> None:
    own = replace(kinds()["mixed"], listed=(("m1", LIST),))
    clock(100.0)
    found = ccd.solve(own, ccd.Direct(starts=1, box_points=2), budget=5.0).result
    assert found["status"] == "verified"
    assert found["time_budget"]["ended"]
    assert found["listed"]["chosen"]["m1"] in LIST
    assert found["time_budget"]["not_searched"]["listed combination"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3, 8, 16])
def test_a_random_case_ends_without_a_fault(seed: int) -> None:
    row = fuzz_budget.ended(seed, 0.1, 300.0)
    assert not row["fault"], row
