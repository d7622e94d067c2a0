"""The problems that every benchmark times: the paper's two masses, and random 3 x 3 stages.

Weights are the paper's (its section 5, case A); plants go through the project's own scaling.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, build_plant, mechanics
from ccd_casadi.plants.registry import two_mass
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.synthesis.weights import Weights

HZ = 2.0 * np.pi
OMEGA_LOW = 1.0 * HZ
BACKOFF = 1.02


@dataclass(frozen=True)
class Problem:
    """A scaled plant with the weights of one synthesis."""

    name: str
    plant: ScaledPlant
    weights: Weights


def weights(omega_S: float, omega_T: float, M_K: float = 2e7) -> Weights:
    """The paper's weights at break frequencies in Hz."""
    return Weights(
        M_S=2.0,
        A_S=1e-4,
        omega_S=omega_S * HZ,
        c_K=1e4,
        omega_K=100.0 * HZ,
        M_K=M_K,
        A_l=1.0,
        A_u=1e-2,
        omega_T=omega_T * HZ,
    )


def two_masses(m1: float = 60.0, m2: float = 60.0, M_K: float = 2e7) -> ScaledPlant:
    """The paper's case study 1 at masses in kg; 4 states, N = 7."""
    system = mechanics(build_plant(two_mass, ["m1", "m2"], {}), [m1, m2])
    return scale_plant(modal_plant(system, Suspension()), M_K)


def stage(seed: int, flexible: int = 10, channels: int = 3, M_K: float = 2e7) -> ScaledPlant:
    """A random nearly collocated stage: one rigid mode a channel, flexible modes, ζ = 1 %.

    Sensors stand a little off the actuators, which leaves lightly damped transmission zeros.
    """
    rng = np.random.default_rng(seed)
    n = channels + flexible
    natural = np.concatenate([np.zeros(channels), HZ * np.sort(rng.uniform(100, 600, flexible))])
    B = 0.3 * rng.standard_normal((n, channels))
    B[:channels] = np.eye(channels) + 0.1 * rng.standard_normal((channels, channels))
    C = (B + 0.02 * rng.standard_normal(B.shape)).T
    B, C = B / np.sqrt(60.0), C / np.sqrt(60.0)
    none = tuple(np.zeros((1, *shape)) for shape in [(n, n)] * 3 + [B.shape, C.shape])
    system = Mechanics(np.eye(n), np.zeros((n, n)), np.diag(natural**2), B, C, 0.01, none)
    return scale_plant(modal_plant(system, Suspension()), M_K)
