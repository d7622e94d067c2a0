"""Derivatives of the stage's plant against central differences of fourth order."""

from functools import cache

import numpy as np
import pytest

from ccd_casadi.extensions.rib_stage.geometry import COARSE, NAMES, Geometry, MeshOrder, PointMass
from ccd_casadi.extensions.rib_stage.model import RibStage
from ccd_casadi.plants.modal import Suspension, modal_plant

MIDDLE = tuple(1e-3 * np.array([2.0, 5.0, 5.5, 4.0, 12.0, 80.0]))
B = tuple(1e-3 * np.array([1.0, 3.0, 4.2446, 4.0588, 11.917, 74.974]))
MOVED = ((0.12, 0.13), (-0.15, 0.15), (-0.15, -0.15), (0.11, -0.15))
ONE_MASS = Geometry(point_masses=(PointMass(0.1, 0.12, 0.05),))
SPECK = Geometry(point_masses=(PointMass(0.1, 0.12, 1e-9),))

STAGES = {
    "corners": RibStage(order=COARSE),
    "moved": RibStage(order=COARSE, actuators=MOVED, outputs="modal4"),
    "lopsided": RibStage(geometry=ONE_MASS, order=COARSE, sensors=MOVED),
}
TOLERANCE = 1e-5


def along(stage: RibStage, theta: tuple[float, ...], way: np.ndarray, step: float) -> list:
    """d/ds of K, B, Cᵀ at θ (1 + s way), central differences."""
    values = []
    for k in (-2, -1, 1, 2):
        moved = np.array(theta) * (1.0 + k * step * way)
        system = stage.mechanics(moved, derivatives=False)
        values.append((system.K, system.B, system.C.T))
    return [
        (f[0] - 8.0 * f[1] + 8.0 * f[2] - f[3]) / (12.0 * step) for f in zip(*values, strict=True)
    ]


def worst(stage: RibStage, theta: tuple[float, ...], way: np.ndarray, step: float = 2e-3) -> float:
    """Largest gap between slope and difference along `way`, over the size of the mode's row.

    Rounding of K moves the twist's λ by 5e-9 of itself, hence the step.
    """
    system = stage.mechanics(theta)
    _, _, dK, dB, dC = system.derivatives
    exact = [np.tensordot(way * theta, d, 1) for d in (dK, dB, dC.transpose(0, 2, 1))]
    sizes = (np.diag(system.K), np.abs(system.B).max(1), np.abs(system.C).max(0))
    gaps = []
    for size, e, f in zip(sizes, exact, along(stage, theta, way, step), strict=True):
        live = size > 1e-9 * size.max()
        gaps.append(float((np.abs(e - f)[live] / size[live, None]).max()))
    return max(gaps)


@pytest.mark.slow  # one by one: together, along a mixed direction, they are in the suite
@pytest.mark.parametrize("theta", [MIDDLE, B], ids=["middle", "b"])
@pytest.mark.parametrize("index", range(6), ids=NAMES)
def test_slopes_are_differences(theta: tuple[float, ...], index: int) -> None:
    assert worst(STAGES["corners"], theta, np.eye(6)[index]) < TOLERANCE


@pytest.mark.parametrize(
    "name", [pytest.param(s, marks=pytest.mark.slow) if s != "moved" else s for s in STAGES]
)
def test_slopes_along_a_mixed_direction(name: str) -> None:
    stage = STAGES[name]
    assert worst(stage, MIDDLE, np.array([0.7, -0.5, 1.0, 0.6, -0.8, 0.3])) < TOLERANCE
    dM, dD, dK = stage.mechanics(MIDDLE).derivatives[:3]
    assert not dM.any()
    assert not dD.any()
    diagonal = np.einsum("tii->ti", dK)
    np.testing.assert_array_equal(dK, diagonal[:, :, None] * np.eye(dK.shape[1]))


def test_slopes_of_design_b_against_the_facts() -> None:
    """df/dθ of the twist in Hz/mm, from another program."""
    stage = RibStage()
    row, f = next((i, m.frequency) for i, m in enumerate(stage.frequencies(B)) if m.name == "B2")
    slope = stage.mechanics(B).derivatives[2][:, row, row] / (8.0 * np.pi**2 * f) * 1e-3
    np.testing.assert_allclose(slope, [-6.4, 2.1, 16.0, 8.9, 3.0, -0.3], atol=0.15)


@cache
def response_slopes(stage: RibStage, omega: float) -> np.ndarray:
    system = stage.mechanics(MIDDLE)
    _, _, dK, dB, dC = system.derivatives
    R = np.linalg.inv(system.K - omega**2 * system.M)
    return dC @ R @ system.B + system.C @ R @ dB - system.C @ R @ dK @ R @ system.B


@pytest.mark.slow
@pytest.mark.parametrize("omega", [300.0, 1500.0, 6000.0])
def test_double_frequencies_without_symmetry_to_name_them(omega: float) -> None:
    """A speck leaves the pairs double in the whole model: responses move as in sectors."""
    whole = response_slopes(RibStage(geometry=SPECK, order=COARSE), omega)
    parts = response_slopes(RibStage(order=COARSE, truncation="frequency"), omega)
    assert np.abs(whole - parts).max() < 1e-6 * np.abs(parts).max()


def test_the_modal_form_takes_the_double_pairs() -> None:
    """modal_plant turns pairs as it likes; the slopes of its response must not notice."""
    system = RibStage(order=COARSE).mechanics(MIDDLE)
    modal = modal_plant(system, Suspension())
    assert modal.rigid.sum() == 3
    for t in range(6):
        here = system.derivatives[2][t].diagonal()
        turned = modal.modes @ modal.dK[t] @ modal.modes.T
        np.testing.assert_allclose(turned.diagonal()[3:], here[3:], rtol=1e-9)


@pytest.mark.slow
def test_slopes_at_the_shipped_mesh() -> None:
    stage = RibStage(order=MeshOrder())
    for index in range(6):
        assert worst(stage, MIDDLE, np.eye(6)[index]) < TOLERANCE
