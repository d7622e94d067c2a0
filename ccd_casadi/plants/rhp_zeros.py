"""What a zero in the right half-plane forbids, and whether it is the plant's own.

A zero z = x + iy with x > 0 holds every stable S to an integral over the axis (Freudenberg and
Looze 1985; with several outputs |S| is σ_max(S), as uᴴ S(z) = uᴴ in the zero's direction):

    ∫ ln|S(jω)| (x/(x² + (ω - y)²) + x/(x² + (ω + y)²)) dω >= 0,   ω from 0 to ∞.

With |S| <= 1/√2 up to ω_b and <= M beyond, the share θ(ω_b) of the weight that lies below ω_b obeys

    θ(ω_b) = (atan((ω_b - y)/x) + atan((ω_b + y)/x))/π <= ln M/(ln M + ln √2).
"""

import numpy as np
from scipy.optimize import brentq

from ccd_casadi.plants.facts import Zero


def bandwidth_limit_hz(zero: Zero, S_max: float) -> float:
    """The ω_b, in Hz, that no stable loop with ‖S‖∞ <= S_max passes; of a right half-plane zero.

    >>> round(bandwidth_limit_hz(Zero(10.0, -1.0, 1.0), 2.0), 2)  # z tan(60°), real zero
    17.32
    """
    x = -zero.damping_ratio * zero.frequency_hz
    y = zero.frequency_hz * np.sqrt(max(0.0, 1.0 - zero.damping_ratio**2))
    most = np.log(S_max) / (np.log(S_max) + 0.5 * np.log(2.0))

    def excess(log_hz: float) -> float:
        w = np.exp(log_hz)
        return float((np.arctan((w - y) / x) + np.arctan((w + y) / x)) / np.pi - most)

    centre = np.log(zero.frequency_hz)
    return float(np.exp(brentq(excess, centre - 30.0, centre + 30.0)))
