"""Certified controller → reduced → sampled → verified → realised."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.as_designed import at_its_rate, designed_channels, require_own_bounds
from ccd_casadi.deployment.channels import LoopChannel, assemble, scalar_channels, whole_loop
from ccd_casadi.deployment.discretise import Conversion, Target
from ccd_casadi.deployment.judgement import assess
from ccd_casadi.deployment.outcome import (
    SAMPLED_BANDWIDTH,
    SAMPLED_EXCESS,
    ChannelOrders,
    Deployment,
)
from ccd_casadi.deployment.rate_choice import choose
from ccd_casadi.deployment.reduction import LoopLimits, ReducedController, reductions, smallest
from ccd_casadi.deployment.robust_set import Member, WorstFirst, members
from ccd_casadi.deployment.timing import Timing
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.statics import compliance_of

# A reduced controller keeps S_max and a bound on the compliance to 0.5 % (they bind at most optima,
# where any change passes them a little), S_low, 99 % of ω_b, and no gain more than twice the bound
# that γ puts on it.
REDUCED_PEAK, REDUCED_NORM, REDUCED_BANDWIDTH = 1.005, 2.0, 0.99
STRICT = 1e-6  # relative: S_max kept as the design itself keeps it
LEAST_RATE = 4.0  # samples in a period of ω_b
SHORTEN_IT = "shorten it"
DESIGN_FOR_IT = "shorten it, or design for it with loop.rate_hz and loop.delay_us in the case"
ADDED = 5  # plants between those of the case's set that may be added to it for the rate


def deploy(
    run: FinishedRun,
    timing: Timing,
    *,
    saturation: float | None = None,
    progress: Callable[[str], None] = lambda words: None,
) -> Deployment:
    """Reduce, discretise and verify the controller of a run.

    All of it on the nominal plant and on every plant of the run's [robust] set. Sections are
    deployed as they are: nothing is reduced, and where the case gives a rate it is that, by
    Tustin's rule.

    Parameters
    ----------
    run : FinishedRun
        As `read_run` gives it.
    timing : Timing
        Rate and delay, where they are given.
    saturation, progress : float, callable
        Largest force, N; is given a line at each step.

    Returns
    -------
    Deployment

    Raises
    ------
    UserError
        No sampling rate is enough, or the given one is no rate for this loop.
    """
    inner, full, K = run.problem.inner, run.figures, run.controller
    designed, family, dense = run.problem.sampling, members(run), members(run, dense=True)
    target = Target(inner.S_max, SAMPLED_EXCESS, full.bandwidth, SAMPLED_BANDWIDTH)
    if kind_of(run.problem).as_designed:
        require_own_bounds(run, designed, timing)
        limits, remedy = LoopLimits(inner.S_max, inner.S_low, np.inf, full.bandwidth), DESIGN_FOR_IT
        orders, channels, small = designed_channels(run), whole_loop(run.plant, K), [K]
        reduced, figures = K, full
    else:
        if timing.rate_hz is not None and timing.rate_hz < LEAST_RATE * full.bandwidth / HZ:
            words = f"is less than {LEAST_RATE:g} times the bandwidth, {full.bandwidth / HZ:.4g} Hz"
            raise UserError(f"--rate-hz {timing.rate_hz:g}: {words}; sample faster")
        remedy = SHORTEN_IT
        limits = LoopLimits(
            REDUCED_PEAK * inner.S_max, inner.S_low * (1.0 + STRICT), REDUCED_NORM * full.gamma,
            REDUCED_BANDWIDTH * full.bandwidth,
        )  # fmt: skip
        orders = tuple(
            _orders(run, c, family, limits, progress) for c in scalar_channels(run.plant, K)
        )
        channels = tuple(item.channel for item in orders)
        small = [item.chosen.controller for item in orders]
        reduced = assemble(channels, small)
        figures = run.measured(run.plant, reduced)
    way: dict[str, Any] = {"limits": limits, "reduced": reduced, "reduced_figures": figures}
    if designed is not None:
        progress("the rate of the case")
        target, own_hz, rate, delay = at_its_rate(run, channels, family, designed, timing)
        way |= {"needed_hz": own_hz, "target": target}
        return assess(run, dense, orders, Conversion.TUSTIN, rate, delay, saturation, way)
    loops = list(zip(channels, small, strict=True))
    for attempt in range(1 + ADDED):
        conversion, needed, rate = choose(
            run, timing, loops, target, family, progress, attempt, remedy
        )
        way |= {"needed_hz": needed, "target": target}
        found = assess(run, dense, orders, conversion, rate, timing.delay_at(rate), saturation, way)
        outside = max((m for m in found.members if not target.held(m.figures)),
                      default=None, key=lambda m: m.badness)  # fmt: skip
        if timing.rate_hz is not None or outside is None:
            break
        # between the plants of the case's set the peak is larger: that plant counts from now on
        family = (*family, *(item for item in dense if item.at == outside.at))
    return found


def _orders(
    run: FinishedRun,
    channel: LoopChannel,
    family: tuple[Member, ...],
    limits: LoopLimits,
    progress: Callable[[str], None],
) -> ChannelOrders:
    progress(f"orders of channel {channel.name}")
    inner, most = run.problem.inner, run.problem.inner.compliance_max
    rows = reductions(channel, run.weights, inner.omega_low)
    strict = replace(limits, peak=inner.S_max * (1.0 + STRICT))
    order = WorstFirst(family)

    def compliant(plant: ScaledPlant, row: ReducedController) -> bool:
        return most is None or compliance_of(plant, row.controller).gain <= REDUCED_PEAK * most

    def holds(peak: float) -> Callable[[ReducedController], bool]:
        def on(member: Member, row: ReducedController) -> bool:
            plant = member.seen_by(channel)
            figures = run.measured(plant, row.controller)
            kept = figures.certificate.stable and figures.sensitivity_peak <= peak
            return kept and compliant(plant, row)

        return lambda row: (
            compliant(channel.plant, row) and order.all(lambda member: on(member, row))
        )

    return ChannelOrders(
        channel,
        tuple(rows),
        smallest(rows, limits, holds(limits.peak)),
        smallest(rows, strict, holds(strict.peak)),
    )
