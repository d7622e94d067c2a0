"""What a force at the plant's input moves: ‖GS‖∞ in m/N over all frequencies, on every plant.

    GS = (I + G K)⁻¹ G,   compliance = sup over ω of σ_max(GS(jω))

At ω = 0 the rigid bodies stand on their suspension. The largest gain is found without a grid
(`norms`), then followed to its very maximum, where its derivative is that of σ_max at a fixed ω.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.grid import climbed
from ccd_casadi.lti.norms import gains, hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant

WITHIN = 1e-3  # relative: where the maximum is, from where the norm was found


@dataclass(frozen=True)
class Compliance:
    """‖GS‖∞ in m/N, its frequency in rad/s (0: at rest), and the plant that has it."""

    gain: float
    omega: float
    plant: ScaledPlant


def compliance_of(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """‖GS‖∞ with a controller in SI (e in, u out); infinite where the loop is not stable."""
    loop = closed_loop(plant.plant_si(), controller).GS
    gain, omega = hinf_norm(loop)
    if not np.isfinite(gain) or omega <= 0.0:
        return Compliance(gain, omega, plant)
    at, top = climbed(
        lambda w: float(gains(loop, np.array([w]))[0]),
        omega * np.exp(-WITHIN), omega * np.exp(WITHIN),
    )  # fmt: skip
    if top >= gain:
        gain, omega = top, at
    return Compliance(gain, omega, plant)


def compliance_over_family(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """The largest of the plant itself and, where it has a family, of every plant of that."""
    return max((compliance_of(each, controller) for each in plant.members), key=lambda c: c.gain)
