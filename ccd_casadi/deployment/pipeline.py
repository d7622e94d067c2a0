"""Certified controller → reduced → sampled → verified → realised."""

from collections.abc import Callable
from dataclasses import replace

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.as_designed import deploy_as_designed
from ccd_casadi.deployment.channels import Channel, assemble, split
from ccd_casadi.deployment.discretise import Target
from ccd_casadi.deployment.judgement import SampledSet
from ccd_casadi.deployment.outcome import (
    SAMPLED_BANDWIDTH,
    SAMPLED_EXCESS,
    ChannelOrders,
    Deployment,
)
from ccd_casadi.deployment.rate_choice import ChannelLoops, choose, conversions_of
from ccd_casadi.deployment.reduction import Limits, Reduced, reductions, smallest
from ccd_casadi.deployment.robust_set import Member, WorstFirst, members
from ccd_casadi.deployment.timing import Timing
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.statics import compliance_of
from ccd_casadi.synthesis.synthesis import UNBOUNDED

# A reduced controller keeps S_max and a bound on the compliance to 0.5 % (they bind at most optima,
# where any change passes them a little), S_low, 99 % of ω_b, and no gain more than twice the bound
# that γ puts on it.
REDUCED_PEAK, REDUCED_NORM, REDUCED_BANDWIDTH = 1.005, 2.0, 0.99
STRICT = 1e-6  # relative: S_max kept as the design itself keeps it
LEAST_RATE = 4.0  # samples in a period of ω_b
ADDED = 5  # plants between those of the case's set that may be added to it for the rate


def deploy(
    run: FinishedRun,
    timing: Timing,
    *,
    saturation: float | None = None,
    progress: Callable[[str], None] = lambda words: None,
) -> Deployment:
    """Reduce, discretise and verify the controller of a run; `progress` is called at each step.

    All of it on the nominal plant and on every plant of the run's [robust] set. Raises UserError
    where no sampling rate is enough, or the given one is no rate for this loop.
    """
    if kind_of(run.problem).as_designed:
        return deploy_as_designed(run, timing, saturation, progress)
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
    target = Target(inner.S_max, SAMPLED_EXCESS, full.bandwidth, SAMPLED_BANDWIDTH)
    conversions = conversions_of(timing)
    loops = ChannelLoops(channels, small, target)
    for attempt in range(1 + ADDED):
        trials, best, rate = choose(run, timing, loops, family, conversions, progress, attempt)
        plants = SampledSet(
            run, dense, orders, best.conversion, rate, timing.delay_at(rate), saturation
        )
        outside = max((m for m in plants.checked if not target.held(m.figures)),
                      default=None, key=lambda m: m.badness)  # fmt: skip
        if timing.rate_hz is not None or outside is None:
            break
        # between the plants of the case's set the peak is larger: that plant counts from now on
        family = (*family, *(item for item in dense if item.at == outside.at))
    return plants.deployment(limits, reduced, reduced_figures, trials, target, inner.compliance_max)


def _orders(
    run: FinishedRun,
    channel: Channel,
    family: tuple[Member, ...],
    limits: Limits,
    progress: Callable[[str], None],
) -> ChannelOrders:
    progress(f"orders of channel {channel.name}")
    inner, most = run.problem.inner, run.problem.inner.compliance_max
    rows = reductions(channel, run.weights, inner.omega_low)
    strict = replace(limits, peak=inner.S_max * (1.0 + STRICT))
    order = WorstFirst(family)

    def compliant(plant: ScaledPlant, row: Reduced) -> bool:
        return most is None or compliance_of(plant, row.controller).gain <= REDUCED_PEAK * most

    def holds(peak: float) -> Callable[[Reduced], bool]:
        def on(member: Member, row: Reduced) -> bool:
            plant = member.seen_by(channel)
            figures = measure(
                plant, row.controller, run.weights, gamma=UNBOUNDED, omega_low=inner.omega_low
            )
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
