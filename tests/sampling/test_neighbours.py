"""A better controller that is found at one θ is one for its neighbours too."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few, problem

from ccd_casadi.codesign.outer import pieces_from
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import (
    SearchState,
    state_of,
    with_state,
    with_warm_start,
)
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.sampling import sampler as module
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.units import problem_hash
from ccd_casadi.support.process_pool import Workers

GOOD, POOR = (1.0,), (2.0,)
SLOPE = 40.0


def branches(cliff: float, required: list[tuple]) -> Callable[[tuple], tuple]:
    """A unit of work whose climbs lose the better controller at a cliff, but from its own κ."""

    def unit(
        task: tuple[CoDesignProblem, str, str, tuple[float, ...]], workers: object = None
    ) -> tuple[list, tuple]:
        case, _, key, theta = task
        state, z = state_of(case), (theta[0] - 55.0) / 15.0
        known = {*state.warm_starts, *state.error_warm_starts}
        kappa = GOOD if GOOD in known or z < cliff else POOR
        value, slope = 250.0 + 10.0 * z, 10.0
        if kappa == GOOD:
            value, slope = 300.0 + SLOPE * z - 40.0 * z**2, SLOPE - 80.0 * z
        payload: dict[str, Any] = {
            "bandwidth": value, "gradient": [slope / 15.0, 0.0], "kappa": list(kappa),
            "active": [], "shortfall": "", "syntheses": 1,
        }  # fmt: skip
        if case.controller.figure.key == "move_time":  # less is better, and the slope is of that
            payload |= {"error": 1.0 / value, "gradient": [-slope / 15.0 / value**2, 0.0]}
        required.append((theta, kappa))
        return key, ([], payload)

    return unit


def two_branches(**changes: object) -> CoDesignProblem:
    sections = replace(StructuredProblem(), **changes)  # type: ignore[arg-type]
    w2 = -1.0 if "minimise" not in changes else 1e6
    return with_state(problem(controller=sections, w1=0.0, w2=w2), warm_starts=(POOR,))


@few(max_examples=10)
@given(st.floats(0.1, 0.3))
def test_a_cliff_is_passed_by_its_controller(cliff: float) -> None:
    required: list[tuple] = []
    with pytest.MonkeyPatch.context() as patch, SampleStore(":memory:") as store:
        patch.setattr(module, "inner_unit", branches(cliff, required))
        sampler = Sampler(two_branches(), store, Workers(1))
        best = pieces_from(sampler, sampler.values(np.array([55.0, 60.0]))[0], 1e-9)
    assert best.theta[0] == pytest.approx(55.0 + 15.0 * SLOPE / 80.0, abs=0.02)
    assert best.kappa == GOOD
    assert len(required) < 60


@pytest.mark.parametrize("changes", [{}, {"minimise": "move_time"}])
def test_what_falls_short_of_its_neighbours_is_climbed_from_them(
    changes: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those near the best end are of its branch, and a run from the store repeats itself."""
    required: list[tuple] = []
    monkeypatch.setattr(module, "inner_unit", branches(0.3, required))
    thetas = np.array([[55.0 + 15.0 * z, 60.0 + z] for z in np.linspace(0.0, 1.0, 11)])
    runs = []
    for _ in range(2):
        with SampleStore(tmp_path / "s.sqlite") as store:
            sampler = Sampler(two_branches(**changes), store, Workers(1))
            sampler.values(thetas)
            sampler.values(thetas[3] + 0.1)
            runs.append((list(sampler.solved.values()), sampler.syntheses))
    at = {round((one.theta[0] - 55.0) / 15.0, 3): one.kappa for one in runs[0][0]}
    assert {kappa for z, kappa in at.items() if 0.35 < z < 0.65} == {GOOD}
    assert (thetas[5][0], POOR) in [(theta[0], kappa) for theta, kappa in required[: len(thetas)]]
    assert len(required) < 2 * len(thetas)
    assert runs[1] == runs[0]


def test_a_controller_given_for_a_theta_counts_where_it_is_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "inner_unit", branches(-1.0, []))
    with SampleStore(":memory:") as store:
        sampler = Sampler(two_branches(), store, Workers(1))
        theta = (60.0, 60.0)
        poor = sampler.values(np.array(theta))[0]
        assert sampler.value_from(theta, POOR) == poor
        good = sampler.value_from(theta, GOOD)
    assert (poor.kappa, good.kappa) == (POOR, GOOD)
    assert sampler.latest([poor]) == [good]


def test_a_design_without_a_controller_is_no_warm_start() -> None:
    """A search at its θ begins from others': an empty κ had ended a run in a traceback."""
    known = with_state(problem(controller=StructuredProblem()), warm_starts=(POOR,))
    assert with_warm_start(known, ()) == known
    assert state_of(with_warm_start(known, GOOD)).warm_starts == (GOOD, POOR)


KAPPAS = st.lists(st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)), max_size=3).map(tuple)
STATES = st.builds(
    SearchState, KAPPAS, KAPPAS, st.lists(st.tuples(st.integers(0, 2), st.just((0.1,)))).map(tuple),
    st.integers(0, 9),
)  # fmt: skip


@given(state=STATES, of_error=st.booleans())
def test_a_search_state_leaves_the_statement_and_has_its_own_key(
    state: SearchState, of_error: bool
) -> None:
    """Old stores keep their samples: a key has the state's values under the names of before."""
    minimise = "move_time" if of_error else "bandwidth"
    stated = problem(controller=StructuredProblem(minimise=minimise))
    found = with_state(stated, **vars(state))
    assert state_of(found) == state
    assert with_state(found, **vars(SearchState())) == stated
    own: dict[str, Any] = {
        "anchors": state.warm_starts,
        "members": state.scenarios,
        "seed": state.seed,
    }
    if of_error:
        own["least_error"] = [0.0, state.error_warm_starts]
    identity, before = (one.controller_identity()["sections"] for one in (found, stated))
    assert identity == before | own
    assert list(identity) == list(before)
    if identity != before:
        assert problem_hash(found.identity()) != problem_hash(stated.identity())
