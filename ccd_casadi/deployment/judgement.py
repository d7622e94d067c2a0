"""A realised controller on the plants of a set: exact sampled figures, then a simulation."""

from collections.abc import Collection, Sequence

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.compliance import sampled_compliance
from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.deployment.robust_set import Member, MemberLoop
from ccd_casadi.deployment.sampled import (
    DiscreteStateSpace,
    SampledFigures,
    sampled_figures,
    sampled_plant,
    sensitivity_loop,
)
from ccd_casadi.deployment.simulation import MeasuredSensitivity, measure_set
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.synthesis.statics import Statics, statics


class SampledSet:
    """The nominal plant and the members of a set behind a hold of `period` and a delay, in s."""

    def __init__(
        self, run: FinishedRun, members: Sequence[Member], period: float, delay: float
    ) -> None:
        self.run = run
        self.free = {Perturbation(): run.plant.plant_si()}
        self.free |= {m.at: m.plant.plant_si() for m in members}
        self.nominal = sampled_plant(run.plant.plant_si(), period, delay)
        self.members = {m.at: sampled_plant(m.plant.plant_si(), period, delay) for m in members}

    def figures(self, realisation: Realisation) -> tuple[SampledFigures, tuple[MemberLoop, ...]]:
        """The exact figures of the loop on the nominal plant, and on every member."""
        K = realisation.system
        loops = tuple(
            MemberLoop(at, sampled_figures(sensitivity_loop(plant, K)))
            for at, plant in self.members.items()
        )
        return sampled_figures(sensitivity_loop(self.nominal, K)), loops

    def compliance(self, realisation: Realisation) -> tuple[Perturbation, float]:
        """The largest |GS| in m/N of all plants, and where; every sampled loop is stable."""
        held = {Perturbation(): self.nominal, **self.members}
        K = realisation.system
        found = {
            at: sampled_compliance(self.free[at], sensitivity_loop(plant, K))
            for at, plant in held.items()
        }
        at = max(found, key=lambda item: found[item])
        return at, found[at]

    def simulated(
        self, realisation: Realisation, shown: Collection[Perturbation], seed: int
    ) -> tuple[MeasuredSensitivity, tuple[tuple[Perturbation, MeasuredSensitivity], ...]]:
        """What a simulation measures on the nominal plant and on the members `shown`."""
        chosen = {at: plant for at, plant in self.members.items() if at in shown}
        nominal, *rest = measure_set(
            [self.nominal, *chosen.values()], realisation.system, self.run.figures.bandwidth, seed
        )
        return nominal, tuple(zip(chosen, rest, strict=True))


def unverified(run: FinishedRun) -> str:
    """Why the run is not verified; empty where it is, or where no run is behind the design."""
    status = run.result.get("status", "verified")
    return "" if status == "verified" else str(run.result.get("reason") or status)


def statics_of(run: FinishedRun, K: DiscreteStateSpace) -> Statics:
    """What a constant force moves with the sampled controller."""
    return statics(
        run.plant.plant_si(), StateSpace(K.A, K.B, K.C, K.D), bandwidth=run.figures.bandwidth,
        omega_low=run.problem.inner.omega_low, period=K.period,
    )  # fmt: skip
