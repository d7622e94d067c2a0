"""Sections are deployed as they were designed: nothing is reduced, and the rate is the case's."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.channels import Channel, split
from ccd_casadi.deployment.discretise import Conversion, Target, loop_at
from ccd_casadi.deployment.judgement import SampledSet
from ccd_casadi.deployment.outcome import (
    SAMPLED_BANDWIDTH,
    SAMPLED_EXCESS,
    ChannelOrders,
    Deployment,
    Trial,
)
from ccd_casadi.deployment.rate_choice import ChannelLoops, choose, conversions_of
from ccd_casadi.deployment.reduction import Limits, Reduced, Reduction
from ccd_casadi.deployment.robust_set import WorstFirst, section_members
from ccd_casadi.deployment.timing import Discretisation, Timing
from ccd_casadi.fixed_structure import Sampling, Structure
from ccd_casadi.fixed_structure.structure import state_space
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, sections_of_problem, structure_of
from ccd_casadi.support.errors import UserError
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED

DESIGNED_EXCESS = 1e-3  # of S_max: of a loop that was designed as sampled


def deploy_as_designed(
    run: FinishedRun, timing: Timing, saturation: float | None, progress: Callable[[str], None]
) -> Deployment:
    """The sections as they are: nothing is reduced, at the case's rate and delay by Tustin's rule.

    Where the case gives no rate, the one that is needed is searched as for any controller.
    """
    inner, full, K = run.problem.inner, run.figures, run.controller
    designed = run.problem.sampling
    _require_own_bounds(run, designed, timing)
    p, m = len(run.plant.C), run.plant.B.shape[1]
    whole = Channel("all", np.eye(p), np.eye(m), run.plant, K)
    family, dense = section_members(run), section_members(run, dense=True)
    tustin = Conversion(Discretisation.TUSTIN, False)
    trials: tuple[Trial, ...]
    if designed is None:
        target = Target(inner.S_max, SAMPLED_EXCESS, full.bandwidth, SAMPLED_BANDWIDTH)
        loops, conversions = ChannelLoops([whole], [K], target), conversions_of(timing)
        remedy = "shorten it, or design for it with loop.rate_hz and loop.delay_us in the case"
        trials, best, rate = choose(run, timing, loops, family, conversions, progress,
                                    remedy=remedy)  # fmt: skip
    else:
        # What was designed is the sampled loop: that is what a given rate or delay is held against.
        own = loop_at(run.plant.plant_si(), K, tustin, designed.period, designed.delay)
        target = Target(inner.S_max, DESIGNED_EXCESS, own.bandwidth, SAMPLED_BANDWIDTH)
        rate = timing.rate_hz or designed.rate_hz
        if timing.delay is None and timing.delay_samples == Timing.delay_samples:
            timing = replace(timing, delay=designed.delay)
        progress(f"rate for {tustin.label}")
        met = ChannelLoops([whole], [K], target).met(tustin, rate, timing, WorstFirst(family))
        best = Trial(tustin, rate if met else designed.rate_hz)
        trials = (best,)
    plants = SampledSet(
        run, dense, _channels(run), best.conversion, rate, timing.delay_at(rate), saturation
    )
    return plants.deployment(
        Limits(inner.S_max, inner.S_low, np.inf, full.bandwidth), K, full, trials, target,
        sections_of_problem(run.problem).compliance_max,
    )  # fmt: skip


def _require_own_bounds(run: FinishedRun, designed: Sampling | None, timing: Timing) -> None:
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


def _channels(run: FinishedRun) -> tuple[ChannelOrders, ...]:
    """The sections of every channel as they are; figures of each on its own entry of the plant."""
    structure, kappa = structure_of(run.problem), run.kappa
    assert kappa is not None
    if isinstance(structure, Structure):
        channel = split(run.plant, run.controller)[0]
        whole = Reduced(len(run.controller.A), Reduction.NONE, run.controller, run.figures)
        return (ChannelOrders(channel, (whole,), whole, whole, (structure, kappa)),)
    found = []
    for i, (own, values) in enumerate(structure.split(kappa)):
        u, v = structure.decoupling.outputs[:, [i]], structure.decoupling.inputs[:, [i]]
        plant = replace(run.plant, B=run.plant.B @ v, C=u.T @ run.plant.C, channels=())
        K = state_space(own, values)
        channel = Channel(structure.decoupling.names[i], u, v, plant, K)
        figures = measure(
            plant, K, run.weights, gamma=UNBOUNDED, omega_low=run.problem.inner.omega_low
        )
        alone = Reduced(len(K.A), Reduction.NONE, K, figures)
        found.append(ChannelOrders(channel, (alone,), alone, alone, (own, values)))
    return tuple(found)
