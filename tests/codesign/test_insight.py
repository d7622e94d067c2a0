"""The trade-off curve and the responses of the optimum, against brute force and re-solving."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.direct import polish
from ccd_casadi.codesign.front_learners import LiftedLearner
from ccd_casadi.codesign.pareto import Front, pareto_front
from ccd_casadi.codesign.post_optimal import post_optimal
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_inner
from ccd_casadi.insight import main
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"
PLANT = """
from ccd_casadi.plants.two_mass import two_mass

def model(theta):
    bowl = (theta["m1"] - 58.0) ** 2 + (theta["m2"] - 59.0) ** 2
    return two_mass(theta, 0.01) | {"hardware_cost": COST}
"""


def own_problem(folder: Path, cost: str) -> CoDesignProblem:
    """Case study 1 with another hardware cost."""
    (folder / "plant.py").write_text(PLANT.replace("COST", cost))
    case = TWO_MASS.read_text().replace('model = "two_mass"', 'function = "plant.py:model"')
    (folder / "case.toml").write_text(case.replace("zeta = 0.01", "#", 1))
    return problem_of(load_case(folder / "case.toml"))


@pytest.fixture
def truth_of(tmp_path: Path) -> Iterator[Callable[[CoDesignProblem], Sampler]]:
    with SampleStore(tmp_path / "samples.sqlite") as store:
        yield lambda problem: Sampler(problem, store, Workers(1))


def optimum(sampler: Sampler, start: Array) -> Array:
    return polish(sampler, start)[0]


def bowl_start(problem: CoDesignProblem, theta: tuple[float, float]) -> Array:
    inner = true_inner(problem, theta)
    assert inner.optimum is not None
    figures = inner.optimum.figures
    return np.array([*theta, np.log(figures.omega_S), np.log(figures.omega_T)])


def test_responses_are_what_solving_again_gives(
    tmp_path: Path, truth_of: Callable[[CoDesignProblem], Sampler]
) -> None:
    """An optimum inside the box of θ: the Lagrangian's Hessian has its part in it."""
    problem = replace(own_problem(tmp_path, "bowl"), w1=2.0)
    x = optimum(truth_of(problem), bowl_start(problem, (57.0, 58.0)))
    assert all(
        low < v < high for low, v, high in zip(problem.lower, x[:2], problem.upper, strict=True)
    )
    found = post_optimal(problem, x)
    assert found.determined
    responses = {item.parameter: item for item in found.responses}
    inner = problem.inner
    steps: dict[str, tuple[float, Callable[[float], CoDesignProblem]]] = {
        "w1": (1e-3, lambda h: replace(problem, w1=problem.w1 + h)),
        "w2": (1e-3, lambda h: replace(problem, w2=problem.w2 + h)),
        "S_max": (1e-3, lambda h: replace(problem, inner=replace(inner, S_max=inner.S_max + h))),
    }
    for name, (h, changed) in steps.items():
        ends = [(changed(s * h), optimum(truth_of(changed(s * h)), x)) for s in (1.0, -1.0)]
        slope = (ends[0][1] - ends[1][1]) / (2.0 * h)
        item = responses[name]
        assert np.array([*item.theta, *item.ln_omega]) == pytest.approx(slope, rel=2e-3, abs=1e-5)
        J = [_objective(p, at) for p, at in ends]
        assert item.objective == pytest.approx((J[0] - J[1]) / (2.0 * h), rel=1e-3)


def _objective(problem: CoDesignProblem, x: Array) -> float:
    bowl = (x[0] - 58.0) ** 2 + (x[1] - 59.0) ** 2
    inner = problem.inner
    omega = np.clip(np.exp(x[2:]), [inner.omega_S[0], inner.omega_T[0]],
                    [inner.omega_S[1], inner.omega_T[1]])  # fmt: skip
    from ccd_casadi.inner_problem.problem import true_design

    design = true_design(problem, tuple(x[:2]), float(omega[0]), float(omega[1]))
    return float(problem.w1 * bowl + problem.w2 * design.figures.bandwidth)


@pytest.fixture(scope="module")
def front(tmp_path_factory: pytest.TempPathFactory) -> Front:
    problem = problem_of(load_case(TWO_MASS))
    with SampleStore(tmp_path_factory.mktemp("front") / "samples.sqlite") as store:
        return pareto_front(LiftedLearner(Sampler(problem, store, Workers(1))), points=4)


def test_front_is_verified_and_spans_the_costs(front: Front) -> None:
    assert [point.verified for point in front.points] == [True] * 4
    costs = [point.hardware_cost for point in front.points]
    assert costs == pytest.approx(np.linspace(110.0, 140.0, 4), abs=1e-6)
    assert front.points[0].bandwidth / (2.0 * np.pi) == pytest.approx(72.0452, abs=1e-3)


def test_no_other_masses_of_the_same_sum_are_faster(front: Front) -> None:
    problem = problem_of(load_case(TWO_MASS))
    for point in front.points[1:3]:
        low, high = max(55.0, point.hardware_cost - 70.0), min(70.0, point.hardware_cost - 55.0)
        for m1 in np.linspace(low, high, 5):
            other = true_inner(problem, (m1, point.hardware_cost - m1)).bandwidth
            assert not other > point.bandwidth * (1.0 + 1e-3)


def test_efficient_points_are_those_that_nothing_beats(front: Front) -> None:
    for point in front.points:
        beaten = any(
            other.hardware_cost <= point.hardware_cost and other.bandwidth > point.bandwidth
            for other in front.points
        )
        assert point.efficient is not beaten


def test_a_constant_cost_leaves_nothing_to_trade(
    tmp_path: Path, truth_of: Callable[[CoDesignProblem], Sampler]
) -> None:
    problem = own_problem(tmp_path, "7.0")
    with pytest.raises(UserError, match="hardware_cost is the same"):
        pareto_front(LiftedLearner(truth_of(problem)), points=3)


def test_command_writes_numbers_and_a_page(two_mass_run: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(two_mass_run, tmp_path / "run"))
    assert main([str(folder), "--points", "3", "--workers", "1", "--quiet"]) == 0
    found = json.loads((folder / "insight.json").read_text())
    assert [point["status"] for point in found["front"]["points"]] == ["verified"] * 3
    assert found["optimum"]["responses"]["S_max"]["objective"] == pytest.approx(-64.154, rel=1e-4)
    assert found["first_resonance_over_bandwidth"] == pytest.approx(183.56 / 72.045, rel=1e-3)
    page = (folder / "insight.html").read_text()
    assert "is also the fastest" in page
    assert "2.55 times the bandwidth" in page


def test_command_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([str(tmp_path / "nothing"), "--quiet"]) == 2
    assert "is not a folder" in capsys.readouterr().err
    assert main([str(tmp_path), "--points", "1"]) == 2
    assert "from 2 to 9999" in capsys.readouterr().err
