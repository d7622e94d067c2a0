"""The search for γ_opt: guesses in sweeps, the Riccati level, the step to its root."""

import numpy as np
import pytest
from oracles.helpers import HZ, OMEGA_LOW, PAPER, flexible_case, two_mass
from oracles.kernel_draws import WEIGHTS

from ccd_casadi.kernels import certified_design as design
from ccd_casadi.kernels import gamma, riccati
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.kernels.riccati_synthesis import RiccatiSynthesisOptions
from ccd_casadi.kernels.riccati_synthesis import synthesise as kernel
from ccd_casadi.synthesis.synthesis import synthesise

NOISE = riccati.RiccatiOptions.noise


def test_the_guess_is_exact_where_gamma_is_a_product_of_powers() -> None:
    """ln γ = a ln ω_S + b ln ω_T: every point but the first and those beside it is foretold."""
    x, y = [0.0, 0.7, 1.1, 2.0], [0.3, 0.9, 1.0, 1.6]
    found = np.full((4, 4), np.nan)
    for j in range(4):
        side = 1 if j % 2 == 0 else -1
        for step in range(4):
            i = step if side == 1 else 3 - step
            guess = design._guess(found, x, y, i, j, side, step)
            found[i, j] = 0.8 * x[i] - 0.5 * y[j]
            if (step, j) == (0, 0):
                assert guess == 0.0
            elif (step, j) == (1, 0):
                assert guess == pytest.approx(np.exp(found[0, 0]))
            elif (step, j) != (0, 1):
                assert guess == pytest.approx(np.exp(found[i, j]), rel=1e-12)


def test_a_guess_from_what_was_not_certified_is_the_last_one_or_none() -> None:
    x = y = [0.0, 1.0, 2.0]
    found = np.full((3, 3), np.nan)
    found[1, 0] = 0.4
    assert design._guess(found, x, y, 2, 0, 1, 2) == pytest.approx(np.exp(0.4))
    found[1, 0] = np.nan
    assert design._guess(found, x, y, 2, 0, 1, 2) == 0.0


def test_a_sweep_needs_fewer_schur_forms_than_its_points_alone() -> None:
    plant = two_mass(58.0, 63.0)
    omega_S = np.geomspace(10, 2000, 6) * HZ / plant.omega_0
    omega_T = np.geomspace(20, 1000, 5) * HZ / plant.omega_0
    w = PAPER.scale(plant.omega_0)
    numbers = (plant.grid, plant.gain, 1.02, OMEGA_LOW / plant.omega_0)
    rows = design.sweep(plant.A, plant.B, plant.C, w, omega_S, omega_T, *numbers)
    alone = 0.0
    for i, S in enumerate(omega_S):
        for j, T in enumerate(omega_T):
            w[2], w[7] = S, T
            row = design.design(plant.A, plant.B, plant.C, w, *numbers, 0.0)[0]
            alone += row[design.Column.SCHUR_FORMS]
            assert rows[i, j, design.Column.GAMMA_OPT] == pytest.approx(
                row[design.Column.GAMMA_OPT], rel=1e-9
            )
    assert rows[:, :, design.Column.SCHUR_FORMS].sum() < 0.7 * alone


def test_the_search_for_gamma_takes_few_schur_forms() -> None:
    """Newton's method in 1/t from afar, and the step of order four from a guess 1 % off."""
    plant = two_mass(58.0, 63.0)
    numbers = (plant.grid, plant.gain, 1.02, OMEGA_LOW / plant.omega_0)
    cold, near = [], []
    for S in np.geomspace(10, 2000, 8) * HZ:
        for T in np.geomspace(20, 1000, 5) * HZ:
            arguments = (plant.A, plant.B, plant.C, PAPER.at(S, T).scale(plant.omega_0), *numbers)
            row = design.design(*arguments, 0.0)[0]
            cold.append(row[design.Column.SCHUR_FORMS])
            for factor in (0.99, 1.01):
                again = design.design(*arguments, factor * row[design.Column.GAMMA_OPT])[0]
                near.append(again[design.Column.SCHUR_FORMS])
    assert np.mean(cold) < 4.0
    assert max(cold) <= 8
    assert np.mean(near) < 2.2


@pytest.fixture(scope="module")
def level():  # type: ignore[no-untyped-def]
    """`riccati_level` of a design as a function of t, t at γ_opt, and what `root_nearby` takes."""
    plant = two_mass(58.0, 63.0)
    _, B1, _, C1, _, d1, _ = gp = generalized_plant(
        plant.A, plant.B, plant.C, WEIGHTS.scale(plant.omega_0)
    )
    H0 = riccati.lqr_hamiltonian(gp)
    gamma = synthesise(plant, WEIGHTS, omega_low=OMEGA_LOW).figures.gamma_opt

    def at(t: float):  # type: ignore[no-untyped-def]
        return riccati.riccati_level(H0, B1, C1, d1, t, NOISE)

    return at, gamma**2 - d1**2, (B1, C1, d1)


@pytest.mark.parametrize("factor", [0.9, 0.999, 1.01, 2.0, 10.0])
def test_the_slope_of_the_riccati_level_is_that_of_its_differences(level, factor: float) -> None:
    """Also where X is no longer positive; zero at γ_opt, increasing in t."""
    at, top, _ = level
    t = factor * top
    f, slope, ok, _ = at(t)
    assert ok
    assert (f > 0.0) == (factor > 1.0)
    h = 1e-4 * t
    found = (8.0 * (at(t + h)[0] - at(t - h)[0]) - at(t + 2 * h)[0] + at(t - 2 * h)[0]) / (12.0 * h)
    assert slope > 0.0
    assert slope == pytest.approx(found, rel=1e-6)


def test_the_step_to_the_root_is_of_order_four(level) -> None:  # type: ignore[no-untyped-def]
    """Half as far away the error is a sixteenth at last, and the estimate of it is no smaller."""
    at, top, parts = level
    errors, estimates = [], []
    for off in (0.08, 0.04, 0.02):
        t = (1.0 + off) * top
        f, slope, _, frame = at(t)
        step, estimate = riccati.root_nearby(*parts, frame, f / (slope * t * t), NOISE)
        errors.append(abs(t / (1.0 + step * t) - top) / top)
        estimates.append(estimate * top)
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert (ratios > 11.0).all()  # of order three they would tend to eight
    assert (np.array(estimates) > errors).all()
    assert (np.array(estimates) < 100.0 * np.array(errors)).all()


@pytest.mark.parametrize("seed", [0, 15, 27])
def test_the_error_of_the_step_to_the_root_is_within_its_estimate(seed: int) -> None:
    """From either side, where the root is well conditioned."""
    case = flexible_case(seed)
    plant, w = case.plant, case.weights.scale(case.plant.omega_0)
    gp = generalized_plant(plant.A, plant.B, plant.C, w)
    H0 = riccati.lqr_hamiltonian(gp)
    gamma = synthesise(plant, case.weights, omega_low=OMEGA_LOW).figures.gamma_opt
    top = gamma**2 - gp[5] ** 2
    for off in (-0.1, -0.03, 0.03, 0.1):
        t = (1.0 + off) * top
        f, slope, _, frame = riccati.riccati_level(H0, gp[1], gp[3], gp[5], t, NOISE)
        step, estimate = riccati.root_nearby(gp[1], gp[3], gp[5], frame, f / (slope * t * t), NOISE)
        assert abs(t / (1.0 + step * t) - top) < top * estimate * top


@pytest.mark.parametrize("seed", [0, 1, 4, 15, 27])
def test_rounding_moves_gamma_as_far_as_is_reported(seed: int) -> None:
    """The spread of the root over random changes of H, against what `rounding_error` foretells."""
    case = flexible_case(seed)
    plant, w = case.plant, case.weights.scale(case.plant.omega_0)
    _, B1, _, C1, _, d1, _ = gp = generalized_plant(plant.A, plant.B, plant.C, w)
    H0 = riccati.lqr_hamiltonian(gp)
    level = synthesise(plant, case.weights, omega_low=OMEGA_LOW).figures.gamma_opt
    t = level**2 - d1**2

    def root(H: np.ndarray) -> tuple[float, float]:
        f, slope, ok, frame = riccati.riccati_level(H, B1, C1, d1, t, NOISE)
        assert ok
        step = riccati.root_nearby(B1, C1, d1, frame, f / (slope * t * t), NOISE)[0]
        return np.sqrt(t / (1.0 + step * t) + d1**2), gamma.rounding_error(frame, t, d1)

    reported, rng = root(H0)[1], np.random.default_rng(seed)
    size = 1e-7 * gamma.BACKWARD / reported  # γ_opt is to move by 1e-7 of itself
    moved = []
    for _ in range(60):
        change = rng.standard_normal(H0.shape)
        change *= size * np.linalg.norm(H0) / np.linalg.norm(change)
        moved.append(root(H0 + change)[0] / level - 1.0)
    # by the median: of 300 changes one lost the subspace, whichever rounding chooses
    spread = 1.4826 * np.median(np.abs(moved))
    assert spread == pytest.approx(reported * size / gamma.BACKWARD, rel=0.4)


@pytest.mark.parametrize("seed", [81, 45])
def test_gamma_that_rounding_would_spoil_is_found_in_balanced_coordinates(seed: int) -> None:
    """Where its own coordinates leave too much, what is handed out is better, and says so."""
    plant = flexible_case(seed).plant
    w = PAPER.at(0.1 * plant.omega_0, 10.0**-0.5 * plant.omega_0).scale(plant.omega_0)
    gp = generalized_plant(plant.A, plant.B, plant.C, w)
    H0 = riccati.lqr_hamiltonian(gp)
    data = (plant.A, plant.B, plant.C, w, plant.grid, plant.gain, 1.02)
    row = kernel(*data, 0.0, False)[0]
    bound, tolerance = row[design.Column.GAMMA_LOWER_BOUND], 1e-11
    own = gamma.optimal_gamma(H0, gp[1], gp[3], gp[5], bound, 0.0, tolerance, NOISE)
    assert own[3]
    assert own[4] > RiccatiSynthesisOptions().error_accepted
    assert row[design.Column.GAMMA_ERROR] < 0.1 * own[4]
    assert row[design.Column.GAMMA_OPT] == pytest.approx(own[0], rel=own[4])
    for guess in (0.98, 1.01, 1.03):  # other levels on the way, other rounding
        again = kernel(*data, guess * own[0], False)[0]
        reported = row[design.Column.GAMMA_ERROR] + again[design.Column.GAMMA_ERROR]
        assert again[design.Column.GAMMA_OPT] == pytest.approx(
            row[design.Column.GAMMA_OPT], rel=reported
        )
