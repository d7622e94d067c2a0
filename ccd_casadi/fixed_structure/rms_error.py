"""The RMS error of a fixed structure on a set of plants, e² = mean of the error's variance.

Exact gradients of ln e by adjoint Lyapunov equations, see `budget.derivatives`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.budget import ErrorBudget
from ccd_casadi.budget.derivatives import Change, rms_error_slope, variance_slopes
from ccd_casadi.fixed_structure.structure import Structure, state_space, state_spaces
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

STEP = 1e-30  # of κ along the imaginary axis


@dataclass(frozen=True)
class RmsError:
    """e of a controller on SISO plants, and its derivatives to κ and θ."""

    plants: tuple[ScaledPlant, ...]
    structure: Structure
    budget: ErrorBudget
    hold: Sampling | None

    def at(self, kappa: Array) -> tuple[float, Array]:
        """ln e (m) at κ in SI, and its gradient; infinite where a loop is unstable."""
        kappa = np.asarray(kappa, float)
        stepped = state_spaces(self.structure, kappa + 1j * STEP * np.eye(len(kappa)))
        changes = [
            Change(None, StateSpace(*(part[i].imag / STEP for part in stepped)))
            for i in range(len(kappa))
        ]
        return self._summed(kappa, [changes] * len(self.plants))

    def to_theta(self, kappa: Array) -> Array:
        """∂ ln e/∂θ at a fixed κ."""
        none = np.zeros((1, 1))
        changes = [
            [Change(StateSpace(*change, none), None) for change in plant.changes_si()]
            for plant in self.plants
        ]
        return self._summed(np.asarray(kappa, float), changes)[1]

    def shown(self, value: float) -> str:
        """In nm."""
        return f"{1e9 * value:.4g} nm RMS"

    def _summed(self, kappa: Array, changes: Sequence[Sequence[Change]]) -> tuple[float, Array]:
        """ln e and its derivatives to what the changes of each plant's loop are of."""
        K, budget = state_space(self.structure, kappa), replace(self.budget, window=None)
        total = None
        for plant, own in zip(self.plants, changes, strict=True):
            found = variance_slopes(Loop(plant.plant_si(), K, self.hold), budget, own)
            if found is None:
                return np.inf, np.full(len(own), np.nan)
            total = found if total is None else replace(
                total, value=total.value + found.value, gradient=total.gradient + found.gradient
            )  # fmt: skip
        assert total is not None
        value, slope = rms_error_slope(total)
        return value - 0.5 * float(np.log(len(self.plants))), slope
