"""Lists of values with a fixed structure: one search seeds the next, and everything is counted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.kinds import PID, quick

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign import stored_searches, structured_lists
from ccd_casadi.codesign.catalogue import restrict
from ccd_casadi.codesign.formulations import Direct, Lifted
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.structured_lists import ListedStructured
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem import structured_search
from ccd_casadi.inner_problem.objective import violations
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import Uncertainty, structured_of
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Workers

VALUES = (58.0, 59.5, 60.5, 61.0, 62.0)


def listed(**changes: object) -> CoDesignProblem:
    case = quick(replace(PID, uncertainty=Uncertainty(), starts=2))
    case = replace(case, lower=(58.0, 58.0), upper=(62.0, 62.0), start=(60.5, 60.0))
    return replace(case, listed=(("m1", VALUES),), **changes)  # type: ignore[arg-type]


# The lightest is the best; then with the ends and the best beside it each on its own.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("w2", "beside"), [(-0.995, ()), (-0.1, (0, -1))]
)
def test_one_search_seeds_the_next_and_all_is_counted(
    w2: float, beside: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    races = []
    for module in (stored_searches, structured_search):
        honest = module.search_starts

        def counted(*arguments: object, honest: object = honest, **more: object) -> object:
            races.append(arguments)
            return honest(*arguments, **more)  # type: ignore[operator]

        monkeypatch.setattr(module, "search_starts", counted)
    case = listed(w2=w2)
    with Workers(1) as pool, SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(case, store, pool)
        found = co_design(sampler, Lifted(points=4), 0)
        result, lists = found.result, found.result["listed"]
        assert result["status"] == "verified", result["reason"]
        # At the start and the end of the first search, and at the end of the one that is judged.
        assert lists["judged"] == 1
        assert len(races) <= 3
        assert lists["solved"] + lists["between"] <= lists["combinations"]
        thetas = sum(sampler.spent.by_purpose.values())
        assert result["syntheses"] == sampler.syntheses == thetas > len(races)
        assert len({entry.theta for entry in sampler.trace}) > 4
        for m1 in {result["fixed"]["m1"], *(VALUES[i] for i in beside)} if beside else ():
            alone = Sampler(restrict(case, {"m1": (m1,)}), store, pool)
            other = co_design(alone, Lifted(points=4), 0).result["objective"]
            assert result["objective"] <= other + 1e-4 * abs(other)


@pytest.mark.slow
def test_a_part_is_not_empty_because_no_step_from_nearby_ends_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then a few starts are tried there."""
    honest = structured_lists._descend

    def lost(sampler: Sampler, theta: Array) -> Solution:
        near_by = not structured_of(sampler.problem).starts
        return structured_lists._nothing("lost") if near_by else honest(sampler, theta)

    case = listed(w2=-0.995)
    with Workers(1) as pool, SampleStore(tmp_path / "s.sqlite") as store:
        search = ListedStructured(Direct(starts=1), 0, lambda _: pytest.fail("no judge here"))
        first = search.search(Sampler(restrict(case, {"m1": VALUES[:1]}), store, pool), None)
        monkeypatch.setattr(structured_lists, "_descend", lost)
        other = Sampler(restrict(case, {"m1": VALUES[-1:]}), store, pool)
        found = search.search(other, first)
    assert found.result["status"] == "searched"
    assert found.problem is not None
    assert found.problem.source.held["m1"] == VALUES[-1]


CHOICE = """import casadi as ca

def stage(theta):
    k, m = 4e6 * theta["k"], 10.0 + theta["a"] + theta["b"]
    return {
        "mass": ca.diag(ca.vertcat(m, 1.0)), "stiffness": k * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": 0.01, "input": ca.DM([1, 0]), "output": ca.DM([[1, 0]]),
        "hardware_cost": m, "constraints": {
            "chosen": theta["a"] + theta["b"] - 1, "stiff": theta["k"] - 1.5},
    }
"""
CASE = """[plant]
function = "choice.py:stage"
[theta.k]
lower = 1.0
upper = 2.0
[theta.a]
values = [0, 1]
[theta.b]
values = [0, 1]
[objective]
w1 = 1.0
w2 = -1.0
[weights]
M_S = 2.0
A_S = 1e-4
c_K = 1e4
omega_K_hz = 300.0
M_K = 1e6
A_l = 1.0
A_u = 1e-2
[inner]
S_max = 2.0
S_low = 0.1
omega_low_hz = 1.0
omega_S_hz = [5.0, 1000.0]
omega_T_hz = [50.0, 1000.0]
[controller]
structure = "sections"
"""


@pytest.mark.parametrize(("a", "b", "kept"), [(0, 0, True), (1, 0, True), (1, 1, False)])
def test_as_many_places_may_be_chosen_as_the_constraint_allows(
    a: int, b: int, kept: bool, tmp_path: Path
) -> None:
    """With a = 1 the constraint is the number 0: met, though no θ is inside it."""
    (tmp_path / "choice.py").write_text(CHOICE)
    (tmp_path / "case.toml").write_text(CASE)
    problem = restrict(
        problem_of(load_case(tmp_path / "case.toml")), {"a": (float(a),), "b": (float(b),)}
    )
    found = structured_lists.nearest_allowed(problem, np.array([1.9]))
    assert (found is not None) == kept
    if found is not None:
        assert found[0] == pytest.approx(1.5, abs=1e-6)
        assert not violations(problem, found)
