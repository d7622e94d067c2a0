"""A realised controller on the plants of a set: the exact figures of every sampled loop."""

from collections.abc import Sequence
from dataclasses import replace

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.anti_windup import limited
from ccd_casadi.deployment.discretise import Conversion, Target, discretise
from ccd_casadi.deployment.outcome import ChannelOrders, Deployment, Trial
from ccd_casadi.deployment.realisation import realise
from ccd_casadi.deployment.reduction import Limits
from ccd_casadi.deployment.robust_set import Member, MemberLoop
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.hold import sampled
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.robust.sampled import sampled_compliance, sampled_figures
from ccd_casadi.synthesis.statics import Statics, statics
from ccd_casadi.synthesis.synthesis import DesignFigures


class SampledSet:
    """A controller as it runs, on the nominal plant and on the members of a set.

    Behind every plant are a hold of a period and a delay in s. `sampled` and `checked` are the
    exact figures of the loops on the nominal plant and on every member.
    """

    def __init__(
        self, run: FinishedRun, members: Sequence[Member], orders: Sequence[ChannelOrders],
        conversion: Conversion, rate_hz: float, delay: float, saturation: float | None,
    ) -> None:  # fmt: skip
        period = 1.0 / rate_hz
        self.run, self.orders, self.conversion = run, tuple(orders), conversion
        self.rate_hz, self.delay = rate_hz, delay
        parts = [discretise(o.chosen.controller, conversion, period, delay) for o in orders]
        realised = realise([item.channel for item in orders], parts, saturation)
        self.realisation = limited(realised, run.figures.bandwidth)
        self.free = {Perturbation(): run.plant.plant_si()}
        self.free |= {m.at: m.plant.plant_si() for m in members}
        held = {at: sampled(plant, period, delay) for at, plant in self.free.items()}
        loops = {at: closed_loop(G, self.realisation.system).S for at, G in held.items()}
        figures = {at: sampled_figures(loop) for at, loop in loops.items()}
        self.held, self.loops = held[Perturbation()], loops
        self.sampled = figures.pop(Perturbation())
        self.checked = tuple(MemberLoop(at, item) for at, item in figures.items())

    def deployment(
        self, limits: Limits, reduced: StateSpace, reduced_figures: DesignFigures,
        trials: Sequence[Trial], target: Target, compliance_max: float | None,
    ) -> Deployment:  # fmt: skip
        """All that was found."""
        run = self.run
        found = Deployment(
            self.orders, limits, reduced, reduced_figures, tuple(trials), target, self.rate_hz,
            self.delay, self.conversion, self.held, self.realisation, self.sampled, self.checked,
            unverified=unverified(run), statics=statics_of(run, self.realisation.system),
            compliance_max=compliance_max,
        )  # fmt: skip
        if compliance_max is None or not found.stable:
            return found
        gains = {at: sampled_compliance(self.free[at], loop) for at, loop in self.loops.items()}
        return replace(found, compliance=max(gains.items(), key=lambda pair: pair[1]))


def unverified(run: FinishedRun) -> str:
    """Why the run is not verified; empty where it is, or where no run is behind the design."""
    status = run.result.get("status", "verified")
    return "" if status == "verified" else str(run.result.get("reason") or status)


def statics_of(run: FinishedRun, K: StateSpace) -> Statics:
    """What a constant force moves with the sampled controller."""
    return statics(
        run.plant.plant_si(), StateSpace(K.A, K.B, K.C, K.D), bandwidth=run.figures.bandwidth,
        omega_low=run.problem.inner.omega_low, period=K.period,
    )  # fmt: skip
