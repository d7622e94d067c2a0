"""Sections are deployed as they were designed: nothing is reduced, and the rate is the case's."""

from dataclasses import replace

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.channels import LoopChannel, along_directions, scalar_channels
from ccd_casadi.deployment.discretise import Conversion, Target, loop_at
from ccd_casadi.deployment.outcome import SAMPLED_BANDWIDTH, ChannelOrders
from ccd_casadi.deployment.rate_choice import loops_meet
from ccd_casadi.deployment.reduction import ReducedController, Reduction
from ccd_casadi.deployment.robust_set import Member, WorstFirst
from ccd_casadi.deployment.timing import Timing
from ccd_casadi.fixed_structure import Sampling, Structure
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of
from ccd_casadi.support.errors import UserError

DESIGNED_EXCESS = 1e-3  # of S_max: of a loop that was designed as sampled


def at_its_rate(
    run: FinishedRun, channels: tuple[LoopChannel, ...], family: tuple[Member, ...],
    designed: Sampling, timing: Timing,
) -> tuple[Target, float, float, float]:  # fmt: skip
    """Target, the rate that is needed by Tustin's rule, and the rate and delay to run at.

    What was designed is the sampled loop: that is what a given rate or delay is held against.
    """
    tustin, rate = Conversion.TUSTIN, timing.rate_hz or designed.rate_hz
    plant = run.plant.plant_si()
    own = loop_at(plant, run.controller, tustin, designed.period, designed.delay)
    target = Target(run.problem.inner.S_max, DESIGNED_EXCESS, own.bandwidth, SAMPLED_BANDWIDTH)
    if timing.delay is None and timing.delay_samples == Timing.delay_samples:
        timing = replace(timing, delay=designed.delay)
    loops = [(channel, run.controller) for channel in channels]
    met = loops_meet(loops, target, tustin, rate, timing, WorstFirst(family))
    needed = rate if met else designed.rate_hz
    return target, needed, rate, timing.delay_at(rate)


def require_own_bounds(run: FinishedRun, designed: Sampling | None, timing: Timing) -> None:
    """Raise UserError where single channels have bounds that a loop other than that designed may
    pass: figures of sampled loops here are of the whole."""
    if not any(own.given for own in bounds_of(run.problem).channels):
        return
    words = f"{run.folder}: channels have bounds of their own, which are judged as designed alone"
    if designed is None:
        raise UserError(f"{words}; give loop.rate_hz in the case, solve it and deploy that")
    asked = timing.delay_at(timing.rate_hz or designed.rate_hz)
    default = timing.delay is None and timing.delay_samples == Timing.delay_samples
    if timing.rate_hz not in (None, designed.rate_hz) or not (default or asked == designed.delay):
        raise UserError(f"{words}; leave out the rate and the delay, which are then the case's")


def designed_channels(run: FinishedRun) -> tuple[ChannelOrders, ...]:
    """The sections of every channel as they are; figures of each on its own entry of the plant."""
    structure, kappa = structure_of(run.problem), run.kappa
    assert kappa is not None
    if isinstance(structure, Structure):
        channel = scalar_channels(run.plant, run.controller)[0]
        parts = [(channel, structure, kappa)]
    else:
        decoupling, parts = structure.decoupling, []
        for i, (own, values) in enumerate(structure.split(kappa)):
            u, v = decoupling.outputs[:, [i]], decoupling.inputs[:, [i]]
            plant, K = along_directions(run.plant, u, v), own.state_space(values)
            parts.append((LoopChannel(decoupling.names[i], u, v, plant, K), own, values))
    found = []
    for channel, own, values in parts:
        K = channel.controller
        figures = run.measured(channel.plant, K)
        alone = ReducedController(len(K.A), Reduction.NONE, K, figures)
        found.append(ChannelOrders(channel, (alone,), alone, alone, (own, values)))
    return tuple(found)
