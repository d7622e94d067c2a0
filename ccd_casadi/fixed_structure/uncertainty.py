"""Plants off their model over a box: common and single resonance shifts, damping, gain, options.

A point p of the box is a vector; with the option sets of the plant it makes one scaled plant.
Frequencies of flexible modes are multiplied by (1 + p_common)(1 + p_mode), modal damping ratios by
the damping factor, the whole plant by 1 + p_gain. Mode shapes stay, and so does the suspension.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ccd_casadi.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plant import Array, Mechanics
from ccd_casadi.scaling import ScaledPlant, scale_plant


@dataclass(frozen=True)
class UncertainPlant:
    """What may differ from the model; zeros and (1, 1): nothing.

    `options`: the same plant with other loads or positions, by their matrices; the model first.
    `damping` are the least and the largest factor. M_K in N/m scales all of them alike.
    """

    options: tuple[Mechanics, ...]
    suspension: Suspension
    M_K: float
    resonance_shift: float = 0.0
    mode_shift: float = 0.0
    damping: tuple[float, float] = (1.0, 1.0)
    gain: float = 0.0

    @cached_property
    def modes(self) -> int:
        """The largest number of flexible modes of any option."""
        plants = [modal_plant(option, self.suspension) for option in self.options]
        return max(int((~plant.rigid).sum()) for plant in plants)

    @property
    def names(self) -> tuple[str, ...]:
        """The uncertain parameters, those whose range is not zero."""
        found = ["resonance_shift"] if self.resonance_shift else []
        if self.mode_shift:
            found += [f"mode_shift {i}" for i in range(1, self.modes + 1)]
        if self.damping != (1.0, 1.0):
            found.append("damping")
        if self.gain:
            found.append("gain")
        return tuple(found)

    @property
    def box(self) -> Array:
        """Lower and upper ends (2, n)."""
        ends = {
            "resonance_shift": (-self.resonance_shift, self.resonance_shift),
            "damping": self.damping,
            "gain": (-self.gain, self.gain),
        }
        found = [ends.get(name, (-self.mode_shift, self.mode_shift)) for name in self.names]
        return np.array(found).reshape(-1, 2).T

    @property
    def nominal(self) -> Array:
        """The model's own point."""
        return np.array([1.0 if name == "damping" else 0.0 for name in self.names])

    def plant(self, point: Array, option: int = 0) -> ScaledPlant:
        """The scaled plant at a point of the box."""
        values = dict(zip(self.names, np.asarray(point, float).tolist(), strict=True))
        shift, factor = values.get("resonance_shift", 0.0), values.get("damping", 1.0)
        system = self.options[option]
        modal = modal_plant(system, self.suspension, Perturbation(shift, factor))
        own = [values.get(f"mode_shift {i}", 0.0) for i in range(1, self.modes + 1)]
        if any(own):
            ratio = np.ones(len(modal.natural))
            flexible = np.flatnonzero(~modal.rigid)
            ratio[flexible] += own[: len(flexible)]
            # M⁻¹K = diag h: a mode's frequency times r is its row and column times r. Damping by
            # ratio goes with the frequency, a given matrix stays, as with the common shift.
            r = np.sqrt(np.outer(ratio**2, ratio**2))
            D = modal.D * np.sqrt(r) if system.damping_ratio is not None else modal.D
            dD = modal.dD * np.sqrt(r) if system.damping_ratio is not None else modal.dD
            modal = replace(modal, K=modal.K * r, dK=modal.dK * r, D=D, dD=dD,
                            natural=modal.natural * ratio)  # fmt: skip
        gain = 1.0 + values.get("gain", 0.0)
        if gain != 1.0:
            modal = replace(modal, B=gain * modal.B, dB=gain * modal.dB)
        return scale_plant(modal, self.M_K)

    def plants(self, points: Sequence[tuple[int, Array]]) -> list[ScaledPlant]:
        """The plants of (option, point) pairs."""
        return [self.plant(point, option) for option, point in points]

    def corners(self) -> list[tuple[int, Array]]:
        """The model of every option, then the ends of every parameter, all together and alone."""
        box, centre = self.box, self.nominal
        found = [(option, centre) for option in range(len(self.options))]
        n = len(centre)
        for option in range(len(self.options)):
            if n <= 3:
                for number in range(2**n if n else 0):
                    row = [(number >> i) & 1 for i in range(n)]
                    found.append((option, box[row, np.arange(n)]))
            else:
                for end in (0, 1):
                    found.append((option, box[end]))
                    for i in range(n):
                        point = centre.copy()
                        point[i] = box[end, i]
                        found.append((option, point))
        return found
