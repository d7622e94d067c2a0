"""Parameters that are fixed or from a list: the same plant, the best listed values, their run."""

import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few, problem
from scipy.optimize import lsq_linear

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.codesign import outer_structured
from ccd_casadi.codesign.catalogue import best_of_lists, restrict
from ccd_casadi.codesign.formulations import Direct, Lifted
from ccd_casadi.codesign.outer_problem import FormulationResult
from ccd_casadi.codesign.outer_search import search_outer
from ccd_casadi.codesign.outer_structured import StructuredOuter
from ccd_casadi.codesign.result import write_run
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.run import solve as solve_problem
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.plants.plant import constraint_values, hardware_cost, mechanics
from ccd_casadi.sampling.inner_samples import SynthesisCounts
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.json_files import plain
from ccd_casadi.support.process_pool import Workers

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"
OWN = """
import casadi as ca

def model(theta, gain=1.0):
    a, b, c = theta["a"], theta["b"], theta["c"]
    mass = ca.diag(ca.vertcat(gain * a, b))
    stiffness = c * ca.DM([[1.0, -1.0], [-1.0, 1.0]])
    return {"mass": mass, "stiffness": stiffness, "input": ca.DM([1.0, 0.0]),
            "output": ca.DM([[1.0, 0.0]]), "damping_ratio": 0.01, "hardware_cost": a + b**2,
            "constraints": {"sum": a + b - 9.0}}
"""


def sources(tmp_path: Path) -> dict[str, tuple[PlantSource, dict[str, float]]]:
    file = tmp_path / "own.py"
    file.write_text(OWN)
    return {
        "two_mass": (PlantSource("two_mass", None, None, ()), {"m1": 58.0, "m2": 64.0}),
        "own": (PlantSource(None, str(file), "model", ()), {"a": 3.0, "b": 5.0, "c": 1e6}),
    }


@pytest.mark.parametrize("name", ["two_mass", "own"])
def test_a_fixed_parameter_is_the_same_plant_with_less_theta(name: str, tmp_path: Path) -> None:
    source, theta = sources(tmp_path)[name]
    names, values = tuple(theta), tuple(theta.values())
    bounds = {"lower": tuple(0.9 * v for v in values), "upper": tuple(1.1 * v for v in values)}
    whole = problem(source=source, names=names, units=("",) * len(names), start=values, **bounds)
    for held in names[:-1]:
        lists = {held: (theta[held],)}
        part = restrict(whole, lists)
        kept = [i for i, item in enumerate(names) if item != held]
        assert part.names == tuple(names[i] for i in kept)
        here = tuple(values[i] for i in kept)
        one, other = mechanics(plant_of(part), here), mechanics(plant_of(whole), values)
        for matrix in ("M", "D", "K", "B", "C"):
            np.testing.assert_allclose(getattr(one, matrix), getattr(other, matrix), rtol=1e-14)
        for mine, all_of_them in zip(one.derivatives, other.derivatives, strict=True):
            np.testing.assert_allclose(mine, all_of_them[kept], rtol=1e-14, atol=1e-300)
        assert hardware_cost(plant_of(part), here) == pytest.approx(
            hardware_cost(plant_of(whole), values), rel=1e-14
        )
        np.testing.assert_allclose(
            constraint_values(plant_of(part), here), constraint_values(plant_of(whole), values)
        )
        assert part.source.identity() != whole.source.identity()


def test_a_built_stage_with_a_fixed_length_is_drawn_and_differentiated() -> None:
    base = problem_of(load_case(TWO_MASS.with_name("rib_stage.toml")))
    source = replace(base.source, options=(*base.source.options, ("mesh", "coarse")))
    whole = replace(base, source=source)
    name = whole.names[1]
    part = restrict(whole, {name: (whole.start[1],)})
    kept = [i for i in range(len(whole.names)) if i != 1]
    here = tuple(whole.start[i] for i in kept)
    drawn = [
        plant.drawing({"": theta})
        for plant, theta in ((plant_of(part), here), (plant_of(whole), whole.start))
        if plant.drawing is not None
    ]
    assert len(drawn) == 2
    assert json.dumps(plain(drawn[0])) == json.dumps(plain(drawn[1]))
    one, other = mechanics(plant_of(part), here), mechanics(plant_of(whole), whole.start)
    np.testing.assert_array_equal(one.K, other.K)
    np.testing.assert_array_equal(one.derivatives[2], other.derivatives[2][kept])
    theta = ca.MX.sym("theta", len(kept))
    slope = ca.Function("slope", [theta], [ca.jacobian(plant_of(part).hardware(theta)[0], theta)])
    step = 1e-7 * np.eye(len(kept))[0]
    ends = [hardware_cost(plant_of(part), np.array(here) + sign * step) for sign in (1.0, -1.0)]
    assert float(slope(here)[0]) == pytest.approx((ends[0] - ends[1]) / 2e-7, rel=1e-5)


# ---- the search ----------------------------------------------------------------------------------


def quadratic(centre: np.ndarray, shape: np.ndarray) -> Any:
    """Solves a node of min |R (x - centre)|² over its box exactly, as a co-design would."""

    def solve(sampler: Any, near: Any = None) -> Any:
        own: CoDesignProblem = sampler.problem
        held = own.source.held
        names = ("m1", "m2", "m3")
        b = shape @ (np.array([held.get(name, 0.0) for name in names]) - centre)
        free = [names.index(name) for name in own.names]
        found = lsq_linear(shape[:, free], -b, (own.lower, own.upper), tol=1e-14)
        J = 2.0 * found.cost
        theta = dict(zip(own.names, found.x.tolist(), strict=True))
        result = {"status": "verified", "objective": J, "theta": theta, "reason": "", "checks": {}}
        result["held"] = held
        return Found(result)

    return solve


@dataclass(frozen=True)
class Found:
    """What the search asks of a Solution."""

    result: dict[str, Any]
    problem: CoDesignProblem | None = None


class OneSampler(SimpleNamespace):
    """What the search asks of a Sampler."""

    spent = SynthesisCounts()
    quiet = True

    def of(self, other: CoDesignProblem, *, traced: bool = True) -> "OneSampler":
        return OneSampler(problem=other)


def two_lists(rng: np.random.Generator) -> CoDesignProblem:
    lists = {
        name: tuple(sorted(rng.choice(np.arange(55.0, 71.0), rng.integers(2, 6), False).tolist()))
        for name in ("m1", "m2")
    }
    return problem(
        names=("m1", "m2", "m3"), units=("kg",) * 3, start=(60.0,) * 3,
        lower=(lists["m1"][0], lists["m2"][0], 50.0),
        upper=(lists["m1"][-1], lists["m2"][-1], 80.0),
        listed=tuple(lists.items()),
    )  # fmt: skip


def all_listed(own: CoDesignProblem, solve: Any) -> list[Found]:
    """Every combination by itself."""
    names = [name for name, _ in own.listed]
    every = itertools.product(*(values for _, values in own.listed))
    return [
        solve(
            OneSampler(problem=restrict(own, {n: (v,) for n, v in zip(names, row, strict=True)}))
        )
        for row in every
    ]


@few(max_examples=10)
@given(st.integers(0, 2**31))
def test_the_best_listed_values_are_found_where_nodes_are_solved_globally(seed: int) -> None:
    rng = np.random.default_rng(seed)
    own = two_lists(rng)
    solve = quadratic(rng.uniform(50.0, 75.0, 3), np.triu(rng.normal(size=(3, 3))) + np.eye(3))
    best = best_of_lists(OneSampler(problem=own), solve, solve)  # type: ignore[arg-type]
    every = [item.result["objective"] for item in all_listed(own, solve)]
    assert best.result["objective"] == pytest.approx(min(every), rel=1e-6, abs=1e-9)
    found = best.result["listed"]
    assert all(value in dict(own.listed)[name] for name, value in found["chosen"].items())
    whole = [tuple(map(tuple, node["lists"].values())) for node in found["nodes"]]
    assert len(whole) == len(set(whole))  # nothing is solved twice
    assert found["solved"] + found["cut"] == found["combinations"]
    assert found["between"] <= found["combinations"] // 2


@few(max_examples=15)
@given(st.integers(0, 2**31))
def test_five_by_five_values_take_fewer_searches_than_combinations(seed: int) -> None:
    """Bounds cut: the least of 25 takes 11 searches at most, of parts and combinations together."""
    rng = np.random.default_rng(seed)
    lists = [tuple(sorted(rng.choice(np.arange(50.0, 80.0), 5, False).tolist())) for _ in range(2)]
    own = replace(
        two_lists(rng), listed=(("m1", lists[0]), ("m2", lists[1])),
        lower=(lists[0][0], lists[1][0], 50.0), upper=(lists[0][-1], lists[1][-1], 80.0),
    )  # fmt: skip
    solve = quadratic(rng.uniform(45.0, 85.0, 3), np.triu(rng.normal(size=(3, 3))) + np.eye(3))
    best = best_of_lists(OneSampler(problem=own), solve, solve)  # type: ignore[arg-type]
    listed = best.result["listed"]
    assert len(listed["nodes"]) < 25
    if listed["cut"]:  # what cuts is no better than what was found
        assert listed["least_of_cut"] >= best.result["objective"] * (1.0 - 1e-6) - 1e-9
        assert f"{listed['cut']} excluded" in best.result["notes"][-1]
    least = min(item.result["objective"] for item in all_listed(own, solve))
    assert best.result["objective"] == pytest.approx(least, rel=1e-6, abs=1e-9)


@few(max_examples=15)
@given(st.integers(0, 2**31), st.floats(0.0, 50.0))
def test_a_first_search_that_ends_too_high_cuts_nothing_that_is_better(
    seed: int, missed: float
) -> None:
    rng = np.random.default_rng(seed)
    own = two_lists(rng)
    exact = quadratic(rng.uniform(50.0, 75.0, 3), np.triu(rng.normal(size=(3, 3))) + np.eye(3))

    def between(sampler: Any, near: Any) -> Found:
        found = exact(sampler)
        if near is None:  # the first
            return Found(found.result | {"objective": found.result["objective"] + missed})
        return found

    best = best_of_lists(OneSampler(problem=own), between, exact)  # type: ignore[arg-type]
    least = min(item.result["objective"] for item in all_listed(own, exact))
    assert best.result["objective"] == pytest.approx(least, rel=1e-6, abs=1e-9)


@few(max_examples=10)
@given(st.integers(0, 2**31), st.sampled_from([0.0, -1.0, -1e3]))
def test_the_best_is_judged_and_another_follows_where_that_costs_it_more(
    seed: int, shift: float
) -> None:
    """What a search finds is confirmed; what it says of J holds where J is zero or negative."""
    rng = np.random.default_rng(seed)
    own = two_lists(rng)
    exact = quadratic(rng.uniform(50.0, 75.0, 3), np.triu(rng.normal(size=(3, 3))) + np.eye(3))
    dearer = {}  # by what judging adds to J

    def shifted(found: Any, added: float = 0.0) -> Found:
        return Found(found.result | {"objective": found.result["objective"] + shift + added})

    def search(sampler: Any, near: Any) -> Found:
        return shifted(exact(sampler))

    def judge(sampler: Any, found: Any) -> Found:
        held = tuple(sampler.problem.source.held.values())
        dearer.setdefault(held, float(rng.uniform(0.0, 30.0)))
        return shifted(exact(sampler), dearer[held])

    best = best_of_lists(OneSampler(problem=own), search, search, judge)  # type: ignore[arg-type]
    J, listed = best.result["objective"], best.result["listed"]
    assert listed["judged"] == len(dearer)
    for item in all_listed(own, exact):
        held = tuple(item.result["held"].values())
        bound = item.result["objective"] + shift
        assert bound + dearer[held] >= J - 1e-6 if held in dearer else bound >= J - 1e-5
    if listed["between"]:
        assert listed["objective_above_free"] == J - listed["free_objective"]
        words = best.result["notes"][-1]
        above = listed["objective_above_free"]
        assert (f"J is {above:.3g} above" if above > 0.0 else "J is no worse than") in words
        assert "%" not in words


@few(max_examples=12)
@given(st.integers(0, 2**31))
def test_a_design_that_is_not_verified_cuts_no_verified_one(seed: int) -> None:
    """However low its J is: it is that of a design which breaks a bound."""
    rng = np.random.default_rng(seed)
    own = two_lists(rng)
    convex = quadratic(rng.uniform(50.0, 75.0, 3), np.triu(rng.normal(size=(3, 3))) + np.eye(3))
    bad = rng.choice(dict(own.listed)["m1"])

    def solve(sampler: Any, near: Any = None) -> Found:
        found = convex(sampler)
        if sampler.problem.source.held.get("m1") == bad:
            return Found(found.result | {"status": "not_verified", "objective": -1e9})
        return found

    best = best_of_lists(OneSampler(problem=own), solve, solve)  # type: ignore[arg-type]
    verified = [i.result for i in all_listed(own, solve) if i.result["status"] == "verified"]
    assert best.result["status"] == "verified"
    least = min(item["objective"] for item in verified)
    assert best.result["objective"] == pytest.approx(least, rel=1e-6, abs=1e-9)
    passed_over = [
        node
        for node in best.result["listed"]["nodes"]
        if node["status"] == "not_verified" and all(len(v) == 1 for v in node["lists"].values())
    ]
    words = best.result["notes"][-1]
    assert words.count("fix these values to see why") == len(passed_over)


@pytest.fixture(scope="module")
def listed_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of two masses, the first from a list."""
    folder = tmp_path_factory.mktemp("listed")
    text = TWO_MASS.read_text()
    start, end = text.index("lower"), text.index("[theta.m2]")
    path = folder / "case.toml"
    path.write_text(text[:start] + 'values = [64.0, 57.0, 61.0]\nunit = "kg"\n\n' + text[end:])
    case = load_case(path)
    with Workers(1) as pool, SampleStore(folder / "samples.sqlite") as store:
        sampler = Sampler(problem_of(case), store, pool)
        solution = co_design(sampler, Lifted(points=24, box_points=4), 0)
        write_run(folder, case, solution)
    return folder


@pytest.mark.slow
def test_a_run_is_of_the_value_that_was_chosen(listed_run: Path) -> None:
    run = read_run(listed_run)
    result = run.result
    assert result["status"] == "verified", result["reason"]
    assert result["fixed"] == {"m1": 57.0} == result["listed"]["chosen"]
    assert run.problem.names == ("m2",)
    assert run.problem.source.held == {"m1": 57.0}
    assert any("m1 = 57 kg (of 3 values)" in words for words in result["notes"])
    alone = problem_of(load_case(TWO_MASS))
    at_it = solve_problem(restrict(alone, {"m1": (57.0,)}), Lifted(points=24, box_points=4))
    assert result["objective"] == pytest.approx(at_it.result["objective"], rel=1e-6)
    heavier = solve_problem(restrict(alone, {"m1": (61.0,)}), Lifted(points=24, box_points=4))
    assert result["objective"] < heavier.result["objective"]


@pytest.mark.slow
def test_a_search_of_lists_finds_and_counts_the_same_with_any_number_of_workers(
    tmp_path: Path,
) -> None:
    """And all is in the store: a run that is repeated on it makes no synthesis."""
    own = problem(
        names=("m1", "m2"), units=("kg",) * 2, start=(60.0, 62.0), lower=(56.0, 58.0),
        upper=(64.0, 66.0), listed=(("m1", (56.0, 60.0, 64.0)),),
    )  # fmt: skip
    found = []
    for count, file in ((1, "one"), (2, "two"), (2, "one")):
        with Workers(count) as pool, SampleStore(tmp_path / f"{file}.sqlite") as store:
            before, sampler = store.count(), Sampler(own, store, pool)
            quick = Lifted(points=8, box_points=0, starts=2, max_refinements=1)
            best = co_design(sampler, quick, 0)
            lists, theta = best.result["listed"], best.result["theta"]
            found.append((lists, theta, repr(sampler.trace),
                          sampler.spent.by_purpose, best.result["notes"]))  # fmt: skip
            assert before in (0, store.count())
            steps = [entry.syntheses for entry in sampler.trace]
            assert steps == sorted(steps)
            assert steps[-1] == sampler.syntheses
    assert found[0] == found[1] == found[2]


def test_what_sections_spend_is_counted_over_all_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They were solved on a sampler of their own, and a catalogue said "syntheses": 0."""

    def solve_formulation(outer: StructuredOuter, *_: object) -> FormulationResult:
        outer.sampler._spend("a design", 5, (60.0, 60.0), 12.0)
        return FormulationResult(message="nothing is feasible")

    monkeypatch.setattr(StructuredOuter, "solve_formulation", solve_formulation)
    monkeypatch.setattr(outer_structured, "with_initial_search", lambda of, _: (of.problem, ""))
    own = problem(controller=StructuredProblem())
    with SampleStore(tmp_path / "s.sqlite") as store:
        sampler = Sampler(own, store, Workers(1))
        search_outer(StructuredOuter(sampler.of(own)), Direct(), 0)
        assert sampler.syntheses == 6  # five designs and a multi-start search
