"""A deployment: what was found out on the way from a run's controller, and what it keeps."""

from dataclasses import dataclass

from ccd_casadi.deployment.channels import LoopChannel
from ccd_casadi.deployment.discretise import Conversion, Target
from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.deployment.reduction import LoopLimits, ReducedController
from ccd_casadi.deployment.robust_set import MemberLoop, place_words
from ccd_casadi.fixed_structure import Structure
from ccd_casadi.fixed_structure.judgement import Judgement
from ccd_casadi.inner_problem.sweep import missed_by
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.robust.sampled import SampledFigures
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.statics import Statics
from ccd_casadi.synthesis.synthesis import DesignFigures

# The sampled loop keeps S_max to 5 % and ω_b to 3 %.
SAMPLED_EXCESS, SAMPLED_BANDWIDTH = 0.05, 0.03


@dataclass(frozen=True)
class ChannelOrders:
    """A channel's controllers of every order; the one chosen, and the least that keeps S_max.

    `designed`: structure and κ (SI) of sections, which are deployed as they are.
    """

    channel: LoopChannel
    rows: tuple[ReducedController, ...]
    chosen: ReducedController
    strict: ReducedController
    designed: tuple[Structure, Array] | None = None


@dataclass(frozen=True)
class Deployment:
    """Everything that was found out on the way from a run's controller to the deployed one.

    `sampled` are the exact figures of the sampled loop on the nominal plant, `members` those on
    every other plant of the run's [robust] set. `unverified`: why the run itself is not verified,
    empty where it is. `needed_hz`: the least rate that will do, None where none does.
    `judge`: the code's coefficients on the plants as their function returned them.
    `compliance`: the largest |GS| in m/N and on which plant, where the case bounds it.
    """

    orders: tuple[ChannelOrders, ...]
    limits: LoopLimits
    reduced: StateSpace
    reduced_figures: DesignFigures
    needed_hz: float | None
    target: Target
    rate_hz: float
    delay: float
    conversion: Conversion
    plant: StateSpace
    realisation: Realisation
    sampled: SampledFigures
    members: tuple[MemberLoop, ...] = ()
    unverified: str = ""
    statics: Statics | None = None
    compliance: tuple[Perturbation, float] | None = None
    compliance_max: float | None = None
    judge: Judgement | None = None

    @property
    def order(self) -> int:
        """States of the reduced controller."""
        return len(self.reduced.A)

    @property
    def stable(self) -> bool:
        """Whether the sampled loop is stable on every plant."""
        return self.sampled.stable and all(item.figures.stable for item in self.members)

    @property
    def worst(self) -> MemberLoop:
        """The plant with the largest peak of the sampled S, the nominal one among them."""
        nominal = MemberLoop(Perturbation(), self.sampled)
        return max((nominal, *self.members), key=lambda item: item.badness)

    @property
    def shortfalls(self) -> tuple[str, ...]:
        """What is not kept, on which plant, with its figure; empty where all is."""
        found = []
        for item in (MemberLoop(Perturbation(), self.sampled), *self.members):
            nominal = item.at == Perturbation()
            if not (self.target.met if nominal else self.target.held)(item.figures):
                found.append((item.badness, f"{_fault(self, item)} ({place_words(item.at)})"))
        words = [w for _, w in sorted(found, key=lambda pair: -pair[0])]
        if self.compliance is not None and self.compliance_max is not None:
            at, gain = self.compliance
            if gain > (1.0 + self.target.excess) * self.compliance_max:
                missed = missed_by(gain, self.compliance_max)
                words.append(f"compliance |GS| in m/N {missed} ({place_words(at)})")
        if self.judge is not None and not self.judge.passed:
            words.append(f"the plant as its function returned it: {self.judge.words}")
        return tuple(words)

    @property
    def passed(self) -> bool:
        """Whether every sampled loop of a verified run keeps its target."""
        return not self.shortfalls and not self.unverified


def _fault(found: Deployment, item: MemberLoop) -> str:
    f = item.figures
    if not f.stable:
        return f"unstable: spectral radius {f.spectral_radius:.6g}"
    if f.sensitivity_peak > found.target.peak:
        return f"peak of S {missed_by(f.sensitivity_peak, found.target.S_max)}"
    change = 100.0 * (f.bandwidth / found.target.bandwidth - 1.0)
    return f"bandwidth {f.bandwidth / HZ:.6g} Hz ({change:+.2f} %)"
