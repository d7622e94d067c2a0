"""Continuous controllers in discrete time, and the sampling rate that they need."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np

from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.hold import sampled, tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.robust.sampled import SampledFigures, sampled_figures

SLOWEST, FASTEST = 4.0, 4000.0  # rates tried, over ω_b/2π
CLOSE = 1e-3  # relative: how closely the rate that is needed is bracketed
NICE = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.4, 8.0, 10.0)


class Conversion(StrEnum):
    """How K(s) becomes K(z): Tustin's rule, or ramp-invariant, with or without a lead.

    Ramp-invariant is exact for an error that is straight between samples; it needs the lower rate
    on every case measured. The lead is (1 + α) - α z⁻¹, whose phase is that of a time advance of αT
    at low frequency; α = τ/T + 1/2. Its price is the gain 1 + 2α at half the sampling rate.
    """

    TUSTIN = "tustin"  # of loops that were designed as they run
    RAMP = "foh"
    LEAD = "foh with lead"


def discretise(
    controller: StateSpace, conversion: Conversion, period: float, delay: float
) -> StateSpace:
    """K(z) for a period and a delay in s, the lead on its input."""
    from scipy.signal import cont2discrete  # slow to import

    if conversion is Conversion.TUSTIN:
        found = tustin(controller, period)
        A, B, C, D = found.A, found.B, found.C, found.D
    else:
        parts = (controller.A, controller.B, controller.C, controller.D)
        A, B, C, D, _ = cont2discrete(parts, period, Conversion.RAMP.value)
    if conversion is not Conversion.LEAD:
        return StateSpace(A, B, C, D, period=period)
    alpha = delay / period + 0.5
    n, m = B.shape
    return StateSpace(
        np.block([[A, -alpha * B], [np.zeros((m, n + m))]]),
        np.vstack([(1.0 + alpha) * B, np.eye(m)]),
        np.hstack([C, -alpha * D]),
        (1.0 + alpha) * D,
        period=period,
    )


@dataclass(frozen=True)
class Target:
    """What a sampled loop keeps: ‖S‖∞ <= (1 + excess) S_max, |ω_b/bandwidth - 1| <= tolerance."""

    S_max: float
    excess: float
    bandwidth: float  # rad/s
    tolerance: float

    @property
    def peak(self) -> float:
        """The largest ‖S‖∞ that is let pass."""
        return self.S_max * (1.0 + self.excess)

    def met(self, figures: SampledFigures) -> bool:
        """Whether it does; an unstable loop does not."""
        change = abs(figures.bandwidth / self.bandwidth - 1.0)
        return self.held(figures) and change <= self.tolerance

    def held(self, figures: SampledFigures) -> bool:
        """Whether the loop is stable within the peak: what is asked on every plant of a set."""
        return figures.stable and figures.sensitivity_peak <= self.peak


def loop_at(
    plant: StateSpace, controller: StateSpace, conversion: Conversion, period: float, delay: float
) -> SampledFigures:
    """The figures of the sampled loop."""
    K = discretise(controller, conversion, period, delay)
    return sampled_figures(closed_loop(sampled(plant, period, delay), K).S)


def needed_rate(
    met: Callable[[float], bool], bandwidth_hz: float, also: Sequence[float] = ()
) -> float | None:
    """The least rate in Hz from which on every rate tried meets, None where the fastest does not.

    Tried are, from 4000 ω_b down to 4 ω_b, those of `nice_rate`, their geometric means and `also`;
    the least is bracketed to 0.1 %. A rate below one that fails is never called enough.
    """
    low, high = SLOWEST * bandwidth_hz, FASTEST * bandwidth_hz
    round_ones = [nice_rate(low)]
    while round_ones[-1] < high:
        round_ones.append(nice_rate(round_ones[-1] * 1.01))
    between = [float(np.sqrt(a * b)) for a, b in pairwise(round_ones)]
    good, bad = None, np.nan
    for rate in sorted({*round_ones, *between, *also}, reverse=True):
        if not met(rate):
            bad = rate
            break
        good = rate
    if good is None or np.isnan(bad):
        return good
    while good / bad > 1.0 + CLOSE:
        middle = float(np.sqrt(good * bad))
        if met(middle):
            good = middle
        else:
            bad = middle
    return good


def nice_rate(rate: float) -> float:
    """The next rate of the series 1, 1.25, 1.6, 2, 2.5, 3.2, 4, 5, 6.4, 8 times a power of ten.

    >>> nice_rate(8123.0), nice_rate(10000.0)
    (10000.0, 10000.0)
    """
    power = 10.0 ** np.floor(np.log10(rate))
    return float(next(power * nice for nice in NICE if power * nice >= rate * (1.0 - 1e-12)))
