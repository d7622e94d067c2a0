"""Local peaks of S as constraints, for where the largest one alone has no gradient.

‖S‖∞ = max over its local peaks, and each of these is smooth in x = (θ, ln ω_S, ln ω_T). Below ω_b a
peak that reaches -3 dB makes ω_b jump, so that it is a constraint as well.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.peaks import LocalPeak, local_peaks_with_gradients

HALF_POWER = -0.5 * np.log(2.0)
SAME_PEAK = 0.03  # ln ω within which peaks of one plant are one
OTHER_PEAK = "S_max at "  # begins the name of a local peak besides the largest


@dataclass(frozen=True)
class PeakConstraint:
    """A local peak of S as a constraint: its name, ln of it minus ln of its bound, unit-box slope.

    `omega` in rad/s and `member` of the robust set tell which peak it is.
    """

    name: str
    value: float
    row: Array
    omega: float
    member: int

    @property
    def tag(self) -> tuple[str, float, int]:
        """What it is, ln ω and its plant: by these it is found again at another x."""
        kind = "peak" if self.name.startswith(OTHER_PEAK) else "shelf"
        return kind, float(np.log(self.omega)), self.member


def other_peaks(
    problem: CoDesignProblem, x: Array, design: Sensitivities, band: float
) -> tuple[PeakConstraint, ...]:
    """Local peaks of S besides the largest that are within `band` (ln) of what they must not pass.

    That is S_max anywhere, on every plant of a robust set, and -3 dB below ω_b, which is the first
    crossing only as long as they do not pass it.
    """
    figures, width = design.figures, lifted_bounds(problem).width
    peaks = local_peaks_with_gradients(
        scaled_plant(problem, tuple(x[:-2])),
        problem.weights.at(figures.omega_S, figures.omega_T),
        design,
        gamma_backoff=problem.inner.gamma_backoff,
        least=float(np.exp(min(HALF_POWER, np.log(problem.inner.S_max)) - band)),
    )
    S_max, found = np.log(problem.inner.S_max), []
    norm = _of_norm(peaks, design)
    for peak in peaks:
        if peak is norm:
            continue  # the row S_max itself
        on = f" on plant {peak.member} of the set" if peak.member else ""
        place = f"{peak.omega / HZ:.4g} Hz{on}"
        shelf = peak.member == 0 and peak.omega < figures.bandwidth
        if peak.ln_gain >= S_max - band:
            level, kind = S_max, OTHER_PEAK
        elif shelf and abs(peak.ln_gain - HALF_POWER) <= band:
            level, kind = HALF_POWER, "-3 dB at "
        else:
            continue
        found.append(PeakConstraint(
            kind + place, peak.ln_gain - level, peak.gradient * width, peak.omega, peak.member
        ))  # fmt: skip
    return tuple(found)


def _of_norm(peaks: tuple[LocalPeak, ...], design: Sensitivities) -> LocalPeak | None:
    """The peak that ‖S‖∞ is read at: by its plant and frequency, as others may be as high."""
    if design.made is None:
        return None
    place = np.log(design.figures.sensitivity_peak_frequency)
    own = [peak for peak in peaks if peak.member == design.made.worst]
    nearest = min(own, key=lambda peak: abs(np.log(peak.omega) - place), default=None)
    far = nearest is None or abs(np.log(nearest.omega) - place) > SAME_PEAK
    return None if far else nearest
