"""The trade-off curve and the responses of the optimum, against brute force and re-solving."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.kinked import polish
from ccd_casadi.codesign.outer import Place
from ccd_casadi.codesign.pareto import Front, pareto_front
from ccd_casadi.codesign.post_optimal import post_optimal
from ccd_casadi.codesign.run import outer_of
from ccd_casadi.drawing.content import Lines
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_inner
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.insight import main
from ccd_casadi.reporting.insight_page import front_answer, front_figure
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"
PLANT = """
from ccd_casadi.plants.registry import two_mass

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
    return polish(sampler.truth, start).x


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


TRADE = "0.1 * (70.0 - theta['m1']) ** 2 + 0.2 * (70.0 - theta['m2']) ** 2"


@pytest.fixture(scope="module")
def traded(tmp_path_factory: pytest.TempPathFactory) -> tuple[CoDesignProblem, Front]:
    """A front where light masses, which are fast, cost more than heavy ones."""
    folder = tmp_path_factory.mktemp("front")
    problem = own_problem(folder, TRADE)
    with SampleStore(folder / "samples.sqlite") as store:
        sampler = Sampler(problem, store, Workers(1))
        return problem, pareto_front(outer_of, sampler, (60.0, 60.0), points=6)


def test_front_is_verified_and_goes_from_the_lightest_to_the_fastest(traded) -> None:
    _, front = traded
    assert 3 <= len(front.points) <= 6
    assert all(point.verified for point in front.points)
    light, fast = front.points[0], front.points[-1]
    assert light.theta == pytest.approx((70.0, 70.0), abs=0.1)
    assert fast.theta == pytest.approx((55.0, 55.0), abs=0.1)
    assert fast.bandwidth / (2.0 * np.pi) == pytest.approx(71.9319, abs=1e-2)


def test_every_point_is_the_best_of_all_for_some_weights(traded) -> None:
    _, front = traded
    cost, omega = (np.array([getattr(point, name) for point in front.points])
                   for name in ("hardware_cost", "bandwidth"))  # fmt: skip
    slopes = np.diff(omega) / np.diff(cost)
    assert (np.diff(cost) > 0.0).all()
    assert (np.diff(omega) > 0.0).all()
    assert (np.diff(slopes) < 0.0).all()  # a convex hull: the first hertz are the cheapest


@pytest.mark.slow
def test_no_other_masses_lie_beyond_the_front(traded) -> None:
    """The weights of two neighbours that are as good as each other: a grid has nothing better."""
    problem, front = traded
    for light, fast in pairwise(front.points):
        a, b = fast.bandwidth - light.bandwidth, fast.hardware_cost - light.hardware_cost
        best = min(a * point.hardware_cost - b * point.bandwidth for point in front.points)
        for m1 in np.linspace(55.0, 70.0, 4):
            for m2 in np.linspace(55.0, 70.0, 4):
                f = 0.1 * (70.0 - m1) ** 2 + 0.2 * (70.0 - m2) ** 2
                J = a * f - b * true_inner(problem, (m1, m2)).bandwidth
                # with six points more designs fit between two of them, by some of the triangle
                assert not (J - best) / (a * b) < -0.3


def test_the_lightest_may_be_the_fastest(truth_of: Callable[[CoDesignProblem], Sampler]) -> None:
    front = pareto_front(outer_of, truth_of(problem_of(load_case(TWO_MASS))), (60.0, 60.0))
    (point,) = front.points
    assert front.whole
    assert point.theta == pytest.approx((55.0, 55.0), abs=1e-6)


class ErrorOverMasses:
    """A sampler and an outer problem in one, by hand: the error falls with both masses."""

    quiet, syntheses, global_check_is_cheap = True, 0, True
    grid = np.array([[m1, m2] for m1 in range(55, 71) for m2 in range(55, 71)], float)

    def __init__(self, problem: CoDesignProblem) -> None:
        self.problem = problem

    def of(self, problem: CoDesignProblem, **_: bool) -> "ErrorOverMasses":
        return ErrorOverMasses(problem)

    def values(self, thetas: Array, _: str = "") -> list[InnerSample]:
        return [
            InnerSample(tuple(theta), 300.0, (), np.nan, np.nan, (), "", 0.0, 0,
                            error=float(1e-3 * (55.0 / theta[0] + 2.0 * (55.0 / theta[1]) ** 3)))
            for theta in np.atleast_2d(thetas)
        ]  # fmt: skip

    def local_solve(self, *_: object) -> Place:
        found = [objective_of(self.problem, one) for one in self.values(self.grid)]
        return Place(self.grid[int(np.argmin(found))], min(found), True)

    def theta_of(self, x: Array) -> Array:
        return x


def test_a_front_of_an_error_goes_down_with_the_cost() -> None:
    least = StructuredProblem(minimise="rms_error")
    problem = replace(problem_of(load_case(TWO_MASS)), controller=least, w2=1.0)
    front = pareto_front(lambda each: each, ErrorOverMasses(problem), (60.0, 60.0), points=8)
    cost, error = (np.array([getattr(point, name) for point in front.points])
                   for name in ("hardware_cost", "value"))  # fmt: skip
    assert len(front.points) >= 4
    assert front.points[0].theta == (55.0, 55.0)
    assert front.points[-1].theta == (70.0, 70.0)
    slopes = np.diff(error) / np.diff(cost)
    assert (slopes < 0.0).all()
    assert (np.diff(slopes) > 0.0).all()
    drawn = front_figure(problem, front, (cost[0], 1e9 * error[0], "")).drawing
    assert isinstance(drawn, Lines)
    panel = drawn.rows[0][0]
    assert panel.y_label == "RMS error e (nm)"
    np.testing.assert_allclose(panel.curves[0].y, 1e9 * error)
    assert "Less RMS error costs hardware" in front_answer(problem, front)


def test_a_constant_cost_leaves_nothing_to_trade(
    tmp_path: Path, truth_of: Callable[[CoDesignProblem], Sampler]
) -> None:
    problem = own_problem(tmp_path, "7.0")
    with pytest.raises(UserError, match="hardware_cost is the same"):
        pareto_front(outer_of, truth_of(problem), (60.0, 60.0), points=3)


def test_command_writes_numbers_and_a_page(two_mass_run: Path, tmp_path: Path) -> None:
    folder = Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    assert main([str(folder), "--points", "3", "--workers", "1", "--quiet"]) == 0
    found = json.loads((folder / "insight.json").read_text())
    assert [point["status"] for point in found["front"]["points"]] == ["verified"]
    assert found["optimum"]["responses"]["S_max"]["objective"] == pytest.approx(-64.177, rel=1e-4)
    assert found["first_resonance_over_bandwidth"] == pytest.approx(183.56 / 71.932, rel=1e-3)
    page = (folder / "insight.html").read_text()
    assert "is also the fastest" in page
    assert "2.55 times the bandwidth" in page


def test_command_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([str(tmp_path / "nothing"), "--quiet"]) == 2
    assert "is not a folder" in capsys.readouterr().err
    assert main([str(tmp_path), "--points", "1"]) == 2
    assert "from 2 to 9999" in capsys.readouterr().err
