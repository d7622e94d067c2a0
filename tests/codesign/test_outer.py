"""The outer problem on analytic surrogates whose solution is known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import HZ, INNER, few, problem
from scipy.optimize import lsq_linear

from ccd_casadi.codesign.outer_problem import (
    NonlinearProgram,
    OuterFailure,
    lifted_bounds,
    outer_program,
    solve_program,
)
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.optim.pieces import Box
from ccd_casadi.studies.comparison import design_hardware, first_resonance

W1, W2 = 0.0995, -0.9950
LOWER, UPPER = np.array([55.0, 55.0]), np.array([70.0, 70.0])
CONSTRAINED = """
from ccd_casadi.plants.registry import two_mass

def model(theta, least):
    light = {"total": least - theta["m1"] - theta["m2"], "never": theta["m1"] - 1000.0}
    return two_mass(theta, 0.01) | {"constraints": light}
"""


def surrogate(of: Callable[[ca.SX, ca.SX], ca.SX]) -> ca.Function:
    theta = ca.SX.sym("theta", 2)
    return ca.Function("bandwidth", [theta], [of(theta[0], theta[1])])


def starts(count: int = 12, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 2))


def constrained(folder: Path, least: float) -> CoDesignProblem:
    """J over θ with m1 + m2 >= least."""
    (folder / "plant.py").write_text(CONSTRAINED)
    source = PlantSource(None, str(folder / "plant.py"), "model", (("least", least),))
    return problem(source=source)


def test_interior_optimum_is_where_calculus_puts_it() -> None:
    bandwidth = surrogate(lambda a, b: 400.0 - (a - 60.0) ** 2 - 2.0 * (b - 62.0) ** 2)
    program = outer_program(problem(), bandwidth)
    solution = solve_program(program, starts())
    # w1 + w2 (-2 (m1 - 60)) = 0, and likewise with 4 for m2
    expected = np.array([60.0 + W1 / (2.0 * W2), 62.0 + W1 / (4.0 * W2)])
    np.testing.assert_allclose(solution.best.x, expected, rtol=1e-8)
    value = W1 * expected.sum() + W2 * float(bandwidth(expected))
    assert solution.best.objective == pytest.approx(value, rel=1e-12)
    assert len(solution.optima) == 1
    assert solution.best.starts == solution.starts == 12


@pytest.mark.parametrize(
    ("slopes", "corner"),
    [((3.0, -2.0), (70.0, 55.0)), ((-3.0, 2.0), (55.0, 70.0)), ((0.1, 0.2), (None, 70.0))],
)
def test_an_optimum_lies_on_the_bounds_that_the_slopes_lead_to(
    slopes: tuple[float, float], corner: tuple[float | None, float]
) -> None:
    """With slope w1/|w2| = 0.1, J is flat along m1 but for a bowl."""
    flat = corner[0] is None
    bandwidth = surrogate(
        lambda a, b: 300.0 + slopes[0] * a + slopes[1] * b - flat * (a - 61.0) ** 2
    )
    program = outer_program(problem(), bandwidth)
    solution = solve_program(program, starts())
    expected = [61.0 if flat else corner[0], corner[1]]
    np.testing.assert_allclose(solution.best.x, expected, atol=1e-6)
    assert (program.box.lower <= solution.best.x).all()
    assert (solution.best.x <= program.box.upper).all()


def test_a_hardware_constraint_is_respected(tmp_path: Path) -> None:
    def bowl(a: ca.SX, b: ca.SX) -> ca.SX:
        return 400.0 - (a - 56.0) ** 2 - (b - 58.0) ** 2

    program = outer_program(constrained(tmp_path, 120.0), surrogate(bowl))
    best = solve_program(program, starts()).best
    # the nearest point to the bowl's centre (the cost is constant along m1 + m2 = 120)
    np.testing.assert_allclose(best.x, [59.0, 61.0], rtol=1e-8)
    assert 120.0 - best.x.sum() <= 1e-8
    slack = solve_program(outer_program(constrained(tmp_path, 110.5), surrogate(bowl)), starts())
    assert slack.best.x.sum() < 115.0, "without the constraint the optimum is elsewhere"


def test_constraints_that_cannot_be_met_are_a_failure(tmp_path: Path) -> None:
    program = outer_program(constrained(tmp_path, 141.0), surrogate(lambda a, b: a + b))
    with pytest.raises(OuterFailure, match="converged from none of 3 starts: Infeasible"):
        solve_program(program, starts(3))


def test_every_local_optimum_is_found_once_and_ranked() -> None:
    """Three ridges along m1, two along m2, of different heights."""

    def hills(a: ca.SX, b: ca.SX) -> ca.SX:
        wave = ca.cos(2 * np.pi * (a - 57.5) / 5.0) + ca.cos(2 * np.pi * (b - 58.5) / 8.0)
        return 300.0 + 10.0 * wave + 0.4 * a - 0.3 * b

    bandwidth = surrogate(hills)
    solution = solve_program(outer_program(problem(), bandwidth), starts(60))
    values = [optimum.objective for optimum in solution.optima]
    assert values == sorted(values)
    assert solution.best is solution.optima[0]
    assert sum(optimum.starts for optimum in solution.optima) == solution.starts == 60
    # independent: local minima of J on a fine grid
    axis = np.linspace(55.0, 70.0, 301)
    mesh = np.stack(np.meshgrid(axis, axis, indexing="ij")).reshape(2, -1)
    grid = (W1 * mesh.sum(axis=0) + W2 * np.array(bandwidth(mesh)).ravel()).reshape(301, 301)
    padded = np.pad(grid, 1, constant_values=np.inf)
    around = [
        padded[1 + i : 302 + i, 1 + j : 302 + j]
        for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)
    ]  # fmt: skip
    minima = np.argwhere(grid < np.min(around, axis=0))
    assert len(minima) == 6
    assert len(solution.optima) == 6
    for i, j in minima:
        near = [np.abs(optimum.x - [axis[i], axis[j]]).max() for optimum in solution.optima]
        assert sum(distance < 0.06 for distance in near) == 1
    assert solution.best.objective == pytest.approx(grid.min(), abs=0.05)
    assert solution.best.objective <= grid.min()


@few(max_examples=25)
@given(st.integers(0, 10**6), st.booleans())
def test_convex_problems_in_a_box_agree_with_scipy(seed: int, exact: bool) -> None:
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(5, 3)), 3.0 * rng.normal(size=5)
    lower = rng.uniform(-2.0, 0.0, 3)
    upper = lower + rng.uniform(0.1, 3.0, 3)
    x = ca.MX.sym("x", 3)
    within = Box(lower, upper)
    program = NonlinearProgram(x, ca.sumsqr(ca.DM(A) @ x - b), ca.MX(0, 1), within, exact)
    best = solve_program(program, rng.uniform(lower, upper, (2, 3))).best
    reference = lsq_linear(A, b, (lower, upper), tol=1e-14)
    assert best.objective == pytest.approx(2.0 * reference.cost, rel=1e-6)
    np.testing.assert_allclose(best.x, reference.x, atol=1e-4)


def test_starts_outside_the_box_are_put_onto_it() -> None:
    program = outer_program(problem(), surrogate(lambda a, b: -((a - 60.0) ** 2) - b))
    best = solve_program(program, np.array([[-1e3, 1e3]])).best
    np.testing.assert_allclose(best.x, [60.0 + W1 / (2.0 * W2), 55.0], atol=1e-5)


def test_lifted_problem_keeps_the_bounds_on_s() -> None:
    """ω_b grows with ω_S until ‖S‖∞ reaches S_max; σ_max(S(jω_low)) wants ω_T above a value."""
    x = ca.SX.sym("x", 4)
    ln_S, ln_T = x[2], x[3]
    quantities = ca.Function(
        "q", [x],
        [
            ca.vertcat(
                100.0 * ln_S - 20.0 * ln_T - 0.5 * (x[0] - 60.0) ** 2 - 0.5 * (x[1] - 65.0) ** 2,
                np.log(1.2) + 0.1 * (ln_S - np.log(20.0 * HZ)),
                np.log(0.1) - 0.4 * (ln_T - np.log(30.0 * HZ)),
                1.0,
            )
        ],
    )  # fmt: skip
    case = problem()
    program = outer_program(case, quantities)
    lower, upper = lifted_bounds(case)
    np.testing.assert_allclose(np.exp(lower[2:]) / HZ, [10.0, 25.0])
    np.testing.assert_allclose(np.exp(upper[2:]) / HZ, [1800.0, 1000.0])
    points = np.random.default_rng(0).uniform(lower, upper, (6, 4))
    for solved in (program, replace(program, exact_hessian=False)):
        best = solve_program(solved, points).best
        peak, low = np.exp(np.array(quantities(best.x)).ravel()[1:3])
        assert peak <= INNER.S_max * (1.0 + 1e-12)
        assert low <= INNER.S_low * (1.0 + 1e-12)
        expected = [
            60.0 + W1 / W2,
            65.0 + W1 / W2,
            np.log(20.0 * HZ) + 10.0 * np.log(1.75 / 1.2),
            np.log(30.0 * HZ) + 2.5 * np.log(0.1 / 0.03),
        ]
        np.testing.assert_allclose(best.x, expected, rtol=1e-5)


def test_lambda_and_the_bounds_on_s_are_kept_together(tmp_path: Path) -> None:
    x = ca.SX.sym("x", 4)
    q = ca.vertcat(100.0 * x[2] - x[0] - x[1], 0.3 * x[2] - 0.3 * np.log(60.0 * HZ), -9.0, 1.0)
    case = constrained(tmp_path, 130.0)
    program = outer_program(case, ca.Function("q", [x], [q]))
    lower, upper = lifted_bounds(problem())
    best = solve_program(program, 0.5 * (lower + upper)[None, :]).best
    assert best.x[:2].sum() == pytest.approx(130.0, abs=1e-6)
    assert best.x[2] == pytest.approx(np.log(60.0 * HZ) + np.log(1.75) / 0.3, rel=1e-8)


def test_hardware_of_a_first_resonance_is_the_equal_masses_that_have_it() -> None:
    """From equal masses, by symmetry: the lightest pair beside them that is stiff enough."""
    case = problem(start=(66.0, 66.0))
    wanted = first_resonance(case, np.array([62.0, 62.0]))[0]
    found = design_hardware(case, wanted, starts=0)
    assert found.met
    assert found.theta == pytest.approx((62.0, 62.0), rel=1e-6)
    assert found.first_resonance == pytest.approx(wanted, rel=1e-6)
