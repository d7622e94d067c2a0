"""Certified controller → reduced → sampled → verified → realised; sections are deployed as
designed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_channels import (
    LoopChannel,
    along_directions,
    loop_figures,
    scalar_channels,
    whole_loop,
)
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.analysis.setpoint_feedforward import forward_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.discretise import (
    Conversion,
    LoopLimits,
    ReducedController,
    Reduction,
    Target,
    choose,
    discretise,
    loop_at,
    loops_meet,
    reductions,
    smallest,
)
from ccd_casadi.deployment.fixed_point import FixedRequest, in_fixed
from ccd_casadi.deployment.integer_loop import ranges_of_moves, rounding_bound
from ccd_casadi.deployment.outcome import ChannelOrders, Deployment
from ccd_casadi.deployment.realisation import (
    Realisation,
    assemble,
    in_single,
    realise,
    with_anti_windup,
)
from ccd_casadi.deployment.robust_set import (
    Member,
    MemberLoop,
    WorstFirst,
    as_written,
    forced_model,
    members,
)
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.judgement import Judgement, attempt_judgement, judge_loops
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.norms import worst_between
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.robust.perturbed import sampled_compliance
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ, plural
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.statics import compliance_of, statics_of


@dataclass(frozen=True)
class DeploymentOptions:
    """The tolerances within which the deployed loop keeps the figures of the designed one.

    A reduced controller keeps S_max and a bound on the compliance to 0.5 %: they bind at most
    optima, where any change exceeds them a little.
    """

    sampled_excess: float = 0.05  # of S_max, relative: of the sampled loop
    sampled_bandwidth: float = 0.03  # of ω_b, relative
    designed_excess: float = 1e-3  # of S_max, relative: of a loop that was designed as sampled
    reduced_peak: float = 1.005  # over S_max: of the loop with a reduced controller
    reduced_bandwidth: float = 0.99  # over ω_b
    reduced_norm: float = 2.0  # largest weighted norm over the γ of the design
    strict: float = 1e-6  # relative: S_max kept as the design itself keeps it
    least_rate: float = 4.0  # samples in a period of ω_b
    added_plants: int = 5  # between those of the case's set, that may be added to it for the rate


def at_its_rate(
    run: FinishedRun, channels: tuple[LoopChannel, ...], family: tuple[Member, ...],
    designed: Sampling, timing: Timing, options: DeploymentOptions = DeploymentOptions(),
) -> tuple[Target, float | None, float, float]:  # fmt: skip
    """Target, the rate that is enough by Tustin's rule, and the rate and delay to run at.

    What was designed is the sampled loop: a given rate or delay is compared with that. Enough is
    the rate at which it runs or that of the design, with this delay; else None.
    """
    tustin, rate = Conversion.TUSTIN, timing.rate_hz or designed.rate_hz
    plant = run.plant.plant_si()
    own = loop_at(
        plant,
        run.controller,
        tustin,
        designed.period,
        designed.delay,
        kind_of(run.problem).bounds().places,
    )
    excess, tolerance = options.designed_excess, options.sampled_bandwidth
    target = Target(run.problem.inner.S_max, excess, own.bandwidth, tolerance)
    if timing.delay is None and timing.delay_samples == Timing.delay_samples:
        timing = replace(timing, delay=designed.delay)
    loops = [(channel, run.controller) for channel in channels]
    order = WorstFirst(family)
    tried = dict.fromkeys((rate, designed.rate_hz))
    enough = (hz for hz in tried if loops_meet(loops, target, tustin, hz, timing, order))
    needed = next(enough, None)
    return target, needed, rate, timing.delay_at(rate)


def require_own_bounds(run: FinishedRun, designed: Sampling | None, timing: Timing) -> None:
    """Raise UserError where single channels have bounds that a loop other than that designed may
    pass: figures of sampled loops here are of the whole."""
    bounds = bounds_of(run.problem)
    if not any(own.given and own.S_max != bounds.S_max for own in bounds.channels):
        return
    words = f"{run.folder}: channels have bounds of their own, which are judged as designed alone"
    if designed is None:
        raise UserError(f"{words}; give loop.rate_hz in the case, solve it and deploy that")
    required = timing.delay_at(timing.rate_hz or designed.rate_hz)
    default = timing.delay is None and timing.delay_samples == Timing.delay_samples
    if timing.rate_hz not in (None, designed.rate_hz) or not (
        default or required == designed.delay
    ):
        raise UserError(f"{words}; leave out the rate and the delay, which are then the case's")


def designed_channels(run: FinishedRun) -> tuple[ChannelOrders, ...]:
    """The sections of every channel as they are; figures of each on its own entry of the plant, of
    several sensors on one actuator, which close one loop together, those of the whole."""
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
    found, sensors = [], bool(bounds_of(run.problem).places)
    for channel, own, values in parts:
        K = channel.controller
        figures = run.figures if sensors else run.measure(channel.plant, K)
        alone = ReducedController(len(K.A), Reduction.NONE, K, figures)
        found.append(ChannelOrders(channel, (alone,), alone, alone, (own, values)))
    return tuple(found)


SHORTEN_IT = "shorten it with --delay (default: one period), or design wider margins"
DESIGN_FOR_IT = "shorten it, or design for it with loop.rate_hz and loop.delay_us in the case"


@dataclass(frozen=True)
class CodeForm:
    """The requirements on the code: its largest force in N, and whether it is of single precision,
    or of integers."""

    saturation: float | None = None
    single: bool = False
    fixed: FixedRequest | None = None


@one_blas_thread
def deploy(
    run: FinishedRun,
    timing: Timing,
    *,
    saturation: float | None = None,
    single: bool = False,
    fixed: FixedRequest | None = None,
    progress: Callable[[str], None] = lambda words: None,
    options: DeploymentOptions = DeploymentOptions(),
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
    saturation, single, fixed, progress : float, bool, FixedRequest, callable
        Largest force, N; whether the code computes in single precision, or in integers, whose
        rounded coefficients are judged then; takes a line at each step.
    options : DeploymentOptions
        What is kept of the designed loop.

    Returns
    -------
    Deployment
        Also where it is not verified.

    Raises
    ------
    UserError
        No sampling rate is enough, or the given one is no rate for this loop.
    """
    inner, full, K = run.problem.inner, run.figures, run.controller
    own = run.bandwidth
    if not np.isfinite(own):
        fastest = float(np.abs(np.linalg.eigvals(K.A)).max(initial=0.0)) / HZ
        words = f"no bandwidth was measured of its loop ({full.outcome.value})"
        raise UserError(
            f"{run.folder}: {words}; K has a pole at {fastest:.3g} Hz: leave out of the plant what "
            "lies far above the loop, such as a stiff link"
        )
    designed, family, dense = run.problem.sampling, members(run), members(run, dense=True)
    target = Target(inner.S_max, options.sampled_excess, own, options.sampled_bandwidth)
    if kind_of(run.problem).as_designed:
        require_own_bounds(run, designed, timing)
        limits, remedy = LoopLimits(inner.S_max, inner.S_low, np.inf, own), DESIGN_FOR_IT
        places = kind_of(run.problem).bounds().places
        orders, channels, small = designed_channels(run), whole_loop(run.plant, K, places), [K]
        reduced, figures = K, full
    else:
        least = options.least_rate
        if timing.rate_hz is not None and timing.rate_hz < least * own / HZ:
            words = f"is less than {least:g} times the bandwidth, {own / HZ:.4g} Hz"
            raise UserError(f"--rate-hz {timing.rate_hz:g}: {words}; sample faster")
        remedy = SHORTEN_IT
        limits = LoopLimits(
            options.reduced_peak * inner.S_max, inner.S_low * (1.0 + options.strict),
            options.reduced_norm * full.gamma, options.reduced_bandwidth * own,
        )  # fmt: skip
        orders = tuple(
            _orders(run, c, family, limits, progress, options)
            for c in scalar_channels(run.plant, K)
        )
        channels = tuple(item.channel for item in orders)
        small = [item.chosen.controller for item in orders]
        reduced = assemble(channels, small)
        figures = run.measure(run.plant, reduced)
    way: dict[str, Any] = {"limits": limits, "reduced": reduced, "reduced_figures": figures}
    code = CodeForm(saturation, single, fixed)
    if designed is not None:
        progress("the rate of the case")
        target, own_hz, rate, delay = at_its_rate(run, channels, family, designed, timing, options)
        way |= {"needed_hz": own_hz, "target": target, "designed_for": designed}
        found = _assess(run, dense, orders, Conversion.TUSTIN, rate, delay, code, way)
        return replace(found, judge=attempt_judgement(_judge, run, found))
    loops = list(zip(channels, small, strict=True))
    for attempt in range(1 + options.added_plants):
        conversion, needed, rate = choose(
            run, timing, loops, target, family, progress, attempt, remedy
        )
        way |= {"needed_hz": needed, "target": target}
        found = _assess(run, dense, orders, conversion, rate, timing.delay_at(rate), code, way)
        outside = max((m for m in found.members if not target.held(m.figures)),
                      default=None, key=lambda m: m.badness)  # fmt: skip
        if timing.rate_hz is not None or outside is None:
            break
        # between the plants of the case's set the peak is larger: that plant counts from now on
        family = (*family, *(item for item in dense if item.at == outside.at))
    return replace(found, judge=attempt_judgement(_judge, run, found))


def _judge(run: FinishedRun, found: Deployment) -> Judgement:
    """The coefficients of the code on the plants as their function returned them.

    W_KS KS and W_T T of the code are figures of it: a bound of theirs is one of the design.
    """
    target, most, period = found.target, found.compliance_max, 1.0 / found.rate_hz
    parts = [discretise(one.chosen.controller, found.conversion, period, found.delay)
             for one in found.orders]  # fmt: skip
    K = replace(assemble([one.channel for one in found.orders], parts), period=period)
    inner, wider, own = run.problem.inner, 1.0 + target.excess, kind_of(run.problem).bounds()
    bounds = Bounds(
        target.peak, inner.S_low * wider, inner.omega_low,
        compliance_max=None if most is None else most * wider,
        channels=own.looser(target.excess).channels if own.places else (), error=own.error,
    )  # fmt: skip
    plants, sampling = as_written(run), Sampling(found.rate_hz, 1e6 * found.delay)
    judged = judge_loops(
        plants, K, found.realisation.as_coded, bounds, sampling,
        target.bandwidth * (1.0 - target.tolerance), integrator=False, on_all=False,
    )  # fmt: skip
    if not judged.passed:
        return judged
    where = f" (broken at {', '.join(one.name for one in own.places)})" if own.places else ""
    kept = [f"S_max{where}", "S_low", *(["compliance_max"] if most is not None else [])]
    words = f"stable and within {', '.join(kept)} on {plural(len(plants), 'plant')}"
    words += " checked of the [robust] set" if len(plants) > 1 else ""
    figures = dict(judged.figures)
    if own.weighted_level is not None:
        own = own if own.places else replace(own, channels=())
        rounded = found.realisation.precision != "double"
        runs = found.realisation.as_coded if rounded else K
        worst = certify(plants, runs, own, sampling, integrator=False).worst
        figures |= {name: worst[name] for name in ("KS", "T")}
    return replace(judged, figures=figures, words=words)


def _orders(
    run: FinishedRun,
    channel: LoopChannel,
    family: tuple[Member, ...],
    limits: LoopLimits,
    progress: Callable[[str], None],
    options: DeploymentOptions,
) -> ChannelOrders:
    progress(f"orders of channel {channel.name}")
    inner, most = run.problem.inner, run.problem.inner.compliance_max
    rows = reductions(channel, run.weights, inner.omega_low)
    strict = replace(limits, peak=inner.S_max * (1.0 + options.strict))
    order = WorstFirst(family)

    def compliant(plant: ScaledPlant, row: ReducedController) -> bool:
        if most is None:
            return True
        return compliance_of(plant, row.controller).gain <= options.reduced_peak * most

    def holds(peak: float) -> Callable[[ReducedController], bool]:
        def on(member: Member, row: ReducedController) -> bool:
            plant = member.seen_by(channel)
            figures = run.measure(plant, row.controller)
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


def _assess(
    run: FinishedRun, members: Sequence[Member], orders: Sequence[ChannelOrders],
    conversion: Conversion, rate_hz: float, delay: float, code: CodeForm,
    way: Mapping[str, Any],
) -> Deployment:  # fmt: skip
    """A controller as it runs, on the nominal plant and on the members of a set.

    Behind every plant are a hold of a period and a delay in s. `way`: what else was found of the
    reduction and the rate, by the fields of `Deployment`.
    """
    period, bandwidth = 1.0 / rate_hz, run.bandwidth
    places = kind_of(run.problem).bounds().places
    parts = [discretise(o.chosen.controller, conversion, period, delay) for o in orders]
    realisation = with_anti_windup(
        realise([o.channel for o in orders], parts, code.saturation), bandwidth
    )
    nominal = Perturbation()
    plants = {nominal: run.plant.plant_si()} | {m.at: m.plant.plant_si() for m in members}
    held = {at: zoh(plant, period, delay) for at, plant in plants.items()}
    if code.fixed is not None:
        realisation = _of_integers(run, realisation, held[nominal], delay, code.fixed)
    realisation = in_single(realisation) if code.single else realisation
    K, fixed = realisation.system, realisation.fixed
    figures = {at: loop_figures(closed_loop(G, K), places) for at, G in held.items()}
    loop = run.loop
    own = replace(loop, controller=K)
    at_rest = statics_of(own, bandwidth=bandwidth, omega_low=run.problem.inner.omega_low)
    most = run.problem.inner.compliance_max
    if kind_of(run.problem).as_designed:
        most = structured_of(run.problem).compliance_max
    status = run.result.get("status", "verified")  # without it no run is behind the design
    unverified = "" if status == "verified" else str(run.result.get("reason") or status)
    found = Deployment(
        orders=tuple(orders), rate_hz=rate_hz, delay=delay, conversion=conversion,
        plant=held[nominal], realisation=realisation, sampled=figures.pop(nominal),
        members=tuple(MemberLoop(at, item) for at, item in figures.items()),
        unverified=unverified, statics=at_rest, compliance_max=most, **way,
    )  # fmt: skip
    if found.stable:
        peaks = [
            found.sampled.sensitivity_peak,
            *(one.sensitivity_peak for one in figures.values()),
        ]
        sampling = Sampling(rate_hz, 1e6 * delay)
        found = replace(
            found, between=worst_between([*plants.values()], peaks, K, sampling, places)
        )
    if fixed is not None and found.stable:
        bounds = [rounding_bound(G, K, fixed) for G in held.values()]
        found = replace(found, rounding=max(bounds, key=lambda one: one.largest))
    if most is None or not found.stable:
        return found
    forced = plants | {nominal: forced_model(run)}
    gains = {at: sampled_compliance(forced[at], G, K, places, delay=delay)
             for at, G in held.items()}  # fmt: skip
    return replace(found, compliance=max(gains.items(), key=lambda pair: pair[1]))


def _of_integers(
    run: FinishedRun, realisation: Realisation, held: StateSpace, delay: float,
    request: FixedRequest,
) -> Realisation:  # fmt: skip
    """The same in integers whose ranges hold the moves of the nominal loop."""
    plant, K, places = run.loop.plant, realisation.system, kind_of(run.problem).bounds().places
    profile, forward = setpoint(request.moves), None
    try:
        forward = forward_of(plant, held.period, delay, places)
    except UserError:
        pass  # the move is made by feedback alone
    ranges = ranges_of_moves(plant, held, K, profile, forward, places)
    return in_fixed(realisation, ranges, request)
