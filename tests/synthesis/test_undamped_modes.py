"""Mixed sensitivity of undamped modes: synthesised with less damping, judged without, by others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.hard_plants import close, drawn_weights, far_from_sb10ad
from oracles.helpers import few

from ccd_casadi.extensions.cross_check.backends import balance, mixed_sensitivity
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop, strictly_proper
from ccd_casadi.plants.modal import FREE, Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant, scale_state_space
from ccd_casadi.synthesis.synthesis import Design, synthesise


def undamped(seed: int) -> Mechanics:
    """A chain of masses without damping, held or free; one channel, or two on its ends."""
    rng = np.random.default_rng(seed)
    n, channels = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    joints = np.diff(np.eye(n), axis=0)
    K = joints.T @ np.diag(10.0 ** rng.uniform(-1.0, 1.0, n - 1)) @ joints
    K[0, 0] += rng.integers(2) * 10.0 ** rng.uniform(-1.0, 0.5)
    B = np.eye(n)[:, [0, -1][:channels]]
    C = B.T if channels == 2 or rng.random() < 0.5 else np.eye(n)[[-1]]
    none = tuple(np.zeros((0, *part.shape)) for part in (K, K, K, B, C))
    return Mechanics(np.diag(rng.uniform(0.5, 2.0, n)), 0.0 * K, K, B, C, None, none)  # type: ignore[arg-type]


def as_matrices(system: Mechanics, lost: float = 0.0) -> StateSpace:
    """[q; q̇] by NumPy alone, with the damping matrix of what its modes lose."""
    root = np.sqrt(np.diag(system.M))
    lam, V = np.linalg.eigh(system.K / root[:, None] / root)
    D = -2.0 * lost * (V * np.sqrt(np.maximum(lam, 0.0))) @ V.T * root[:, None] * root
    n, over = len(root), 1.0 / np.diag(system.M)[:, None]
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-over * system.K, -over * D]])
    B, C = np.vstack([0.0 * system.B, over * system.B]), np.hstack([system.C, 0.0 * system.C])
    return strictly_proper(A, B, C)


def synthesised(system: Mechanics, seed: int, lost: float) -> tuple[ScaledPlant, Design]:
    def scaled(off: Perturbation, held: Suspension = FREE) -> ScaledPlant:
        return scale_plant(modal_plant(system, held, off), 1.0)

    nominal = scaled(Perturbation())
    plant = replace(nominal, family=(scaled(Perturbation(lost=lost), Suspension(1e-3)),))
    w0 = plant.omega_0
    weights = drawn_weights(np.random.default_rng(seed), w0, bool(seed % 3 == 0))
    return plant, synthesise(plant, weights, omega_low=1e-2 * w0)


def judged(seed: int, lost: float = 1e-3) -> float:
    """The distance of γ_opt from SB10AD's on the plant with less damping; K on the plant itself."""
    system = undamped(seed)
    plant, made = synthesised(system, seed, lost)
    figures = made.figures
    if figures.gamma_opt > 1e2:  # a mode that the loop hardly reaches
        return np.nan
    assert figures.certificate.passed, figures.outcome
    G = as_matrices(system)
    assert np.linalg.eigvals(closed_loop(G, made.controller).A).real.max() < 0.0
    own = scale_state_space(G, 1.0)
    K, w0 = made.controller, own.omega_0
    whole = close(balance(mixed_sensitivity(own, made.weights)),
                  StateSpace(K.A / w0, K.B / w0, K.C, K.D))  # fmt: skip
    assert hinf_norm(whole)[0] <= figures.certificate.norm_bound * (1.0 + 1e-6)
    if plant.free or made.weights.disturbance:  # SB10AD has no suspension, and no disturbance
        return np.nan
    lossy = scale_state_space(as_matrices(system, lost), 1.0)
    return far_from_sb10ad(plant.design_plant, lossy, made.weights)


@few(max_examples=6)
@given(st.integers(0, 29))
def test_certified_on_the_undamped_plant_with_the_optimum_of_sb10ad(seed: int) -> None:
    assert not judged(seed) > 1e-6


@few(max_examples=6)
@given(st.integers(0, 10**6))
def test_figures_are_the_limit_of_ever_less(seed: int) -> None:
    system = undamped(seed)
    made = [synthesised(system, seed, lost)[1].figures for lost in (1e-3, 1e-4, 1e-5)]
    if made[0].gamma_opt > 10.0:
        return
    assert all(one.certified for one in made)
    first, second, last = (one.gamma_opt for one in made)
    assert abs(second - last) < 0.3 * abs(first - last) + 1e-6 * last


@pytest.mark.slow
def test_thirty_plants() -> None:
    found = [judged(seed) for seed in range(30)]
    assert np.nanmax(found) < 1e-6
    assert np.isfinite(found).sum() > 5
