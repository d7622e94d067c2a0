"""Exact block-diagonality: found whatever the coordinates, and never seen in the result."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.draws import few
from oracles.helpers import HZ
from scipy.stats import ortho_group

from ccd_casadi.extensions.rib_stage.geometry import COARSE
from ccd_casadi.extensions.rib_stage.model import RibStage
from ccd_casadi.kernels import certified_design as design
from ccd_casadi.plants.modal import ModalPlant, Suspension, modal_plant
from ccd_casadi.plants.scaling import find_channels, scale_plant
from ccd_casadi.synthesis import derivatives
from ccd_casadi.synthesis.derivatives import sensitivities
from ccd_casadi.synthesis.synthesis import Outcome, synthesise
from ccd_casadi.synthesis.weights import Weights

THETA_B = (1e-3, 3e-3, 4.2446e-3, 4.0588e-3, 11.917e-3, 74.974e-3)
WEIGHTS = Weights(
    M_S=2.0, A_S=1e-4, omega_S=HZ * 900.0, c_K=1e4, omega_K=HZ * 100.0, M_K=4.5e4,
    A_l=1.0, A_u=1e-2, omega_T=HZ * 40.0,
)  # fmt: skip


def blocks(seed: int, sizes: tuple[int, ...]) -> ModalPlant:
    """Collocated blocks, a rigid and two flexible modes a signal, hidden by orthogonal U, V."""
    rng = np.random.default_rng(seed)
    p = sum(sizes)
    U, V = (ortho_group.rvs(p, random_state=rng) if p > 1 else np.eye(1) for _ in range(2))
    B, rigid = [], []
    column = 0
    for size in sizes:
        part = np.zeros((3 * size, p))
        part[:, column : column + size] = rng.uniform(0.5, 2.0, (3 * size, size))
        B.append(part)
        column += size
        rigid += size * [True] + 2 * size * [False]
    B = np.vstack(B)
    n = len(B)
    free = np.array(rigid)
    omega = HZ * np.where(free, 0.1, rng.uniform(150.0, 1500.0, n))
    damping = np.where(free, 0.7, 0.01)
    order = rng.permutation(n)
    K, D = np.diag(omega[order] ** 2), np.diag(2.0 * damping[order] * omega[order])
    C, drive = U @ B[order].T, B[order] @ V.T
    none = np.zeros((1, n, n))
    return ModalPlant(
        K=K, D=D, B=drive, C=C, natural=omega[order], rigid=free[order], modes=np.eye(n),
        dM=none, dK=K[None] * rng.uniform(-1.0, 1.0, n), dD=D[None] * rng.uniform(-1.0, 1.0, n),
        dB=drive[None] * rng.uniform(-1.0, 1.0, (n, 1)), dC=none[:, :p, :],
    )  # fmt: skip


@few(max_examples=20)
@given(seed=st.integers(0, 10**6), sizes=st.sampled_from([(1, 1), (2, 1), (1, 1, 1, 1), (2, 2)]))
def test_hidden_blocks_are_found(seed: int, sizes: tuple[int, ...]) -> None:
    plant = blocks(seed, sizes)
    found = find_channels(plant.K, plant.D, plant.B, plant.C)
    assert sorted(c.outputs.shape[1] for c in found) == sorted(sizes)
    assert sorted(i for c in found for i in c.modes) == list(range(len(plant.K)))
    for one in found:
        for other in found:
            if one is not other:
                coupling = one.outputs.T @ plant.C[:, other.modes]
                assert np.abs(coupling).max() < 1e-12


def test_coupled_plants_are_one_channel() -> None:
    plant = blocks(3, (3,))
    assert len(find_channels(plant.K, plant.D, plant.B, plant.C)) == 1
    plant = blocks(3, (1, 1))
    tied = plant.D.copy()
    tied += 1e-3 * np.outer(*2 * [np.sqrt(np.diag(plant.D))])  # damping across the blocks
    assert len(find_channels(plant.K, tied, plant.B, plant.C)) == 1


@pytest.mark.parametrize("seed", range(6))
def test_small_syntheses_give_the_large_one(seed: int) -> None:
    plant = scale_plant(blocks(seed, (1, 2, 1)), WEIGHTS.M_K)
    assert len(plant.channels) == 3
    compare(plant, WEIGHTS)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_block_that_fails_is_how_the_design_ends(which: int, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    plant = scale_plant(blocks(1, (1, 2, 1)), WEIGHTS.M_K)
    made, whole = [], design.synthesise

    def failing(*arguments):  # type: ignore[no-untyped-def]
        found = whole(*arguments)
        balanced = arguments[8]
        if len(made) == which or balanced:  # nor does the second attempt help
            found[0][design.Column.CODE] = design.Code.GAMMA_NOT_CONVERGED
        made.append(found)
        return found

    monkeypatch.setattr(design, "synthesise", failing)
    figures = synthesise(plant, WEIGHTS, omega_low=HZ).figures
    assert len(made) == 4
    assert figures.outcome is Outcome.GAMMA_NOT_CONVERGED
    assert figures.gamma_opt == made[which][0][design.Column.GAMMA_OPT]


def test_gradients_that_the_blocks_do_not_give_are_the_whole_plants(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Rounding may put the blocks' γ_opt where the whole plant has none; a plant has one try."""
    plant = scale_plant(blocks(1, (1, 2, 1)), WEIGHTS.M_K)
    alone = replace(plant, channels=())
    expected = sensitivities(alone, WEIGHTS, omega_low=HZ)
    tries, whole = [], derivatives.figure_gradients

    def failing_once(*arguments):  # type: ignore[no-untyped-def]
        tries.append(None)
        *found, to_gamma, ok = whole(*arguments)
        if len(tries) > 1:
            return *found, to_gamma, ok
        return *(np.full_like(part, np.nan) for part in found), to_gamma, False

    monkeypatch.setattr(derivatives, "figure_gradients", failing_once)
    found = sensitivities(plant, WEIGHTS, omega_low=HZ)
    assert len(tries) == 2
    np.testing.assert_array_equal(found.to_theta, expected.to_theta)
    tries.clear()
    found = sensitivities(alone, WEIGHTS, omega_low=HZ)
    assert len(tries) == 1
    assert found.figures.certificate.passed
    assert np.isnan(found.to_theta).all()


@pytest.mark.parametrize("omega", [(15.0, 900.0), (300.0, 60.0), (1800.0, 25.0)])
def test_the_stage_is_z_tip_tilt_and_twist(omega: tuple[float, float]) -> None:
    system = RibStage(order=COARSE).mechanics(THETA_B)
    plant = scale_plant(modal_plant(system, Suspension()), WEIGHTS.M_K)
    assert sorted(len(c.A) for c in plant.channels) == [4, 6, 6, 6]  # B1, A2 are not seen
    directions = np.array([c.outputs[:, 0] for c in plant.channels])
    np.testing.assert_allclose(np.abs(directions), 0.5, atol=1e-12)
    compare(plant, WEIGHTS.at(HZ * omega[0], HZ * omega[1]))


def compare(plant, weights: Weights) -> None:  # type: ignore[no-untyped-def]
    small = sensitivities(plant, weights, omega_low=HZ)
    large = sensitivities(replace(plant, channels=()), weights, omega_low=HZ)
    assert small.figures.certified
    assert large.figures.certified
    assert small.figures.limited_by_bound == large.figures.limited_by_bound
    np.testing.assert_allclose(small.values, large.values, rtol=1e-9)
    scale = np.abs(large.to_theta).max(axis=1, keepdims=True)
    assert np.abs((small.to_theta - large.to_theta) / scale).max() < 1e-7
