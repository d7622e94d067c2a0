"""The true inner quantities as a CasADi function, as a user would have them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from oracles.helpers import HZ, INNER, problem

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.problem import scaled_plant, true_design
from ccd_casadi.inner_problem.search import search_inner


def point(m1: float, m2: float, S_hz: float, T_hz: float) -> np.ndarray:
    return np.array([m1, m2, np.log(S_hz * HZ), np.log(T_hz * HZ)])


POINTS = [point(60, 60, 800, 40), point(55, 55, 1800, 26.07), point(68.1, 57.3, 33, 700)]


@pytest.mark.parametrize("x", POINTS)
def test_value_and_jacobian_are_those_of_the_synthesis(x: np.ndarray) -> None:
    case = problem()
    quantities = TrueQuantities(case)
    design = true_design(case, x[:2], float(np.exp(x[2])), float(np.exp(x[3])))
    symbol = ca.MX.sym("x", 4)
    function = ca.Function(
        "f", [symbol], [quantities(symbol), ca.jacobian(quantities(symbol), symbol)]
    )
    value, jacobian = (np.array(result) for result in function(x))
    np.testing.assert_allclose(value.ravel(), design.values, rtol=2e-10)
    exact = np.hstack([design.to_theta, design.to_break_frequencies])
    np.testing.assert_allclose(jacobian, exact, rtol=1e-7, atol=1e-10)
    # and through an expression, by the chain rule
    scalar = 0.3 * quantities(symbol)[0] + ca.sin(quantities(symbol)[1]) * symbol[1]
    slope = np.array(ca.Function("g", [symbol], [ca.gradient(scalar, symbol)])(x)).ravel()
    expected = 0.3 * exact[0] + np.cos(design.values[1]) * x[1] * exact[1]
    expected[1] += np.sin(design.values[1])
    np.testing.assert_allclose(slope, expected, rtol=1e-7)


def test_jacobian_matches_differences_of_the_function() -> None:
    quantities = TrueQuantities(problem())
    x = POINTS[0]
    jacobian = quantities.jacobian_at(x)
    for k in range(4):
        h = 1e-3 * (x[k] if k < 2 else 1.0) * np.eye(4)[k]
        f = [quantities.values(x + step * h) for step in (1, -1, 2, -2)]
        found = (8.0 * (f[0] - f[1]) - (f[2] - f[3])) / (12.0 * h[k])
        np.testing.assert_allclose(jacobian[:, k], found, rtol=1e-5, atol=1e-7)


def test_repeated_points_cost_nothing_and_every_synthesis_can_be_kept() -> None:
    seen: list[np.ndarray] = []

    def kept(x, make):
        seen.append(x)
        return make()

    quantities = TrueQuantities(problem(), kept)
    for x in (POINTS[0], POINTS[1], POINTS[0]):
        quantities.values(x)
        quantities.jacobian_at(x)
    assert [x.tolist() for x in seen] == [POINTS[0].tolist(), POINTS[1].tolist()]


def test_ends_of_the_box_are_not_overstepped_by_rounding() -> None:
    case = problem()
    quantities = TrueQuantities(case)
    for corner in lifted_bounds(case):
        figures = quantities.at(corner).figures
        assert INNER.omega_S[0] <= figures.omega_S <= INNER.omega_S[1]
        assert INNER.omega_T[0] <= figures.omega_T <= INNER.omega_T[1]
        omega = np.array([figures.omega_S, figures.omega_T])
        np.testing.assert_allclose(np.log(omega), corner[2:], rtol=1e-14)


def test_uncertified_designs_are_nan() -> None:
    # a back-off of less than one asks for what cannot be had
    case = problem(inner=replace(INNER, gamma_backoff=0.9))
    quantities = TrueQuantities(case)
    assert not quantities.at(POINTS[0]).figures.certified
    assert np.isnan(quantities.values(POINTS[0])).all()
    assert np.isnan(quantities.jacobian_at(POINTS[0])).all()


def test_users_nlpsol_solves_the_inner_problem() -> None:
    """max ω_b at fixed masses, written from scratch, against the package's own search."""
    case = problem()
    quantities = TrueQuantities(case)
    theta = ca.DM([60.0, 60.0])
    y = ca.MX.sym("y", 2)
    q = quantities(ca.vertcat(theta, y))
    options = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.tol": 1e-9,
    }
    solver = ca.nlpsol("user", "ipopt", {"x": y, "f": -q[0] / 400.0, "g": q[1:3]}, options)
    lower, upper = lifted_bounds(case)
    expected = search_inner(scaled_plant(case, (60.0, 60.0)), case.weights, case.inner)
    best = expected.optimum.figures
    start = np.log([0.95 * best.omega_S, 1.1 * best.omega_T])
    found = solver(
        x0=start, lbx=lower[2:], ubx=upper[2:], lbg=-np.inf,
        ubg=np.log([INNER.S_max, INNER.S_low]),
    )  # fmt: skip
    assert solver.stats()["success"]
    assert -400.0 * float(found["f"]) == pytest.approx(expected.bandwidth, rel=1e-7)
