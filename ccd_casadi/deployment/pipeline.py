"""Certified controller → reduced → sampled → verified → realised → measured in a simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.closer_models import UNBOUNDED
from ccd_casadi.deployment.anti_windup import limited
from ccd_casadi.deployment.channels import Channel, assemble, split
from ccd_casadi.deployment.discretise import (
    FASTEST,
    Conversion,
    Target,
    discretise,
    loop_at,
    needed_rate,
    nice_rate,
)
from ccd_casadi.deployment.realisation import Realisation, realise
from ccd_casadi.deployment.reduction import Limits, Reduced, Reduction, reductions, smallest
from ccd_casadi.deployment.robust_set import (
    Member,
    MemberLoop,
    WorstFirst,
    members,
    place_words,
)
from ccd_casadi.deployment.sampled import (
    DiscreteStateSpace,
    SampledFigures,
    sampled_figures,
    sampled_plant,
    sensitivity_loop,
    together,
)
from ccd_casadi.deployment.simulation import MeasuredSensitivity, measure_sensitivity, measure_set
from ccd_casadi.deployment.timing import Discretisation
from ccd_casadi.deployment.timing import Timing as Timing
from ccd_casadi.inner_problem.sections_problem import SectionsProblem
from ccd_casadi.inner_problem.sweep import missed_by
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.statics import Statics, statics
from ccd_casadi.synthesis.synthesis import DesignFigures

# A reduced controller keeps S_max to 0.5 % (it binds at most optima, where any change passes it a
# little), S_low, 99 % of ω_b, and no gain more than twice the bound that γ puts on it.
REDUCED_PEAK, REDUCED_NORM, REDUCED_BANDWIDTH = 1.005, 2.0, 0.99
STRICT = 1e-6  # relative: S_max kept as the design itself keeps it
# The sampled loop keeps S_max to 5 % and ω_b to 3 %.
SAMPLED_PEAK, SAMPLED_BANDWIDTH = 1.05, 0.03
LEAST_RATE = 4.0  # samples in a period of ω_b
ADDED = 5  # plants between those of the case's set that may be added to it for the rate


@dataclass(frozen=True)
class ChannelOrders:
    """A channel's controllers of every order; the one chosen, and the least that keeps S_max."""

    channel: Channel
    rows: tuple[Reduced, ...]
    chosen: Reduced
    strict: Reduced


@dataclass(frozen=True)
class Trial:
    """A way to discretise, the rate in Hz that it needs (None: no rate will do).

    `there` is the worst loop of the set at a rate that was given, None where none was.
    """

    conversion: Conversion
    needed_hz: float | None
    there: SampledFigures | None = None


@dataclass(frozen=True)
class Deployment:
    """Everything that was found out on the way from a run's controller to the deployed one.

    `sampled` are the exact figures of the sampled loop on the nominal plant, `measured` those of
    its simulation (None where it is unstable on any plant); `members` and `measured_members` those
    on every other plant of the run's [robust] set. `unverified`: why the run itself is not
    verified, empty where it is.
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
    members: tuple[MemberLoop, ...] = ()
    measured_members: tuple[tuple[Perturbation, MeasuredSensitivity], ...] = ()
    unverified: str = ""
    statics: Statics | None = None

    @property
    def order(self) -> int:
        """States of the reduced controller."""
        return len(self.reduced.A)

    @property
    def needed_hz(self) -> float | None:
        """The rate that the chosen method needs."""
        return next(t.needed_hz for t in self.trials if t.conversion == self.conversion)

    @property
    def stable(self) -> bool:
        """Whether the sampled loop is stable on every plant."""
        return self.sampled.stable and all(item.figures.stable for item in self.members)

    @property
    def worst(self) -> MemberLoop:
        """The plant with the largest peak of the sampled S, the nominal one among them."""
        nominal = MemberLoop(Perturbation(), self.sampled)
        return max((nominal, *self.members), key=lambda item: item.badness)

    @property
    def shortfalls(self) -> tuple[str, ...]:
        """What is not kept, on which plant, with its figure; empty where all is."""
        found = []
        for item in (MemberLoop(Perturbation(), self.sampled), *self.members):
            nominal = item.at == Perturbation()
            if not (self.target.met if nominal else self.target.held)(item.figures):
                found.append((item.badness, f"{_fault(self, item)} ({place_words(item.at)})"))
        words = [w for _, w in sorted(found, key=lambda pair: -pair[0])]
        if words or self.measured is None:
            return tuple(words)
        pairs = [(Perturbation(), self.measured), *self.measured_members]
        return tuple(
            f"the simulation has a peak of S of {m.sensitivity_peak:.6g} and a bandwidth of "
            f"{m.bandwidth / HZ:.6g} Hz ({place_words(at)})"
            for at, m in pairs
            if not (self.target.met if at == Perturbation() else self.target.held)(_as_figures(m))
        )

    @property
    def passed(self) -> bool:
        """Whether every sampled loop keeps its target, exactly and simulated, of a verified run."""
        return not self.shortfalls and not self.unverified


def _fault(found: Deployment, item: MemberLoop) -> str:
    f = item.figures
    if not f.stable:
        return f"unstable: spectral radius {f.spectral_radius:.6g}"
    if f.sensitivity_peak > found.target.peak:
        return f"peak of S {missed_by(f.sensitivity_peak, found.target.peak / SAMPLED_PEAK)}"
    change = 100.0 * (f.bandwidth / found.target.bandwidth - 1.0)
    return f"bandwidth {f.bandwidth / HZ:.6g} Hz ({change:+.2f} %)"


def _as_figures(m: MeasuredSensitivity) -> SampledFigures:
    return SampledFigures(
        True, np.nan, m.sensitivity_peak, m.sensitivity_peak_frequency, m.bandwidth
    )


def deploy(
    run: FinishedRun,
    timing: Timing,
    *,
    saturation: float | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda words: None,
) -> Deployment:
    """Reduce, discretise and verify the controller of a run; `progress` is told each step.

    All of it on the nominal plant and on every plant of the run's [robust] set. Raises UserError
    where no sampling rate is enough, or the given one is no rate for this loop.
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
    family, dense = members(run), members(run, dense=True)
    orders = tuple(
        _orders(run, c, family, limits, progress) for c in split(run.plant, run.controller)
    )
    channels = [item.channel for item in orders]
    small = [item.chosen.controller for item in orders]
    reduced = assemble(channels, small)
    reduced_figures = measure(
        run.plant, reduced, run.weights, gamma=UNBOUNDED, omega_low=inner.omega_low
    )
    target = Target(SAMPLED_PEAK * inner.S_max, full.bandwidth, SAMPLED_BANDWIDTH)
    conversions = _conversions(timing, full.sensitivity_peak_frequency)
    loops = _Loops(channels, small, target)
    for attempt in range(1 + ADDED):
        trials, best, rate = _choose(run, timing, loops, family, conversions, progress, attempt)
        delay, period = timing.delay_at(rate), 1.0 / rate
        sampled_controllers = [discretise(K, best.conversion, period, delay) for K in small]
        realisation = limited(realise(channels, sampled_controllers, saturation), full.bandwidth)
        held = sampled_plant(run.plant.plant_si(), period, delay)
        sampled = sampled_figures(sensitivity_loop(held, realisation.system))
        others = {item.at: sampled_plant(item.plant.plant_si(), period, delay) for item in dense}
        checked = [
            MemberLoop(at, sampled_figures(sensitivity_loop(other, realisation.system)))
            for at, other in others.items()
        ]
        outside = max((m for m in checked if not target.held(m.figures)), default=None,
                      key=lambda m: m.badness)  # fmt: skip
        if timing.rate_hz is not None or outside is None:
            break
        # between the plants of the case's set the peak is larger: that plant counts from now on
        family = (*family, *(item for item in dense if item.at == outside.at))
    progress("simulation")
    measured: MeasuredSensitivity | None = None
    simulated: tuple[tuple[Perturbation, MeasuredSensitivity], ...] = ()
    if sampled.stable and all(item.figures.stable for item in checked):
        shown = {item.at for item in family}
        if checked:
            shown.add(max(checked, key=lambda m: m.badness).at)
        chosen = {at: other for at, other in others.items() if at in shown}
        measured, *rest = measure_set(
            [held, *chosen.values()], realisation.system, full.bandwidth, seed
        )
        simulated = tuple(zip(chosen, rest, strict=True))
    return Deployment(
        orders, limits, reduced, reduced_figures, trials, target, rate, delay,
        best.conversion, held, realisation, sampled, measured, tuple(checked), simulated,
        _unverified(run), _statics(run, realisation.system),
    )  # fmt: skip


def _unverified(run: FinishedRun) -> str:
    """Why the run is not verified; empty where it is, or where no run is behind the design."""
    status = run.result.get("status", "verified")
    return "" if status == "verified" else str(run.result.get("reason") or status)


def _statics(run: FinishedRun, K: DiscreteStateSpace) -> Statics:
    return statics(
        run.plant.plant_si(), StateSpace(K.A, K.B, K.C, K.D), bandwidth=run.figures.bandwidth,
        omega_low=run.problem.inner.omega_low, period=K.period,
    )  # fmt: skip


class _Loops:
    """The sampled loops of all channels on the nominal plant and on members of its set."""

    def __init__(
        self, channels: Sequence[Channel], controllers: Sequence[StateSpace], target: Target
    ) -> None:
        self.channels, self.controllers, self.target = channels, controllers, target

    def at(
        self, conversion: Conversion, rate: float, delay: float, member: Member | None = None
    ) -> SampledFigures:
        plants = [c.plant if member is None else member.seen_by(c) for c in self.channels]
        return together(
            [
                loop_at(plant.plant_si(), K, conversion, 1.0 / rate, delay)
                for plant, K in zip(plants, self.controllers, strict=True)
            ]
        )

    def held(self, conversion: Conversion, rate: float, delay: float) -> Callable[[Member], bool]:
        """Whether the loop on a member is stable within the peak."""
        return lambda member: self.target.held(self.at(conversion, rate, delay, member))


def _choose(
    run: FinishedRun, timing: Timing, loops: _Loops, family: tuple[Member, ...],
    conversions: Sequence[Conversion], progress: Callable[[str], None], attempt: int,
) -> tuple[tuple[Trial, ...], Trial, float]:  # fmt: skip
    """Every way with the rate that it needs, the one to take, and the rate to take it at.

    At a given rate that is the way that keeps the target there and needs least, or where none
    does the one that comes nearest. Raises UserError where there is none.
    """
    bandwidth_hz = run.figures.bandwidth / HZ
    trials = []
    for conversion in conversions:
        again = f", once more for a plant in between ({attempt})" if attempt else ""
        progress(f"rate for {conversion.label}{again}")
        order = WorstFirst(family)

        def met(
            rate: float, conversion: Conversion = conversion, order: WorstFirst = order
        ) -> bool:
            delay = timing.delay_at(rate)
            nominal = loops.at(conversion, rate, delay)
            return loops.target.met(nominal) and order.all(loops.held(conversion, rate, delay))

        also = () if timing.rate_hz is None else (timing.rate_hz,)
        needed = needed_rate(met, bandwidth_hz, also)
        there = None
        if timing.rate_hz is not None:
            delay = timing.delay_at(timing.rate_hz)
            there = max(
                (loops.at(conversion, timing.rate_hz, delay, item) for item in (None, *family)),
                key=_badness,
            )
        trials.append(Trial(conversion, needed, there))
    least = min(trials, key=_needed)
    if timing.rate_hz is None:
        if least.needed_hz is None:
            words = f"no sampling rate up to {FASTEST * bandwidth_hz:.3g} Hz keeps S_max to 5 %"
            where = " on all plants of its [robust] set" if family else ""
            raise UserError(
                f"{run.folder}: {words} and omega_b to 3 %{where} with this delay; shorten it"
            )
        return tuple(trials), least, nice_rate(least.needed_hz)
    possible = [t for t in trials if t.conversion.defined(1.0 / timing.rate_hz)]
    if not possible:
        peak_hz = run.figures.sensitivity_peak_frequency / HZ
        raise UserError(
            f"--rate-hz {timing.rate_hz:g}: --method prewarped is exact at the peak of S, "
            f"{peak_hz:.4g} Hz, which half the rate has to exceed; sample faster, or choose "
            "another --method"
        )
    enough = [t for t in possible if _needed(t) <= timing.rate_hz]
    best = min(enough, key=_needed) if enough else min(possible, key=lambda t: _badness(t.there))
    return tuple(trials), best, timing.rate_hz


def _needed(trial: Trial) -> float:
    return np.inf if trial.needed_hz is None else trial.needed_hz


def _badness(figures: SampledFigures | None) -> float:
    if figures is None:
        return np.inf
    return figures.sensitivity_peak if figures.stable else 1e9 * figures.spectral_radius


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
    single = discretise(K, best.conversion, period, delay)
    realisation = limited(realise([channel], [single], saturation), full.bandwidth)
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
    run: FinishedRun,
    channel: Channel,
    family: tuple[Member, ...],
    limits: Limits,
    progress: Callable[[str], None],
) -> ChannelOrders:
    progress(f"orders of channel {channel.name}")
    inner = run.problem.inner
    rows = reductions(channel, run.weights, inner.omega_low)
    strict = replace(limits, peak=inner.S_max * (1.0 + STRICT))
    order = WorstFirst(family)

    def holds(peak: float) -> Callable[[Reduced], bool]:
        def on(member: Member, row: Reduced) -> bool:
            figures = measure(
                member.seen_by(channel), row.controller, run.weights, gamma=UNBOUNDED,
                omega_low=inner.omega_low,
            )  # fmt: skip
            return figures.certificate.stable and figures.sensitivity_peak <= peak

        return lambda row: order.all(lambda member: on(member, row))

    return ChannelOrders(
        channel,
        tuple(rows),
        smallest(rows, limits, holds(limits.peak)),
        smallest(rows, strict, holds(strict.peak)),
    )


def _conversions(timing: Timing, peak_frequency: float) -> list[Conversion]:
    methods = list(Discretisation) if timing.method is None else [timing.method]
    leads = [False, True] if timing.lead is None else [timing.lead]
    return [Conversion(method, lead, peak_frequency) for method in methods for lead in leads]
