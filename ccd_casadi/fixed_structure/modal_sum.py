"""An uncertain plant as a sum of modes: poles and residues as affine forms of what is uncertain.

G(s) = Σ b_i c_i/(s² + g_i s + k_i) = Σ r_i/(s - p_i) - r_i/(s - q_i),   r = b c/(p - q)
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, inverse, root, variable
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.support.arrays import Array

UNCOUPLED = 1e-12  # relative: a modal damping matrix with less beside its diagonal is diagonal


@dataclass(frozen=True)
class ModalSum:
    """One option of an uncertain plant as Σ b_i c_i/(s² + g_i s + k_i), time in 1/`unit`, SI else.

    k = (ω (1 + shift)(1 + own shift))², g = factor (given + 2 ζ ω (1 + shift)(1 + own shift));
    `rigid` ones have their suspension's instead.
    """

    omega: Array
    rigid: np.ndarray
    suspended: tuple[float, float]
    given: Array
    zeta: float
    strength: Array

    def poles(
        self, names: tuple[str, ...], low: Array, high: Array
    ) -> tuple[list[tuple[Affine, Affine]], np.ndarray]:
        """(p, residue) of every mode's two poles over boxes (n_p, N) of the parameters `names`;
        where all modes stay damped. Variable 0 of the forms is left to the frequency.
        """
        n, m = len(low) + 1, low.shape[1]
        one = Affine(np.ones(m), np.zeros((n, m)), np.zeros(m))
        values = {name: variable(low[i], high[i], i + 1, n) for i, name in enumerate(names)}
        shift = values["resonance_shift"] + 1.0 if "resonance_shift" in values else one
        factor = values.get("damping", one)
        gain = values["gain"] + 1.0 if "gain" in values else one
        found, damped, flexible = [], np.ones(m, bool), 0
        for i, omega in enumerate(self.omega):
            if self.rigid[i]:
                w_r, ratio = self.suspended
                k, g = one * w_r**2, one * (2.0 * ratio * w_r) + factor * self.given[i]
            else:
                flexible += 1
                own = values.get(f"mode_shift {flexible}")
                w = shift * omega if own is None else shift * (own + 1.0) * omega
                k, g = w * w, factor * (w * (2.0 * self.zeta) + self.given[i])
            damped &= (_least(k) > 0.0) & (_least(g) > 0.0)
            half = g * 0.5
            under = k - half * half
            light = under.centre.real > 0.0
            swing = root(under * np.where(light, 1.0, -1.0)) * np.where(light, 1j, 1.0)
            residue = gain * inverse(swing * 2.0) * self.strength[i]
            found += [(swing - half, residue), (-swing - half, -residue)]
        return found, damped


def modal_sum(uncertain: UncertainPlant, option: int, unit: float) -> ModalSum | None:
    """None where a given damping matrix couples the modes."""
    system = uncertain.options[option]
    modal = modal_plant(system, uncertain.suspension)
    zeta = float(system.damping_ratio or 0.0)
    w_r = 2.0 * np.pi * uncertain.suspension.frequency_hz
    own = np.where(modal.rigid, 2.0 * uncertain.suspension.damping_ratio * w_r,
                   2.0 * zeta * modal.natural)  # fmt: skip
    given = modal.D - np.diag(own)
    size = np.abs(np.diag(modal.D)).max()
    if np.abs(given - np.diag(np.diag(given))).max() > UNCOUPLED * size:
        return None
    diagonal = np.diag(given)
    diagonal = np.where(np.abs(diagonal) > UNCOUPLED * size, diagonal, 0.0)
    return ModalSum(
        modal.natural / unit, modal.rigid,
        (w_r / unit, uncertain.suspension.damping_ratio), diagonal / unit, zeta,
        modal.B[:, 0] * modal.C[0] / unit**2,
    )  # fmt: skip


def _least(f: Affine) -> Array:
    """Not above a real form anywhere."""
    return np.asarray(f.centre.real - np.abs(f.slope).sum(0) - f.rest)
