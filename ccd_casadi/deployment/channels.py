"""The scalar loops that a controller is made of, where plant and controller both fall apart.

Orthogonal directions U of the outputs and V of the inputs that make Uᵀ G V diagonal are known from
the plant (see `ccd_casadi.channels`). A controller that is diagonal in them as well, Vᵀ K U, is
reduced, discretised and read channel by channel. σ_max(S) of the whole is the largest of the
channels', because U is orthogonal. Anything else is one channel: the plant itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

DIAGONAL = 1e-8  # share of the gain that may lie off the diagonal and count as rounding


@dataclass(frozen=True)
class LoopChannel:
    """Uᵀ G V and Vᵀ K U, controller in SI; U = `outputs` (p, k), V = `inputs` (m, k)."""

    name: str
    outputs: Array
    inputs: Array
    plant: ScaledPlant
    controller: StateSpace


def whole_loop(plant: ScaledPlant, controller: StateSpace) -> tuple[LoopChannel, ...]:
    """The loop as one channel."""
    p, m = plant.C.shape[0], plant.B.shape[1]
    return (LoopChannel("all", np.eye(p), np.eye(m), plant, controller),)


def scalar_channels(plant: ScaledPlant, controller: StateSpace) -> tuple[LoopChannel, ...]:
    """The scalar channels of the loop, or the whole loop as one channel."""
    p, m = plant.C.shape[0], plant.B.shape[1]
    U = np.hstack([c.outputs for c in plant.channels] or [np.eye(p)])
    V = np.hstack([c.inputs for c in plant.channels] or [np.eye(m)])
    if not (U.shape == (p, p) and V.shape == (m, m) and p == m > 1):
        return whole_loop(plant, controller)
    omega = plant.grid * plant.omega_0
    G, K = plant.plant_si().response(omega), controller.response(omega)
    if not (_diagonal(U.T @ G @ V) and _diagonal(V.T @ K @ U)):
        return whole_loop(plant, controller)
    found = []
    for i in range(p):
        u, v = U[:, [i]], V[:, [i]]
        part = StateSpace(
            controller.A, controller.B @ u, v.T @ controller.C, v.T @ controller.D @ u
        )
        found.append(LoopChannel(str(i + 1), u, v, along_directions(plant, u, v), part))
    return tuple(found)


def along_directions(plant: ScaledPlant, u: Array, v: Array) -> ScaledPlant:
    """uᵀ G v, of directions u of its outputs and v of its inputs."""
    B, C = np.ascontiguousarray(plant.B @ v), np.ascontiguousarray(u.T @ plant.C)
    return replace(plant, B=B, C=C, channels=())


def _diagonal(response: np.ndarray) -> bool:
    off = response * (1.0 - np.eye(response.shape[1]))
    return bool(np.abs(off).max() <= DIAGONAL * np.abs(response).max())


def assemble(channels: Sequence[LoopChannel], controllers: Sequence[StateSpace]) -> StateSpace:
    """K = Σ V_i K_i U_iᵀ, its states one channel after the other."""
    pairs = list(zip(channels, controllers, strict=True))
    return StateSpace(
        block_diag(*(K.A for _, K in pairs)),
        np.vstack([K.B @ c.outputs.T for c, K in pairs]),
        np.hstack([c.inputs @ K.C for c, K in pairs]),
        np.sum([c.inputs @ K.D @ c.outputs.T for c, K in pairs], axis=0),
    )
