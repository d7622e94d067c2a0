"""The plants that a robust design has to hold on."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.plants.modal import Perturbation


@dataclass(frozen=True)
class RobustSet:
    """Plants on which the loop has to be stable and ‖S‖∞ within S_max.

    Frequencies of the flexible modes times 1 + s, `shifts` values of s evenly over ±`shift`, and
    with every one of them damping times each factor of `damping`. The controller is designed on the
    plant shifted by `design_shift`; None leaves that open: both ends and the middle are tried, see
    `design_choices`.
    """

    shift: float
    shifts: int
    damping: tuple[float, ...]
    design_shift: float | None

    def perturbations(self, shifts: int | None = None) -> tuple[Perturbation, ...]:
        """The set; `shifts` of them for a denser one."""
        values = np.linspace(-self.shift, self.shift, self.shifts if shifts is None else shifts)
        factors = sorted({1.0, *self.damping})
        return tuple(Perturbation(float(s), z) for s in values for z in factors)

    @property
    def design_at(self) -> str:
        """The plant that the controller is made on: "auto", "low", "nominal" or "high"."""
        if self.design_shift is None:
            return "auto"
        return ("low", "nominal", "high")[1 + int(np.sign(self.design_shift))]

    def scaled(self, share: float) -> "RobustSet":
        """The set that reaches a share of this one's way, from the model alone (0) to it (1)."""
        design = None if self.design_shift is None else share * self.design_shift
        damping = tuple(factor**share for factor in self.damping)
        return RobustSet(share * self.shift, self.shifts, damping, design)
