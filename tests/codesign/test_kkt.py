"""The KKT certificate of the true problem: small at the optimum, large elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import HZ, few, problem

from ccd_casadi.codesign.optimality import TrueDesign, kkt_certificate
from ccd_casadi.codesign.outer_problem import OuterSolution, outer_program, solve_program
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.optim.kkt import (
    FirstOrder,
    KktCertificate,
    KktOptions,
    active_set,
    hessian_products,
)


def point(m1: float, m2: float, S_hz: float, T_hz: float) -> np.ndarray:
    return np.array([m1, m2, np.log(S_hz * HZ), np.log(T_hz * HZ)])


START = point(57.0, 56.5, 1700.0, 30.0)


def solved(case: CoDesignProblem, start: np.ndarray) -> tuple[OuterSolution, TrueQuantities]:
    quantities = TrueQuantities(case)
    program = replace(outer_program(case, quantities), exact_hessian=False)
    return solve_program(program, start), quantities


def certified(case: CoDesignProblem, quantities: TrueQuantities, x) -> KktCertificate:
    return kkt_certificate(TrueDesign(quantities, x), second=True)


def test_optimum_of_the_true_problem_is_certified() -> None:
    case = problem()
    solution, quantities = solved(case, START)
    x = solution.best.x
    certificate = certified(case, quantities, x)
    assert solution.best.objective == pytest.approx(-438.756, abs=1e-3)
    np.testing.assert_allclose(x[:2], 55.0, atol=1e-6)
    assert certificate.stationarity < 1e-6
    assert certificate.primal < 1e-8
    assert certificate.complementarity < 1e-6
    assert set(certificate.active) == {"S_max", "m1 lower", "m2 lower", "omega_S upper"}
    assert all(value > 0.0 for value in certificate.multipliers.values())
    assert certificate.second_order == np.inf  # a vertex: nothing is left to move


MODEL = """
from ccd_casadi.plants.registry import two_mass

def model(theta, least, zeta=0.01):
    m1, m2 = theta["m1"], theta["m2"]
    cost = (m1 - 61) ** 2 + 2 * (m2 - 63) ** 2
    return two_mass(theta, zeta) | {
        "hardware_cost": cost, "constraints": {"least mass": least - m1 - m2}
    }
"""


@pytest.mark.parametrize(
    ("least", "start", "active"),
    [
        (100.0, (61.0, 63.0, 1700.0, 60.0), {"S_max", "omega_T lower"}),
        (124.5, (62.0, 62.0, 600.0, 60.0), {"S_max", "omega_T lower", "least mass"}),
    ],
)
def test_optimum_inside_the_box_has_a_positive_reduced_hessian(
    tmp_path, least, start, active
) -> None:
    """A hardware cost with a minimum of its own, with and without λ(θ) <= 0 in force."""
    file = tmp_path / "plant.py"
    file.write_text(MODEL)
    source = PlantSource(None, str(file), "model", (("least", least),))
    case = problem(source=source, w1=10.0)
    solution, quantities = solved(case, point(*start))
    certificate = certified(case, quantities, solution.best.x)
    assert certificate.stationarity < 1e-6
    assert certificate.primal < 1e-8
    assert certificate.complementarity < 1e-6
    assert set(certificate.active) == active
    assert certificate.second_order is not None
    assert 0.0 < certificate.second_order < np.inf


@few(max_examples=8)
@given(st.floats(56.0, 69.0), st.floats(56.0, 69.0), st.floats(2.0, 3.2), st.floats(1.5, 2.9))
def test_points_that_are_no_optimum_are_not_certified(m1, m2, S, T) -> None:
    case = problem()
    quantities = TrueQuantities(case)
    x = point(m1, m2, 10.0**S, 10.0**T)
    assert certified(case, quantities, x).stationarity > 1e-2


@pytest.mark.parametrize("change", [1e-3, 1e-2])
def test_residuals_grow_with_the_distance_from_the_optimum(change: float) -> None:
    case = problem()
    solution, quantities = solved(case, START)
    lower = solution.best.x.copy()
    lower[3] -= change  # towards a smaller peak: feasible, but not optimal any more
    inside = certified(case, quantities, lower)
    assert inside.stationarity > 1e-2
    upper = solution.best.x.copy()
    upper[3] += change
    outside = certified(case, quantities, upper)
    assert max(inside.primal, outside.primal) == pytest.approx(
        abs(change * quantities.jacobian_at(solution.best.x)[1, 3]), rel=0.1
    )


@few(max_examples=60)
@given(st.tuples(*3 * [st.sampled_from([0.0, 3e-7, 5e-5, 0.5, 1.0])]), st.integers(0))
def test_curvature_beside_a_bound_is_along_the_direction_itself(z: tuple, seed: int) -> None:
    """Of a quadratic function differences are exact, of whatever length."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    H, d = root @ root.T, np.linalg.qr(random.normal(size=(3, 1)))[0]

    def gradients(points: np.ndarray) -> list[np.ndarray]:
        np.testing.assert_array_equal(points, np.clip(points, 0.0, 1.0))
        return [H @ point for point in points]

    found = hessian_products(gradients, np.array(z), d)
    if found is not None:  # measured: 3e-8
        np.testing.assert_allclose(found, H @ d, atol=1e-6 * np.abs(H).max())
    bounded = sum(value in (0.0, 3e-7, 1.0) for value in z)
    assert found is not None or bounded > 1  # one bound leaves the other side


def test_directions_along_a_bound_that_rounding_lets_off_it_have_both_sides() -> None:
    d = np.array([[1e-17], [1.0]])
    seen: list[np.ndarray] = []
    hessian_products(lambda points: seen.extend(points) or list(points), np.array([0.0, 0.5]), d)
    assert np.ptp([point[1] for point in seen]) == pytest.approx(2.0 * KktOptions.step)


def test_a_constraint_that_is_not_known_is_not_met() -> None:
    g, one = np.array([np.nan, -1.0]), np.ones(2)
    first = FirstOrder(one, g, np.ones((2, 2)), one, ("a", "b"))
    assert np.isnan(active_set(np.array([0.5, 0.5]), first, ("x", "y")).violation)
