"""A realised controller on the plants of a set: the exact figures of every sampled loop."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.anti_windup import with_anti_windup
from ccd_casadi.deployment.discretise import Conversion, discretise
from ccd_casadi.deployment.outcome import ChannelOrders, Deployment
from ccd_casadi.deployment.realisation import realise
from ccd_casadi.deployment.robust_set import Member, MemberLoop
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.structured_plant_set import structured_of
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.hold import sampled
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.robust.sampled import sampled_compliance, sampled_figures
from ccd_casadi.synthesis.statics import statics


def assess(
    run: FinishedRun, members: Sequence[Member], orders: Sequence[ChannelOrders],
    conversion: Conversion, rate_hz: float, delay: float, saturation: float | None,
    way: Mapping[str, Any],
) -> Deployment:  # fmt: skip
    """A controller as it runs, on the nominal plant and on the members of a set.

    Behind every plant are a hold of a period and a delay in s. `way`: what else was found of the
    reduction and the rate, by the fields of `Deployment`.
    """
    period, bandwidth = 1.0 / rate_hz, run.figures.bandwidth
    parts = [discretise(o.chosen.controller, conversion, period, delay) for o in orders]
    realisation = with_anti_windup(
        realise([o.channel for o in orders], parts, saturation), bandwidth
    )
    K, nominal = realisation.system, Perturbation()
    plants = {nominal: run.plant.plant_si()} | {m.at: m.plant.plant_si() for m in members}
    held = {at: sampled(plant, period, delay) for at, plant in plants.items()}
    loops = {at: closed_loop(G, K).S for at, G in held.items()}
    figures = {at: sampled_figures(loop) for at, loop in loops.items()}
    at_rest = statics(
        plants[nominal], K, bandwidth=bandwidth, omega_low=run.problem.inner.omega_low
    )
    most = run.problem.inner.compliance_max
    if kind_of(run.problem).as_designed:
        most = structured_of(run.problem).compliance_max
    found = Deployment(
        orders=tuple(orders), rate_hz=rate_hz, delay=delay, conversion=conversion,
        plant=held[nominal], realisation=realisation, sampled=figures.pop(nominal),
        members=tuple(MemberLoop(at, item) for at, item in figures.items()),
        unverified=unverified(run), statics=at_rest, compliance_max=most, **way,
    )  # fmt: skip
    if most is None or not found.stable:
        return found
    gains = {at: sampled_compliance(plants[at], loop) for at, loop in loops.items()}
    return replace(found, compliance=max(gains.items(), key=lambda pair: pair[1]))


def unverified(run: FinishedRun) -> str:
    """Why the run is not verified; empty where it is, or where no run is behind the design."""
    status = run.result.get("status", "verified")
    return "" if status == "verified" else str(run.result.get("reason") or status)
