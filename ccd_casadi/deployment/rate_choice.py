"""Which way of discretising to take, and at which rate."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.channels import Channel
from ccd_casadi.deployment.discretise import (
    FASTEST,
    Conversion,
    Target,
    loop_at,
    needed_rate,
    nice_rate,
)
from ccd_casadi.deployment.outcome import Trial
from ccd_casadi.deployment.robust_set import Member, WorstFirst
from ccd_casadi.deployment.timing import Discretisation, Timing
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.robust.sampled import SampledFigures, together
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ


class ChannelLoops:
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

    def met(self, conversion: Conversion, rate: float, timing: Timing, order: WorstFirst) -> bool:
        """Whether the nominal loop meets the target at a rate, and those of all members hold it."""
        delay = timing.delay_at(rate)

        def held(member: Member) -> bool:
            return self.target.held(self.at(conversion, rate, delay, member))

        return self.target.met(self.at(conversion, rate, delay)) and order.all(held)


def choose(
    run: FinishedRun, timing: Timing, loops: ChannelLoops, family: tuple[Member, ...],
    conversions: Sequence[Conversion], progress: Callable[[str], None], attempt: int = 0,
    remedy: str = "shorten it",
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
        met = partial(loops.met, conversion, timing=timing, order=WorstFirst(family))
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
                f"{run.folder}: {words} and omega_b to 3 %{where} with this delay; {remedy}"
            )
        return tuple(trials), least, nice_rate(least.needed_hz)
    enough = [t for t in trials if _needed(t) <= timing.rate_hz]
    best = min(enough, key=_needed) if enough else min(trials, key=lambda t: _badness(t.there))
    return tuple(trials), best, timing.rate_hz


def conversions_of(timing: Timing) -> list[Conversion]:
    """Every method, with and without a lead, or those that the options name."""
    methods = list(Discretisation) if timing.method is None else [timing.method]
    leads = [False, True] if timing.lead is None else [timing.lead]
    return [Conversion(method, lead) for method in methods for lead in leads]


def _needed(trial: Trial) -> float:
    return np.inf if trial.needed_hz is None else trial.needed_hz


def _badness(figures: SampledFigures | None) -> float:
    if figures is None:
        return np.inf
    return figures.sensitivity_peak if figures.stable else 1e9 * figures.spectral_radius
