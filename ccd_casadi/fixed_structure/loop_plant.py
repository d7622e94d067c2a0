"""The plants of a set as their loops see them: in common units, in w and in their eigenvectors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.hold import Sampling, in_w, sampled
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

FAITHFUL = 1e-7  # relative error of the modal response, above which a plant has no such form


@dataclass(frozen=True)
class LoopPlant:
    """One plant as the loop sees it.

    (A, B, C, D) in w. `poles` of the continuous plant, with `drive` = V⁻¹B (n, m) and `reading` =
    CV (p, n) in its eigenvectors; `dA` = V⁻¹ ∂A V, `dB` = V⁻¹ ∂B, `dC` = ∂C V, leading axis θ.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    poles: np.ndarray
    drive: np.ndarray
    reading: np.ndarray
    dA: np.ndarray
    dB: np.ndarray
    dC: np.ndarray


def loop_plants(
    plants: Sequence[ScaledPlant], sampling: Sampling | None
) -> tuple[list[LoopPlant], tuple[float, float, float | None, float]]:
    """Plants of any number of inputs and outputs in the units of the first: ω₀, force, T and τ.

    Raises PlantError for a plant that is not stable or not diagonalisable.
    """
    if not plants:
        raise PlantError("there is no plant in the set; give at least one")
    omega_0, force = plants[0].omega_0, plants[0].force
    period = None if sampling is None else sampling.period * omega_0
    delay = 0.0 if sampling is None else sampling.delay * omega_0
    found = [
        _loop_plant(plant, number, omega_0, force, period, delay)
        for number, plant in enumerate(plants, 1)
    ]
    return found, (omega_0, force, period, delay)


def padded_modes(found: Sequence[LoopPlant]) -> tuple[np.ndarray, np.ndarray]:
    """Poles (P, n) and residues (P, n, p, m), shorter plants with residues of zero."""
    most = max(len(plant.poles) for plant in found)
    first = found[0]
    poles = np.full((len(found), most), -1.0, complex)
    residues = np.zeros((*poles.shape, len(first.reading), first.drive.shape[1]), complex)
    for i, loop in enumerate(found):
        poles[i, : len(loop.poles)] = loop.poles
        residues[i, : len(loop.poles)] = np.einsum("pn,nm->npm", loop.reading, loop.drive)
    return poles, residues


def padded_states(found: Sequence[LoopPlant]) -> tuple[Array, Array, Array, Array]:
    """(A, B, C, D) in w of all plants, shorter ones with stable states that do nothing."""
    states = max(len(plant.A) for plant in found)
    p, m = found[0].D.shape
    A = np.tile(-np.eye(states), (len(found), 1, 1))
    B, C = np.zeros((len(found), states, m)), np.zeros((len(found), p, states))
    for i, loop in enumerate(found):
        n = len(loop.A)
        A[i, :n, :n], B[i, :n], C[i, :, :n] = loop.A, loop.B, loop.C
    return A, B, C, np.array([plant.D for plant in found])


def _loop_plant(
    plant: ScaledPlant,
    number: int,
    omega_0: float,
    force: float,
    period: float | None,
    delay: float,
) -> LoopPlant:
    ratio, drive = plant.omega_0 / omega_0, plant.omega_0 / omega_0 * force / plant.force
    A, B, C = ratio * plant.A, drive * plant.B, plant.C
    poles, V = np.linalg.eig(A)
    if not (poles.real < 0.0).all():
        words = "is not stable; a suspension has to hold its rigid-body modes"
        raise PlantError(f"plant {number} {words}")
    W = np.linalg.inv(V)
    b, c = W @ B, C @ V
    at = 1j * np.geomspace(1e-2, 1e2, 7)
    direct = StateSpace(A, B, C, np.zeros((len(C), B.shape[1]))).at(at)
    modal = np.einsum("pn,kn,nm->kpm", c, 1.0 / (at[:, None] - poles), b)
    if np.abs(modal - direct).max() > FAITHFUL * np.abs(direct).max():
        words = "has poles that coincide and are coupled; move a damping ratio away from 1"
        raise PlantError(f"plant {number} {words}")
    state = (A, B, C, np.zeros((len(C), B.shape[1])))
    if period is not None:
        w = in_w(sampled(StateSpace(*state), period, delay))
        state = (w.A, w.B, w.C, w.D)
    dA = W @ (ratio * plant.dA) @ V
    return LoopPlant(*state, poles, b, c, dA, W @ (drive * plant.dB), plant.dC @ V)


def finite_zeros(plant: LoopPlant) -> np.ndarray:
    """Finite eigenvalues of the system matrix's pencil in w; none where it is not square."""
    return StateSpace(plant.A, plant.B, plant.C, plant.D).zeros()
