"""What a force at the plant's input moves: ‖GS‖∞ in m/N over all frequencies, on every plant.

    GS = (I + G K)⁻¹ G,   compliance = sup over ω of σ_max(GS(jω))

At ω = 0 the rigid bodies stand on their suspension. The largest gain is found without a grid
(`norms`), then followed to its very maximum, where its derivative is that of σ_max at a fixed ω.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.synthesis.norms import gains, hinf_norm

WITHIN = 1e-3  # relative: where the maximum is, from where the norm was found


@dataclass(frozen=True)
class Compliance:
    """‖GS‖∞ in m/N, its frequency in rad/s (0: at rest), and the plant that has it."""

    gain: float
    omega: float
    plant: ScaledPlant


def force_to_position(plant: StateSpace, controller: StateSpace) -> StateSpace:
    """GS as a state space, states [x; x_K]: a force beside u in, y out; r = 0, D = 0."""
    G, K = plant, controller
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    B = np.vstack([G.B, np.zeros((len(K.A), G.B.shape[1]))])
    C = np.hstack([G.C, np.zeros((len(G.C), len(K.A)))])
    return StateSpace(A, B, C, np.zeros((len(C), B.shape[1])))


def compliance_of(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """‖GS‖∞ with a controller in SI (e in, u out); infinite where the loop is not stable."""
    loop = force_to_position(plant.plant_si(), controller)
    gain, omega = hinf_norm(loop)
    if not np.isfinite(gain) or omega <= 0.0:
        return Compliance(gain, omega, plant)
    found = minimize_scalar(
        lambda x: -float(gains(loop, np.exp([x]))[0]),
        bounds=(np.log(omega) - WITHIN, np.log(omega) + WITHIN),
        method="bounded",
        options={"xatol": 1e-10},
    )
    if -found.fun >= gain:
        gain, omega = float(-found.fun), float(np.exp(found.x))
    return Compliance(gain, omega, plant)


def compliance_over_family(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """The largest of the plant itself and, where it has a family, of every plant of that."""
    return max((compliance_of(each, controller) for each in plant.members), key=lambda c: c.gain)
