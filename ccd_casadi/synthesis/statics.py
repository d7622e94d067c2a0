"""The loop at rest: what a constant force does, exactly at 0 Hz.

    K(0) in N/m,   GS(0) = (I + G(0) K(0))⁻¹ G(0) in m/N, the rigid bodies on their suspension

Not the edge of a grid: mixed sensitivity cancels the suspension's poles, and |K| may fall by
decades below the last frequency that a grid shows.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array

DIFFERENTIATOR = 0.1  # |K(0)| under this share of |K(jω_b)| holds little at rest
PURE_INTEGRATOR = 1e-10  # least singular value of A over the largest below which s = 0 is a pole


@dataclass(frozen=True)
class Statics:
    """Least singular value of K(0) (N/m), largest of GS(0) (m/N), |K(0)| over |K| at ω_b."""

    stiffness: float
    compliance: float
    share: float

    @property
    def differentiates(self) -> bool:
        """Whether the controller is almost a differentiator."""
        return self.share < DIFFERENTIATOR

    @property
    def words(self) -> str:
        """One or two sentences."""
        if np.isinf(self.stiffness):
            return "Static stiffness: infinite (the controller integrates)."
        found = (
            f"Static stiffness K(0) = {self.stiffness:.3g} N/m: a constant force of 1 N moves the "
            f"stage {self.compliance:.3g} m (GS at 0 Hz)."
        )
        if self.differentiates:
            found += (
                f" K(0) is {100.0 * self.share:.2g} % of |K| at the bandwidth: the controller is "
                "almost a differentiator, and holds little against cables, friction and gravity."
            )
        return found


def statics(plant: StateSpace, controller: StateSpace, at_bandwidth: Array) -> Statics:
    """From a stable plant and a continuous controller in SI, and K(jω_b) (m, p)."""
    return statics_from(_at_rest(plant, 0.0), _at_rest(controller, 0.0), at_bandwidth)


def statics_from(G0: Array | None, K0: Array | None, at_bandwidth: Array) -> Statics:
    """The same from G(0) (p, m) and K(0) (m, p); None for a K that integrates."""
    if K0 is None or G0 is None:
        return Statics(np.inf, 0.0, np.inf)
    gains = np.linalg.svd(K0, compute_uv=False)
    compliance = np.linalg.norm(np.linalg.solve(np.eye(len(G0)) + G0 @ K0, G0), 2)
    share = gains[0] / max(float(np.linalg.norm(at_bandwidth, 2)), 1e-300)
    return Statics(float(gains[-1]), float(compliance), float(share))


def _at_rest(system: StateSpace, z: float) -> Array | None:
    """C (z - A)⁻¹ B + D for a real z; None where z is a pole."""
    shifted = z * np.eye(len(system.A)) - system.A
    sizes = np.linalg.svd(shifted, compute_uv=False)
    if len(sizes) and sizes[-1] <= PURE_INTEGRATOR * sizes[0] * 1e-4:
        return None
    return np.asarray(system.C @ np.linalg.solve(shifted, system.B) + system.D, float)


def sampled_statics(plant: StateSpace, controller: StateSpace, at_bandwidth: Array) -> Statics:
    """The same with a controller in discrete time, whose rest is z = 1."""
    return statics_from(_at_rest(plant, 0.0), _at_rest(controller, 1.0), at_bandwidth)
