"""Scalar channels of a loop: parts along directions in which plant and controller decouple."""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class LoopChannel:
    """A part of the loop, Uᵀ G V and Vᵀ K U.

    Attributes
    ----------
    name : str
        Its number, or "all".
    outputs, inputs : (p, k), (m, k) array
        U and V.
    plant : ScaledPlant
        Uᵀ G V.
    controller : StateSpace
        Vᵀ K U, SI.
    places : tuple of BreakPoint
        Of several sensors on one actuator.
    """

    name: str
    outputs: Array
    inputs: Array
    plant: ScaledPlant
    controller: StateSpace
    places: tuple[BreakPoint, ...] = ()


def whole_loop(
    plant: ScaledPlant, controller: StateSpace, places: tuple[BreakPoint, ...] = ()
) -> tuple[LoopChannel, ...]:
    """Take the loop as one channel.

    Parameters
    ----------
    plant, controller : ScaledPlant, StateSpace
    places : tuple of BreakPoint
        Of several sensors on one actuator.

    Returns
    -------
    tuple of one LoopChannel
    """
    p, m = plant.C.shape[0], plant.B.shape[1]
    return (LoopChannel("all", np.eye(p), np.eye(m), plant, controller, places),)


def scalar_channels(plant: ScaledPlant, controller: StateSpace) -> tuple[LoopChannel, ...]:
    """The scalar channels of a loop, or the whole loop as one channel.

    Parameters
    ----------
    plant : ScaledPlant
        With its decoupling directions.
    controller : StateSpace
        e in, u out, SI.

    Returns
    -------
    tuple of LoopChannel
        One for each output where plant and controller are diagonal along the directions.
    """
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
    """Take uᵀ G v of a plant.

    Parameters
    ----------
    plant : ScaledPlant
    u, v : (p, k), (m, k) array
        Directions of its outputs and inputs.

    Returns
    -------
    ScaledPlant
    """
    B, C = np.ascontiguousarray(plant.B @ v), np.ascontiguousarray(u.T @ plant.C)
    return replace(plant, B=B, C=C, channels=())


def _diagonal(response: np.ndarray, rounding: float = 1e-8) -> bool:
    """Whether what is off the diagonal is at most this share of the gain."""
    off = response * (1.0 - np.eye(response.shape[1]))
    return bool(np.abs(off).max() <= rounding * np.abs(response).max())
