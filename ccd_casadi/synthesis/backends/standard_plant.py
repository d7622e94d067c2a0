"""The standard plant of H∞ control, and what a back end answers of it.

ẋ = A x + B1 w + B2 u,   z = C1 x + D11 w + D12 u,   y = C2 x + D21 w + D22 u,   u = K y
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.kernels.disturbance import four_block_plant
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.lti.state_space import StateSpace, balanced
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights


@dataclass(frozen=True)
class StandardPlant:
    """(A, [B1 B2], [C1; C2], [D11 D12; D21 D22]), partitioned."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    D12: Array
    D21: Array
    D22: Array

    def whole(self) -> StateSpace:
        """The plant as one state space."""
        return StateSpace(
            self.A,
            np.hstack([self.B1, self.B2]),
            np.vstack([self.C1, self.C2]),
            np.block([[self.D11, self.D12], [self.D21, self.D22]]),
        )


def mixed_sensitivity(plant: ScaledPlant, weights: Weights) -> StandardPlant:
    """[W_S S; W_KS KS; W_T T] as r to z, with y = e = r - Gu, in the plant's scaled units.

    With `weights.disturbance` the four blocks, (r, d) to [W_S e; W_KS u; W_T u].
    """
    p, m = len(plant.C), plant.B.shape[1]
    given = (plant.A, plant.B, plant.C, weights.scaled(plant.omega_0))
    if weights.delta:
        A, B1, B2, C1, C2, D11, D12 = four_block_plant(*given, weights.delta)
        return StandardPlant(A, B1, B2, C1, C2, D11, D12, np.eye(p, p + m), np.zeros((p, m)))
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(*given)
    D11, D12 = np.zeros((2 * p + m, p)), np.zeros((2 * p + m, m))
    D11[:p], D12[p : p + m] = d1 * np.eye(p), d2 * np.eye(m)
    return StandardPlant(A, B1, B2, C1, C2, D11, D12, np.eye(p), np.zeros((p, m)))


def balance(plant: StandardPlant) -> StandardPlant:
    """The same plant in balanced coordinates of its state."""
    whole = plant.whole()
    A, B, C = balanced(whole.A, whole.B, whole.C)
    w, z = plant.D11.shape[1], len(plant.D11)
    return replace(plant, A=A, B1=B[:, :w], B2=B[:, w:], C1=C[:z], C2=C[z:])


@dataclass(frozen=True)
class Attempt:
    """γ_opt as the back end has it, and a controller that is to reach `gamma`, e or y to u.

    `controller` is None where there is none; `reason` then says why.
    """

    gamma_opt: float
    gamma: float
    controller: StateSpace | None
    reason: str = ""


# (plant, gamma_backoff=1.02): H∞ synthesis for any standard plant at that many times its own γ_opt
Solver = Callable[..., Attempt]
