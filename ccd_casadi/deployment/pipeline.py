"""Certified controller → reduced → sampled → verified → realised → measured in a simulation."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.closer_models import UNBOUNDED
from ccd_casadi.deployment.channels import Channel, assemble, split
from ccd_casadi.deployment.discretise import (
    FASTEST,
    Conversion,
    Discretisation,
    Target,
    discretise,
    loop_at,
    needed_rate,
    nice_rate,
)
from ccd_casadi.deployment.realisation import Realisation, realise
from ccd_casadi.deployment.reduction import Limits, Reduced, Reduction, reductions, smallest
from ccd_casadi.deployment.sampled import (
    DiscreteStateSpace,
    SampledFigures,
    sampled_figures,
    sampled_plant,
    sensitivity_loop,
    together,
)
from ccd_casadi.deployment.simulation import MeasuredSensitivity, measure_sensitivity
from ccd_casadi.inner_problem.sections_problem import SectionsProblem
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import DesignFigures

# A reduced controller keeps S_max to 0.5 % (it binds at most optima, where any change passes it a
# little), S_low, 99 % of ω_b, and no gain more than twice the bound that γ puts on it.
REDUCED_PEAK, REDUCED_NORM, REDUCED_BANDWIDTH = 1.005, 2.0, 0.99
STRICT = 1e-6  # relative: S_max kept as the design itself keeps it
# The sampled loop keeps S_max to 5 % and ω_b to 3 %.
SAMPLED_PEAK, SAMPLED_BANDWIDTH = 1.05, 0.03
LEAST_RATE = 4.0  # samples in a period of ω_b


@dataclass(frozen=True)
class Timing:
    """How the controller runs: a rate (None: the one that is needed), a delay, a method.

    The delay, from reading y to the new u at the actuator, is `delay` in s, or where that is
    None `delay_samples` periods. No method: the one that needs the lowest rate.
    """

    rate_hz: float | None = None
    delay: float | None = None
    delay_samples: float = 1.0
    method: Discretisation | None = None
    lead: bool | None = None

    def delay_at(self, rate_hz: float) -> float:
        """The delay in s at a sampling rate."""
        return self.delay if self.delay is not None else self.delay_samples / rate_hz


@dataclass(frozen=True)
class ChannelOrders:
    """A channel's controllers of every order; the one chosen, and the least that keeps S_max."""

    channel: Channel
    rows: tuple[Reduced, ...]
    chosen: Reduced
    strict: Reduced


@dataclass(frozen=True)
class Trial:
    """A way to discretise, the rate in Hz that it needs (None: no rate will do)."""

    conversion: Conversion
    needed_hz: float | None


@dataclass(frozen=True)
class Deployment:
    """Everything that was found out on the way from a run's controller to the deployed one.

    `sampled` are the exact figures of the sampled loop, `measured` those of its simulation
    (None where it is unstable).
    """

    orders: tuple[ChannelOrders, ...]
    limits: Limits
    reduced: StateSpace
    reduced_figures: DesignFigures
    trials: tuple[Trial, ...]
    target: Target
    rate_hz: float
    delay: float
    conversion: Conversion
    plant: DiscreteStateSpace
    realisation: Realisation
    sampled: SampledFigures
    measured: MeasuredSensitivity | None

    @property
    def order(self) -> int:
        """States of the reduced controller."""
        return len(self.reduced.A)

    @property
    def needed_hz(self) -> float | None:
        """The rate that the chosen method needs."""
        return next(t.needed_hz for t in self.trials if t.conversion == self.conversion)

    @property
    def passed(self) -> bool:
        """Whether the sampled loop keeps its target, exactly and in the simulation."""
        if self.measured is None or not self.target.met(self.sampled):
            return False
        simulated = SampledFigures(
            True, self.sampled.spectral_radius, self.measured.sensitivity_peak,
            self.measured.sensitivity_peak_frequency, self.measured.bandwidth,
        )  # fmt: skip
        return self.target.met(simulated)


def deploy(
    run: FinishedRun,
    timing: Timing,
    *,
    saturation: float | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda words: None,
) -> Deployment:
    """Reduce, discretise and verify the controller of a run; `progress` is told each step.

    Raises UserError where no sampling rate is enough, or the given one is no rate for this loop.
    """
    if run.problem.sections is not None:
        return _deploy_sections(run, run.problem.sections, timing, saturation, seed, progress)
    inner, full = run.problem.inner, run.figures
    bandwidth_hz = full.bandwidth / HZ
    if timing.rate_hz is not None and timing.rate_hz < LEAST_RATE * bandwidth_hz:
        words = f"is less than {LEAST_RATE:g} times the bandwidth, {bandwidth_hz:.4g} Hz"
        raise UserError(f"--rate-hz {timing.rate_hz:g}: {words}; sample faster")
    limits = Limits(
        REDUCED_PEAK * inner.S_max, inner.S_low * (1.0 + STRICT), REDUCED_NORM * full.gamma,
        REDUCED_BANDWIDTH * full.bandwidth,
    )  # fmt: skip
    orders = tuple(_orders(run, c, limits, progress) for c in split(run.plant, run.controller))
    channels = [item.channel for item in orders]
    small = [item.chosen.controller for item in orders]
    reduced = assemble(channels, small)
    reduced_figures = measure(
        run.plant, reduced, run.weights, gamma=UNBOUNDED, omega_low=inner.omega_low
    )
    parts = [(c.plant.plant_si(), K) for c, K in zip(channels, small, strict=True)]
    target = Target(SAMPLED_PEAK * inner.S_max, full.bandwidth, SAMPLED_BANDWIDTH)
    trials = []
    for conversion in _conversions(timing, full.sensitivity_peak_frequency):
        progress(f"rate for {conversion.label}")

        def met(rate: float, conversion: Conversion = conversion) -> bool:
            delay = timing.delay_at(rate)
            loops = [loop_at(G, K, conversion, 1.0 / rate, delay) for G, K in parts]
            return target.met(together(loops))

        also = () if timing.rate_hz is None else (timing.rate_hz,)
        trials.append(Trial(conversion, needed_rate(met, bandwidth_hz, also)))
    best = min(trials, key=lambda t: float("inf") if t.needed_hz is None else t.needed_hz)
    if timing.rate_hz is None and best.needed_hz is None:
        words = f"no sampling rate up to {FASTEST * bandwidth_hz:.3g} Hz keeps S_max to 5 %"
        raise UserError(f"{run.folder}: {words} and omega_b to 3 % with this delay; shorten it")
    rate = timing.rate_hz or nice_rate(best.needed_hz or 0.0)
    delay, period = timing.delay_at(rate), 1.0 / rate
    sampled_controllers = [discretise(K, best.conversion, period, delay) for K in small]
    realisation = realise(channels, sampled_controllers, saturation)
    held = sampled_plant(run.plant.plant_si(), period, delay)
    sampled = sampled_figures(sensitivity_loop(held, realisation.system))
    progress("simulation")
    measured = None
    if sampled.stable:
        measured = measure_sensitivity(held, realisation.system, full.bandwidth, seed)
    return Deployment(
        orders, limits, reduced, reduced_figures, tuple(trials), target, rate, delay,
        best.conversion, held, realisation, sampled, measured,
    )  # fmt: skip


def _deploy_sections(
    run: FinishedRun,
    sections: SectionsProblem,
    timing: Timing,
    saturation: float | None,
    seed: int,
    progress: Callable[[str], None],
) -> Deployment:
    """The sections as they are: nothing is reduced, at the case's rate and delay by Tustin's rule.

    Where the case gives no rate, the one that is needed is searched as for any controller.
    """
    inner, full, K = run.problem.inner, run.figures, run.controller
    channel = split(run.plant, K)[0]
    G, designed = run.plant.plant_si(), sections.sampling
    whole = Reduced(len(K.A), Reduction.NONE, K, full)
    limits = Limits(inner.S_max, inner.S_low, np.inf, full.bandwidth)
    tustin = Conversion(Discretisation.TUSTIN, False, full.sensitivity_peak_frequency)
    if designed is None:
        progress("rate")
        bandwidth, conversions = full.bandwidth, _conversions(timing, tustin.warp)
        target = Target(SAMPLED_PEAK * inner.S_max, bandwidth, SAMPLED_BANDWIDTH)
    else:
        # What was designed is the sampled loop: that is what a given rate or delay is held against.
        conversions = [tustin]
        own = loop_at(G, K, tustin, designed.period, designed.delay)
        bandwidth = own.bandwidth
        target = Target(inner.S_max * (1.0 + 1e-3), bandwidth, SAMPLED_BANDWIDTH)
        timing = replace(timing, rate_hz=timing.rate_hz or designed.rate_hz)
        if timing.delay is None and timing.delay_samples == Timing.delay_samples:
            timing = replace(timing, delay=designed.delay)
    trials = []
    for conversion in conversions:
        progress(f"rate for {conversion.label}")

        def met(rate: float, conversion: Conversion = conversion) -> bool:
            return target.met(loop_at(G, K, conversion, 1.0 / rate, timing.delay_at(rate)))

        if designed is None:
            also = () if timing.rate_hz is None else (timing.rate_hz,)
            trials.append(Trial(conversion, needed_rate(met, bandwidth / HZ, also)))
        else:
            given = timing.rate_hz or designed.rate_hz
            trials.append(Trial(conversion, given if met(given) else designed.rate_hz))
    best = min(trials, key=lambda t: float("inf") if t.needed_hz is None else t.needed_hz)
    if timing.rate_hz is None and best.needed_hz is None:
        words = f"no sampling rate up to {FASTEST * bandwidth / HZ:.3g} Hz keeps S_max to 5 %"
        remedy = "shorten it, or design for it with loop.rate_hz and loop.delay_us in the case"
        raise UserError(f"{run.folder}: {words} and omega_b to 3 % with this delay; {remedy}")
    rate = timing.rate_hz or nice_rate(best.needed_hz or 0.0)
    delay, period = timing.delay_at(rate), 1.0 / rate
    realisation = realise([channel], [discretise(K, best.conversion, period, delay)], saturation)
    held = sampled_plant(G, period, delay)
    sampled = sampled_figures(sensitivity_loop(held, realisation.system))
    progress("simulation")
    measured = None
    if sampled.stable:
        measured = measure_sensitivity(held, realisation.system, full.bandwidth, seed)
    orders = (ChannelOrders(channel, (whole,), whole, whole),)
    return Deployment(
        orders, limits, K, full, tuple(trials), target, rate, delay, best.conversion, held,
        realisation, sampled, measured,
    )  # fmt: skip


def _orders(
    run: FinishedRun, channel: Channel, limits: Limits, progress: Callable[[str], None]
) -> ChannelOrders:
    progress(f"orders of channel {channel.name}")
    inner = run.problem.inner
    rows = reductions(channel, run.weights, inner.omega_low)
    strict = Limits(inner.S_max * (1.0 + STRICT), limits.low, limits.norm, limits.bandwidth)
    return ChannelOrders(channel, tuple(rows), smallest(rows, limits), smallest(rows, strict))


def _conversions(timing: Timing, peak_frequency: float) -> list[Conversion]:
    methods = list(Discretisation) if timing.method is None else [timing.method]
    leads = [False, True] if timing.lead is None else [timing.lead]
    return [Conversion(method, lead, peak_frequency) for method in methods for lead in leads]
