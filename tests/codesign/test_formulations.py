"""The formulation where the user names none is one that ends; the others say that they do not."""

import tomllib
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from oracles.helpers import HZ, problem

from ccd_casadi.cases.case import load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign import run
from ccd_casadi.codesign.formulations import (
    Direct,
    SurrogateLimits,
    formulation_of,
    slow_words,
    usual_name,
)
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.sampling.inner_samples import InnerSample, SynthesisCounts

ROOT = Path(__file__).parents[2]
LIMITS = SurrogateLimits()
CASE = load_case(ROOT / "runs" / "two_mass.toml")
CHAIN = """
import casadi as ca

def chain(theta, masses):
    n = int(masses)
    m, k = [theta[f"m{i}"] for i in range(n)], [theta[f"k{i}"] for i in range(n - 1)]
    ends = [ca.DM([float(j == i) - float(j == i + 1) for j in range(n)]) for i in range(n - 1)]
    force = ca.DM([1.0] + [0.0] * (n - 1))
    return {
        "mass": ca.diag(ca.vertcat(*m)),
        "stiffness": sum(1.6e6 * k[i] * (e @ e.T) for i, e in enumerate(ends)),
        "damping_ratio": 0.01, "input": force, "output": force.T,
        "hardware_cost": sum(m) + 0.1 * sum(k),
    }
"""


def stands_in(required: list) -> Callable[..., Solution]:
    """In the place of a run: it notes the formulation."""

    def co_design(_: object, formulation: object, __: object) -> Solution:
        required.append(formulation)
        return Solution({}, None, None)  # type: ignore[arg-type]

    return co_design


def chain_of(masses: int, folder: Path) -> CoDesignProblem:
    """A chain that floats: masses and springs are its parameters, force and sensor on the first."""
    file = folder / "chain.py"
    file.write_text(CHAIN)
    names = (*(f"m{i}" for i in range(masses)), *(f"k{i}" for i in range(masses - 1)))
    n, space = len(names), {}
    exec(CHAIN, space)
    plant = build_plant(space["chain"], names, {"masses": masses})
    natural = modal_plant(mechanics(plant, (1.0,) * n), Suspension()).natural
    first = float(natural[natural > 1.0].min())
    speed = 0.3 * first
    own = problem()
    return replace(
        own,
        source=PlantSource(None, str(file), "chain", (("masses", masses),)),
        names=names, units=("",) * n, lower=(0.6,) * n, upper=(1.6,) * n, start=(1.0,) * n,
        w1=0.5 * speed / n, w2=-1.0,
        weights=replace(
            own.weights, omega_S=speed, omega_K=2.0 * speed, M_K=2.0 * masses * speed**2,
            omega_T=speed,
        ),
        inner=replace(
            own.inner, S_max=1.9, S_low=0.1, omega_low=speed / 30.0,
            omega_S=(speed / 5.0, 30.0 * speed), omega_T=(speed / 2.0, 20.0 * speed),
        ),
        suspension=Suspension(first / HZ / 500.0, 0.7),
    )  # fmt: skip


def test_the_usual_formulation_has_an_end() -> None:
    """Nested as long as its plan is small and its surrogate worth a fit, else direct."""
    spread = replace(CASE, sampling=replace(CASE.sampling, design="sobol", points=64))
    for count in range(1, 40):
        on_grid = CASE.sampling.points**count <= LIMITS.samples and count <= LIMITS.parameters
        assert usual_name(CASE, count) == ("nested" if on_grid else "direct")
        assert usual_name(spread, count) == ("nested" if count <= LIMITS.parameters else "direct")
        assert not slow_words(formulation_of(CASE, usual_name(CASE, count)), count)
        slow = bool(slow_words(formulation_of(CASE, "lifted"), count))
        assert slow == (count > LIMITS.parameters)
    assert "\n" not in slow_words(formulation_of(CASE, "lifted"), 23)
    assert usual_name(CASE, 2) == "nested"


@pytest.mark.parametrize(("masses", "expected"), [(2, Nested), (6, Direct)])
def test_a_script_gets_one_that_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, masses: int, expected: type
) -> None:
    required = []
    monkeypatch.setattr(run, "co_design", stands_in(required))
    run.solve(chain_of(masses, tmp_path))
    assert [type(item) for item in required] == [expected]


def test_a_script_gets_the_formulation_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the options of the case, and those of a case without such tables for a problem."""
    required = []
    monkeypatch.setattr(run, "co_design", stands_in(required))
    own = replace(CASE, sampling=replace(CASE.sampling, points=4))
    for given in (own, problem_of(own)):
        run.solve(given)
    bare = {key: table for key, table in tomllib.loads(CASE.path.read_text("utf-8")).items()
            if key not in ("sampling", "outer")}  # fmt: skip
    plain = parse_case(bare, CASE.path)
    assert required == [formulation_of(case, usual_name(case, 2)) for case in (own, plain)]


@pytest.mark.parametrize(
    ("more", "said"), [([], ""), (["--formulation", "nested"], "nested is slow with 23 parameters")]
)
def test_the_command_says_what_is_slow(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    said: str,
) -> None:
    class Asked(Exception):
        pass

    def co_design(_: object, formulation: object, *__: object) -> None:
        assert isinstance(formulation, Direct) == (not more)
        raise Asked

    monkeypatch.setattr(run, "co_design", co_design)
    command, chain = import_module("ccd_casadi.solve"), chain_of(12, tmp_path)
    monkeypatch.setattr(command, "show_findings", lambda *_: None)
    monkeypatch.setattr("ccd_casadi.cases.case_problem.problem_of", lambda _: chain)
    options = SimpleNamespace(
        resume=False, budget=None,
        case=ROOT / "runs" / "two_mass.toml", out=tmp_path / "run", quiet=False, no_report=True,
        surrogate=None, scheduler=None, workers=1, seed=0,
        formulation=more[1] if more else None,
    )  # fmt: skip
    with pytest.raises(Asked):
        command.main.__wrapped__(options)
    error = capsys.readouterr().err
    assert said in error
    assert ("slow" in error) == bool(said)


@pytest.mark.slow
def test_a_chain_of_twelve_masses_ends_verified(tmp_path: Path) -> None:
    """23 parameters: lifted had no end in eight minutes."""
    solution = run.solve(chain_of(12, tmp_path))
    assert solution.result["formulation"] == "direct"
    assert solution.result["status"] == "verified"
    assert solution.verified is not None
    assert np.isfinite(solution.verified.objective)


@pytest.mark.parametrize("reach", [0.3, 1e-6])
def test_nested_looks_around_the_only_feasible_sample(reach: float) -> None:
    """A sliver that one θ of the plan lies in; narrower than any step, it is the design."""
    case = problem()
    centre, width = np.array([55.0, 62.5]), np.array([15.0, 15.0])
    required: list[tuple[float, ...]] = []

    def values(thetas: np.ndarray, *_: object) -> list[InnerSample]:
        found = []
        for theta in map(tuple, np.atleast_2d(thetas).tolist()):
            inside = np.abs((theta - centre) / width).max() < reach
            value = 400.0 + theta[1] if inside else np.nan
            required.append(theta)
            found.append(InnerSample(theta, value, (0.0, 1.0), 1e3, 1e2, (), "", 0.0, 1))
        return found

    sampler = SimpleNamespace(
        problem=case, values=values, spent=SynthesisCounts(), latest=list, improvements=0
    )
    options = Nested(points=3, starts=4, max_refinements=3)
    found = solve_nested(sampler, options, seed=0)  # type: ignore[arg-type]
    assert len(required) > 10 + 5  # the plan and the start, then around what is feasible
    assert found.x is not None
    assert np.abs((found.x[:2] - centre) / width).max() < reach
    assert bool(found.surrogates) is (reach > 0.1)
