"""Bandwidth, peak and low-frequency value of S against brute force on the SI responses."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import (
    HZ,
    OMEGA_LOW,
    PAPER,
    assessed,
    dense_grid,
    few,
    first_crossing,
    flexible_case,
    highest,
    random_plant,
    scaled,
    sensitivity_gain,
    state_response,
    two_mass,
)
from scipy.linalg import matrix_balance
from scipy.optimize import brentq

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.synthesis.synthesis import Outcome, synthesise
from ccd_casadi.synthesis.weights import Weights

LEVEL = 1.0 / np.sqrt(2.0)


def schur_error(system: StateSpace, K: StateSpace, omega: float) -> float:
    """What eps ‖A_K‖ in A_K changes of S at jω, relative, to first order: ‖S G‖ ‖C R‖ ‖R B‖ of it.

    Responses are read off the Schur form of the balanced A_K, whose backward error is normwise.
    """
    A, (scale, _) = matrix_balance(K.A, permute=False, separate=True)
    B, C = K.B / scale[:, None], K.C * scale
    R = np.linalg.inv(1j * omega * np.eye(len(A)) - A)
    G = state_response(system, np.array([omega]))[0]
    S = np.linalg.inv(np.eye(len(G)) + G @ (C @ R @ B + K.D))
    parts = (C @ R, R @ B, S @ G)
    change = np.prod([np.linalg.norm(part, 2) for part in parts])
    return float(np.finfo(float).eps * np.linalg.norm(A) * change)


def check_figures(plant: ScaledPlant, weights: Weights, per_decade: int) -> None:
    design = synthesise(plant, weights, omega_low=OMEGA_LOW)
    figures = design.figures
    assert figures.outcome is Outcome.CERTIFIED
    system = plant.plant_si()

    def gain(omega: np.ndarray) -> np.ndarray:
        return sensitivity_gain(system, design.controller, omega)

    grid = dense_grid(system, design.controller, per_decade=per_decade)

    def rounding(omega: float) -> float:
        """In 1,100 draws under two sets of kernels half of this was met, and 3e-7 at most."""
        return 1e-9 + min(schur_error(system, design.controller, omega), 1e-6)

    crossing = first_crossing(gain, grid, LEVEL)
    assert figures.bandwidth == pytest.approx(crossing, rel=rounding(crossing))
    low = float(gain(OMEGA_LOW)[0])
    assert figures.sensitivity_low == pytest.approx(low, rel=rounding(OMEGA_LOW))
    top, at = highest(gain, grid)
    assert figures.sensitivity_peak == pytest.approx(top, rel=rounding(at))
    # its place: the root of the slope, taken from differences of the response
    h = 3e-4  # three times as far, the next terms of flat peaks move it by 1e-6

    def slope(omega: float) -> float:
        up, down, up2, down2 = gain(omega * (1.0 + h * np.array([1.0, -1.0, 2.0, -2.0])))
        return 8.0 * (up - down) - (up2 - down2)

    near = 0.02 * at
    while slope(at - near) * slope(at + near) > 0.0 and near > 1e-6 * at:
        near *= 0.5
    place = brentq(slope, at - near, at + near, xtol=1e-12 * at)
    assert figures.sensitivity_peak_frequency == pytest.approx(place, rel=1e-6)


@few(max_examples=20)
@given(
    st.floats(55.0, 70.0), st.floats(55.0, 70.0), st.floats(1.0, 3.25), st.floats(1.3, 3.0)
)  # fmt: skip
def test_figures_of_the_two_mass_plant(m1: float, m2: float, S: float, T: float) -> None:
    check_figures(two_mass(m1, m2), PAPER.at(10.0**S * HZ, 10.0**T * HZ), 300)


@few(max_examples=8)
@example(1638, 1, 2.625)  # 1.3e-8 in S(jω_low) under Zen's kernels, before A_K was balanced
@example(364, 2, 2.375)  # 1.6e-8 in the peak, likewise
@example(277435, 2, 2.7478841496263806)  # 7.5e-7 in the peak, likewise
@example(44542, 2, 2.951099814318609)  # ill conditioned however scaled: 3e-7
@given(st.integers(0, 10**6), st.integers(1, 2), st.floats(1.0, 3.0))
def test_figures_of_small_plants_with_two_channels(seed: int, rigid: int, S: float) -> None:
    model = random_plant(seed, rigid=rigid, flexible=4, inputs=2, outputs=2)
    weights = Weights(**(vars(PAPER) | {"M_K": 1e6, "omega_S": 10.0**S * HZ}))
    check_figures(scaled(mechanics(model, (0.5, 0.5)), 1e6), weights, 300)


@pytest.mark.parametrize("seed", [0, 3, 6, 22])
def test_figures_of_flexible_plants(seed: int) -> None:
    case = flexible_case(seed)
    check_figures(case.plant, case.weights, 60)


# ---- loops made to measure --------------------------------------------------------------------


def collocated(zeta: float) -> tuple[ScaledPlant, Mechanics]:
    """The two-mass system with a damping ratio of its own, θ without meaning."""
    k, m = 2.0 * 60.0**4 * 2.0, 60.0
    zeros = [np.zeros((0, 2, 2))] * 3 + [np.zeros((0, 2, 1)), np.zeros((0, 1, 2))]
    system = Mechanics(
        m * np.eye(2), np.zeros((2, 2)), k * np.array([[1.0, -1.0], [-1.0, 1.0]]),
        np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]]), zeta, tuple(zeros),
    )  # fmt: skip
    return scale_plant(modal_plant(system, Suspension()), 2e7), system


def lead(gain: float, slow: float, fast: float) -> StateSpace:
    """gain (1 + s/slow)/(1 + s/fast), rad/s."""
    ratio = gain * fast / slow
    one = np.ones((1, 1))
    return StateSpace(-fast * one, one, (gain - ratio) * fast * one, ratio * one)


@pytest.mark.parametrize("zeta", [0.02, 1e-3, 1e-5])
def test_first_of_several_crossings_is_returned(zeta: float) -> None:
    """A stiff loop around a plant with a zero: |S| leaves -3 dB at the zero, returns, and leaves
    for good far above; with ζ = 1e-5 the first excursion is some 1e-5 of a decade wide."""
    plant, _ = collocated(zeta)
    controller = lead(2e9, 600.0 * HZ, 60_000.0 * HZ)
    figures = assessed(plant, controller, PAPER, 1e9)
    assert figures.outcome is Outcome.CERTIFIED
    system = plant.plant_si()

    def gain(omega: np.ndarray) -> np.ndarray:
        return sensitivity_gain(system, controller, omega)

    zero = 147.9 * HZ
    grid = np.unique(
        np.concatenate(
            [np.geomspace(HZ, 1e5 * HZ, 2000), dense_grid(system, per_decade=10), around(plant)]
        )
    )
    above = gain(grid) > LEVEL
    leaves = np.flatnonzero(~above[:-1] & above[1:])
    assert len(leaves) >= 2
    assert grid[leaves[0]] == pytest.approx(zero, rel=0.05)
    assert grid[leaves[-1]] > 3.0 * zero
    assert figures.bandwidth == pytest.approx(first_crossing(gain, grid, LEVEL), rel=1e-8)


def around(plant: ScaledPlant) -> np.ndarray:
    """Frequencies about the plant's transmission zero that a plain grid would step over."""
    A, B, C = plant.A, plant.B, plant.C
    # zeros of C (s - A)⁻¹ B with relative degree two: poles of the projected system
    R = B / np.linalg.norm(B)
    CA = C @ A
    P = np.eye(len(A)) - A @ (R @ np.linalg.inv(CA @ R) @ C) - R @ np.linalg.inv(CA @ R) @ CA
    zeros = np.linalg.eigvals(P @ A @ P)
    zero = zeros[np.argmax(zeros.imag)] * plant.omega_0
    points = zero.imag + np.linspace(-400.0, 400.0, 8001) * abs(zero.real)
    return points[points > 0.5 * zero.imag]


def test_loop_without_bandwidth_says_so() -> None:
    plant, _ = collocated(0.02)
    # below the suspension's own stiffness, 120 kg (2π·0.1 Hz)² = 47 N/m
    figures = assessed(plant, lead(5.0, 600.0 * HZ, 60_000.0 * HZ), PAPER, 1e9)
    assert figures.outcome is Outcome.NO_BANDWIDTH
    assert figures.certificate.passed
    assert not figures.certified
    assert np.isnan(figures.bandwidth)
