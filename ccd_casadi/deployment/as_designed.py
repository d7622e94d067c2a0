"""Sections are deployed as they were designed: nothing is reduced, and the rate is the case's."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.channels import Channel, split
from ccd_casadi.deployment.discretise import (
    FASTEST,
    Conversion,
    Target,
    loop_at,
    needed_rate,
    nice_rate,
)
from ccd_casadi.deployment.judgement import SampledSet
from ccd_casadi.deployment.outcome import (
    SAMPLED_BANDWIDTH,
    SAMPLED_EXCESS,
    ChannelOrders,
    Deployment,
    Trial,
)
from ccd_casadi.deployment.rate_choice import conversions_of
from ccd_casadi.deployment.reduction import Limits, Reduced, Reduction
from ccd_casadi.deployment.robust_set import WorstFirst, section_members
from ccd_casadi.deployment.sampled import SampledFigures
from ccd_casadi.deployment.timing import Discretisation, Timing
from ccd_casadi.fixed_structure import Sampling, Structure
from ccd_casadi.fixed_structure.structure import state_space
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, sections_of_problem, structure_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED

DESIGNED_EXCESS = 1e-3  # of S_max: of a loop that was designed as sampled


def deploy_as_designed(
    run: FinishedRun,
    timing: Timing,
    saturation: float | None,
    seed: int,
    progress: Callable[[str], None],
) -> Deployment:
    """The sections as they are: nothing is reduced, at the case's rate and delay by Tustin's rule.

    Where the case gives no rate, the one that is needed is searched as for any controller.
    """
    inner, full, K = run.problem.inner, run.figures, run.controller
    G, designed = run.plant.plant_si(), run.problem.sampling
    _require_own_bounds(run, designed, timing)
    orders = _channels(run)
    limits = Limits(inner.S_max, inner.S_low, np.inf, full.bandwidth)
    tustin = Conversion(Discretisation.TUSTIN, False, full.sensitivity_peak_frequency)
    if designed is None:
        progress("rate")
        bandwidth, conversions = full.bandwidth, conversions_of(timing, tustin.warp)
        target = Target(inner.S_max, SAMPLED_EXCESS, bandwidth, SAMPLED_BANDWIDTH)
    else:
        # What was designed is the sampled loop: that is what a given rate or delay is held against.
        conversions = [tustin]
        own = loop_at(G, K, tustin, designed.period, designed.delay)
        bandwidth = own.bandwidth
        target = Target(inner.S_max, DESIGNED_EXCESS, bandwidth, SAMPLED_BANDWIDTH)
        timing = replace(timing, rate_hz=timing.rate_hz or designed.rate_hz)
        if timing.delay is None and timing.delay_samples == Timing.delay_samples:
            timing = replace(timing, delay=designed.delay)
    trials = []
    family, dense = section_members(run), section_members(run, dense=True)
    for conversion in conversions:
        progress(f"rate for {conversion.label}")
        order = WorstFirst(family)

        def met(
            rate: float, conversion: Conversion = conversion, order: WorstFirst = order
        ) -> bool:
            def loop(plant: StateSpace) -> SampledFigures:
                return loop_at(plant, K, conversion, 1.0 / rate, timing.delay_at(rate))

            return target.met(loop(G)) and order.all(
                lambda member: target.held(loop(member.plant.plant_si()))
            )

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
    plants = SampledSet(
        run, dense, orders, best.conversion, rate, timing.delay_at(rate), saturation
    )
    progress("simulation")
    return plants.deployment(
        limits, K, full, trials, target, seed=seed,
        compliance_max=sections_of_problem(run.problem).compliance_max,
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
