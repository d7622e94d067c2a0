"""The judge that all back ends share: any controller measured, certified and handed out in SI."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.helpers import (
    HZ,
    OMEGA_LOW,
    PAPER,
    dense_grid,
    flexible_case,
    responses,
    sensitivity,
    sensitivity_gain,
    state_response,
    two_mass,
)

from ccd_casadi.analysis.loop_view import peaks_of
from ccd_casadi.kernels.sensitivity import Code, Column
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.synthesis.closed_loop import measure, recertified_in_si
from ccd_casadi.synthesis.synthesis import Design, Outcome, figures_from_row, synthesise


@pytest.fixture(scope="module", params=["two masses", "flexible"])
def made(request: pytest.FixtureRequest) -> tuple[ScaledPlant, Design]:
    if request.param == "two masses":
        plant, weights = two_mass(60.0, 57.0), PAPER.at(800.0 * HZ, 40.0 * HZ)
    else:
        case = flexible_case(3)
        plant, weights = case.plant, case.weights
    return plant, synthesise(plant, weights, omega_low=OMEGA_LOW)


def test_what_is_measured_in_si_is_what_was_synthesised(made: tuple[ScaledPlant, Design]) -> None:
    plant, design = made
    norm = design.figures.certificate.norm
    found = measure(
        plant, design.controller, design.weights, gamma=norm * (1.0 + 1e-6), omega_low=OMEGA_LOW,
        gamma_opt=3.0, gamma_lower_bound=2.0,
    )  # fmt: skip
    assert found.outcome is Outcome.CERTIFIED
    assert (found.gamma_opt, found.gamma_lower_bound) == (3.0, 2.0)
    for name in ("bandwidth", "sensitivity_peak", "sensitivity_low", "gamma"):
        expected = getattr(design.figures, name)
        assert getattr(found, name) == pytest.approx(expected, rel=1e-6), name
    below = measure(
        plant, design.controller, design.weights, gamma=norm * (1.0 - 1e-6), omega_low=OMEGA_LOW
    )
    assert below.outcome is Outcome.NORM_EXCEEDED


def test_a_design_that_its_numbers_carry_is_handed_out_as_it_is(made) -> None:  # type: ignore[no-untyped-def]
    plant, design = made
    assert recertified_in_si(plant, design, OMEGA_LOW) is design
    read_low = replace(design.figures, gamma=(1.0 - 1e-5) * design.figures.gamma)
    assert recertified_in_si(plant, replace(design, figures=read_low), OMEGA_LOW).figures.certified
    failed = replace(design, figures=replace(design.figures, outcome=Outcome.NORM_EXCEEDED))
    assert recertified_in_si(plant, failed, OMEGA_LOW) is failed


@pytest.mark.parametrize("factor", [1.0 + 1e-5, 1.0 - 1e-5])
def test_a_design_with_other_figures_in_si_is_lost(made, factor: float) -> None:  # type: ignore[no-untyped-def]
    """A bandwidth that is off by more than the conversion may change, either way; or the norm."""
    plant, design = made
    figures = design.figures
    off = replace(figures, bandwidth=factor * figures.bandwidth)
    lost = recertified_in_si(plant, replace(design, figures=off), OMEGA_LOW)
    assert lost.figures.outcome is Outcome.LOST_IN_ROUNDING
    assert not lost.figures.certified
    tighter = replace(figures.certificate, norm_bound=(1.0 - 1e-5) * figures.certificate.norm)
    off = replace(figures, certificate=tighter)
    lost = recertified_in_si(plant, replace(design, figures=off), OMEGA_LOW)
    assert lost.figures.outcome is Outcome.LOST_IN_ROUNDING


def test_a_loop_that_hangs_on_last_digits_is_lost() -> None:
    """A pole at 10⁻²¹ of the largest entry of A_K: doubles do not say on which side it is."""
    plant = two_mass(60.0, 57.0)
    weights = PAPER.at(800.0 * HZ, 40.0 * HZ)
    design = synthesise(plant, weights, omega_low=OMEGA_LOW)
    K = design.controller
    n = len(K.A)
    # two states that no signal meets, with poles at -10¹² and -10⁻⁹ rad/s, turned
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    A = np.zeros((n + 2, n + 2))
    A[:n, :n], A[n:, n:] = K.A, turn @ np.diag([-1e12, -1e-9]) @ turn.T
    none = np.zeros((2, 1))
    hanging = StateSpace(A, np.vstack([K.B, none]), np.hstack([K.C, none.T]), K.D)
    outcomes = set()
    for last in range(24):  # the last digits of a corner, up and down: one in two falls over
        moved = hanging.A.copy()
        moved[n, n] *= 1.0 + (last - 12) * 2.0**-52
        as_given = replace(design, controller=replace_A(hanging, moved))
        outcomes.add(recertified_in_si(plant, as_given, OMEGA_LOW).figures.outcome)
        if Outcome.LOST_IN_ROUNDING in outcomes:
            break
    assert Outcome.LOST_IN_ROUNDING in outcomes


def replace_A(system: StateSpace, A: np.ndarray) -> StateSpace:
    return StateSpace(A, system.B, system.C, system.D)


@pytest.mark.parametrize("name", Code.__members__)
def test_each_code_of_the_kernels_is_one_outcome(name: str) -> None:
    """No two codes and no two columns are the same number."""
    assert len(Code) == len(Code.__members__)
    assert [int(column) for column in Column] == list(range(int(Column.COUNT) + 1))
    row = np.zeros(int(Column.COUNT))
    row[Column.CODE] = Code[name]
    figures = figures_from_row(row, PAPER, 1.0)
    assert figures.outcome is Outcome[name]
    assert figures.certificate.passed == (name in ("CERTIFIED", "NO_BANDWIDTH"))


def test_every_peak_of_s_above_one_is_listed(made: tuple[ScaledPlant, Design]) -> None:
    plant, design = made
    system, K = plant.plant_si(), design.controller
    found = peaks_of(Loop(system, K))
    omega = 2.0 * np.pi * np.array([hz for hz, _ in found])
    gain = np.array([value for _, value in found])
    assert (np.diff(omega) > 0.0).all()
    np.testing.assert_allclose(gain, sensitivity_gain(system, K, omega), rtol=1e-6)
    assert gain.max() == pytest.approx(design.figures.sensitivity_peak, rel=1e-7)
    beside = omega[:, None] * np.array([1.0 - 1e-3, 1.0 + 1e-3])
    assert (sensitivity_gain(system, K, beside.ravel()).reshape(beside.shape) < gain[:, None]).all()
    grid = dense_grid(system, K, per_decade=300)
    grid = grid[(grid > 1e-3 * plant.omega_0) & (grid < 1e3 * plant.omega_0)]
    values = sensitivity_gain(system, K, grid)
    tops = (values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:]) & (values[1:-1] > 1.01)
    for at in grid[1:-1][tops]:
        assert np.abs(omega / at - 1.0).min() < 0.02


def test_responses_are_those_of_the_si_matrices(made: tuple[ScaledPlant, Design]) -> None:
    """With a feedthrough in the controller, which a design of ours has not."""
    plant, design = made
    K = design.controller
    Dk = 0.1 * plant.force * np.ones((K.C.shape[0], K.B.shape[1]))
    K = StateSpace(K.A, K.B, K.C, Dk)
    omega = np.geomspace(1.0, 1e4, 12) * HZ
    g, k, s = responses(plant, K, omega)
    system = plant.plant_si()
    np.testing.assert_allclose(
        g, state_response(system, omega), rtol=1e-7, atol=1e-9 * abs(g).min()
    )
    expected = state_response(K, omega)
    np.testing.assert_allclose(k, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    expected = sensitivity(system, K, omega)
    np.testing.assert_allclose(s, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())
