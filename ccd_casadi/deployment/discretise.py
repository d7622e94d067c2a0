"""Controllers in discrete time, and at which rate they run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import pairwise

import numpy as np

from ccd_casadi.analysis.loop_channels import LoopChannel
from ccd_casadi.analysis.sampled_figures import SampledFigures, loop_figures, worst_figures
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.robust_set import Member, WorstFirst
from ccd_casadi.lti.loop import sampled, tustin
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class RateOptions:
    """Numbers of the search for a sampling rate."""

    slowest: float = 4.0  # rate tried, over ω_b/2π
    fastest: float = 4000.0
    accuracy: float = 1e-3  # relative: how closely the least rate is bracketed


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
        """The largest ‖S‖∞ that is allowed."""
        return self.S_max * (1.0 + self.excess)

    def met(self, figures: SampledFigures) -> bool:
        """Whether it does; an unstable loop does not."""
        change = abs(figures.bandwidth / self.bandwidth - 1.0)
        return self.held(figures) and change <= self.tolerance

    def held(self, figures: SampledFigures) -> bool:
        """Whether the loop is stable within the peak: what every plant of a set requires."""
        return figures.stable and figures.sensitivity_peak <= self.peak


def loop_at(
    plant: StateSpace, controller: StateSpace, conversion: Conversion, period: float, delay: float,
    places: Sequence[BreakPoint] = (),
) -> SampledFigures:  # fmt: skip
    """The figures of the sampled loop; of several sensors on one actuator at these `places`."""
    K = discretise(controller, conversion, period, delay)
    return loop_figures(closed_loop(sampled(plant, period, delay), K), places)


def needed_rate(
    met: Callable[[float], bool],
    bandwidth_hz: float,
    also: Sequence[float] = (),
    options: RateOptions = RateOptions(),
) -> float | None:
    """The least rate in Hz from which on every rate tried meets, None where the fastest does not.

    Tried are, from the fastest down to the slowest, those of `nice_rate`, their geometric means and
    `also`; the least is bracketed. A rate below one that fails is never called enough.
    """
    low, high = options.slowest * bandwidth_hz, options.fastest * bandwidth_hz
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
    while good / bad > 1.0 + options.accuracy:
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
    series = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.4, 8.0, 10.0)
    power = 10.0 ** np.floor(np.log10(rate))
    return float(next(power * nice for nice in series if power * nice >= rate * (1.0 - 1e-12)))


def loops_meet(
    loops: Sequence[tuple[LoopChannel, StateSpace]], target: Target, conversion: Conversion,
    rate: float, timing: Timing, order: WorstFirst,
) -> bool:  # fmt: skip
    """Whether the nominal loop of all channels, each with its controller, meets the target at a
    rate, and those of all members hold it."""
    delay = timing.delay_at(rate)

    def at(member: Member | None = None) -> SampledFigures:
        return worst_figures([
            loop_at((c.plant if member is None else member.seen_by(c)).plant_si(), K, conversion,
                    1.0 / rate, delay, c.places)
            for c, K in loops
        ])  # fmt: skip

    return target.met(at()) and order.all(lambda member: target.held(at(member)))


def choose(
    run: FinishedRun, timing: Timing, loops: Sequence[tuple[LoopChannel, StateSpace]],
    target: Target, family: tuple[Member, ...], progress: Callable[[str], None], attempt: int,
    remedy: str,
) -> tuple[Conversion, float | None, float]:  # fmt: skip
    """The conversion, the rate in Hz that it needs (None: no rate will do), and the rate to take.

    Raises UserError where no rate is given and none will do.
    """
    bandwidth_hz = run.bandwidth / HZ
    conversion = Conversion.LEAD if timing.lead else Conversion.RAMP
    again = f", once more for a plant in between ({attempt})" if attempt else ""
    progress(f"rate for {conversion.value}{again}")
    met = partial(loops_meet, loops, target, conversion, timing=timing, order=WorstFirst(family))
    needed = needed_rate(met, bandwidth_hz, () if timing.rate_hz is None else (timing.rate_hz,))
    if timing.rate_hz is not None:
        return conversion, needed, timing.rate_hz
    if needed is None:
        fastest = RateOptions().fastest * bandwidth_hz
        words = f"no sampling rate up to {fastest:.3g} Hz keeps S_max to 5 %"
        where = " on all plants of its [robust] set" if family else ""
        raise UserError(
            f"{run.folder}: {words} and omega_b to 3 %{where} with this delay; {remedy}"
        )
    return conversion, needed, nice_rate(needed)
