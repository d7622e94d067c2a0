"""Modes of a measured response: found, as uncertain as said, and enough for a robust design."""

import control
import numpy as np
import pytest

import ccd_casadi as ccd
from ccd_casadi.fixed_structure.measured import MeasuredResponse
from ccd_casadi.fixed_structure.modal_fit import ModalFit, fit_modes
from ccd_casadi.support.errors import UserError

HZ = 2.0 * np.pi
LINES = np.geomspace(3.0, 900.0, 300)
SHOWN = ((120.0, 0.012, 0.03), (310.0, 0.02, -0.02))  # Hz, damping, 1/kg
HIDDEN = ((1600.0, 0.02, 0.03),)  # above the band


def true_response(hz: np.ndarray, modes: tuple = SHOWN + HIDDEN) -> np.ndarray:
    """20 kg on a suspension that no fit knows of, and modes."""
    s = 1j * HZ * hz
    own = HZ * 0.4
    G = 1.0 / (20.0 * (s**2 + 0.6 * own * s + own**2))
    for f, zeta, gain in modes:
        G = G + gain / (s**2 + 2.0 * zeta * HZ * f * s + (HZ * f) ** 2)
    return np.asarray(G)


def measured(seed: int, noise: float = 0.01) -> MeasuredResponse:
    parts = np.random.default_rng(seed).normal(size=(2, len(LINES))) / np.sqrt(2.0)
    return MeasuredResponse(
        LINES, true_response(LINES) * (1.0 + noise * (parts[0] + 1j * parts[1]))
    )


def test_the_modes_are_found_and_as_far_off_as_said() -> None:
    """Over twelve draws the errors over their deviations have a root mean square of about one.

    It is 1.003; that of 48 normal numbers scatters by 0.1, s from 600 parts by 3 %.
    """
    errors = []
    for seed in range(12):
        fit = fit_modes(measured(seed))
        n = len(fit.hz)
        for hz, damping, _ in SHOWN:
            i = int(np.abs(fit.hz - hz).argmin())
            errors += [np.log(fit.hz[i] / hz) / fit.deviations[i],
                       np.log(fit.damping[i] / damping) / fit.deviations[n + i]]  # fmt: skip
        assert fit.noise == pytest.approx(0.01 / np.sqrt(2.0), rel=0.1)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.3)


def test_its_system_is_what_was_fitted() -> None:
    fit = fit_modes(measured(0))
    G = fit.system()
    gap = np.abs(G(1j * HZ * LINES) / true_response(LINES) - 1.0)
    assert gap.max() < 0.02  # 0.008, at the end of the band
    assert control.poles(G).real.max() < 0.0


def test_the_covariance_is_that_of_its_own_jacobian() -> None:
    """Against differences of the fitted response by every parameter."""
    fit = fit_modes(measured(0))
    w = 1j * HZ * LINES
    size = np.abs(measured(0).G)
    h = 1e-5
    columns = [
        (fit.system(h * e)(w) - fit.system(-h * e)(w)) / (2.0 * h * size)
        for e in np.eye(len(fit.covariance))
    ]
    J = np.column_stack([np.concatenate([c.real, c.imag]) for c in columns])
    scale = fit.deviations
    information = (J * scale).T @ (J * scale) / fit.noise**2
    # Σ JᵀJ/s² is the identity
    np.testing.assert_allclose(
        fit.covariance / np.outer(scale, scale) @ information, np.eye(len(scale)), atol=1e-4
    )


def mahalanobis(fit: ModalFit, change: np.ndarray) -> float:
    return float(np.sqrt(change @ np.linalg.solve(fit.covariance, change)))


def test_the_set_is_of_plants_of_one_confidence() -> None:
    fit = fit_modes(measured(0))
    narrow, wide = fit.set_of_plants(0.9), fit.set_of_plants(0.999)
    assert len(narrow) == len(wide) == 1 + 2 * len(fit.covariance)
    w = 1j * HZ * LINES
    moved = [np.abs(G(w) / wide[0](w) - 1.0).max() for G in wide[1:]]
    less = [np.abs(G(w) / narrow[0](w) - 1.0).max() for G in narrow[1:]]
    assert max(moved) > max(less) > 0.0
    with pytest.raises(UserError, match="confidence"):
        fit.set_of_plants(1.0)


def test_a_guided_stage_has_no_rigid_body() -> None:
    G = true_response(LINES, SHOWN) - true_response(LINES, ())
    fit = fit_modes(MeasuredResponse(LINES, G))
    np.testing.assert_allclose(fit.hz, [120.0, 310.0], rtol=1e-6)
    np.testing.assert_allclose(fit.damping, [0.012, 0.02], rtol=1e-4)
    assert len(fit.ends) == 2
    assert "2 modes" in fit._repr_html_()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_design_on_its_set_holds_on_the_true_plant(seed: int) -> None:
    bounds = ccd.Bounds(S_max=1.8, S_low=0.1, omega_low=2.0 * HZ, shape=1.1)
    sampling = ccd.Sampling(rate_hz=10e3, delay_us=100.0)
    plants = fit_modes(measured(seed)).set_of_plants()
    made = ccd.synthesise_sections(
        plants[:5], ccd.Structure(lead=1, biquads=0, roll_off=2), bounds, sampling=sampling,
        M_K=2e6, starts=2,
    )  # fmt: skip
    assert made.certified, made.words
    own = HZ * 0.4
    parts = [control.tf([1.0 / 20.0], [1.0, 0.6 * own, own**2])]
    parts += [control.tf([a], [1.0, 2.0 * z * HZ * f, (HZ * f) ** 2]) for f, z, a in SHOWN + HIDDEN]
    true = control.parallel(*(control.ss(part) for part in parts))
    judged = ccd.certify([ccd.plant_from_control(true, 2e6)], made.controller, bounds, sampling)
    assert judged.passed, judged.words
