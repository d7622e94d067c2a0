"""A deployment: what was found on the way from a run's controller to code, and its verdict in
words."""

from dataclasses import dataclass
from functools import partial
from math import isfinite
from typing import Any

from ccd_casadi.analysis.loop_channels import LoopChannel, SampledFigures
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.verdict import Check, State, VerdictOptions, between_finding
from ccd_casadi.deployment.discretise import Conversion, LoopLimits, ReducedController, Target
from ccd_casadi.deployment.integer_loop import RoundingBound, rounding_finding
from ccd_casadi.deployment.on_hardware import OnHardware
from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.deployment.robust_set import MemberLoop, place_words
from ccd_casadi.fixed_structure.judgement import Judgement
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.sweep import missed_by
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.norms import BetweenSamples
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.statics import Statics
from ccd_casadi.synthesis.synthesis import DesignFigures


@dataclass(frozen=True)
class ChannelOrders:
    """A channel's controllers of every order.

    Attributes
    ----------
    channel : LoopChannel
        The loop that they close.
    rows : tuple of ReducedController
        The full order first.
    chosen, strict : ReducedController
        The one deployed, and the one of least order that keeps S_max without the share of it that
        a reduction may spend.
    designed : (Structure, array) or None
        Structure and κ (SI) of sections, which are deployed as they are.
    """

    channel: LoopChannel
    rows: tuple[ReducedController, ...]
    chosen: ReducedController
    strict: ReducedController
    designed: tuple[Structure, Array] | None = None


@dataclass(frozen=True)
class Deployment:
    """The way from a run's controller to the deployed one.

    Attributes
    ----------
    orders : tuple of ChannelOrders
        Of each channel.
    limits, reduced, reduced_figures : LoopLimits, StateSpace, DesignFigures
        What the reduction keeps, K(s) after it, SI, and its loop.
    needed_hz : float or None
        The least rate that is enough; that of a design for a rate is this rate. None where none is.
    target : Target
        What the sampled loop keeps.
    rate_hz, delay : float
        Hz and s.
    conversion, plant, realisation : Conversion, StateSpace, Realisation
        How K(s) becomes K(z); the sampled plant; the difference equation.
    sampled : SampledFigures
        Exact ones of the sampled loop on the nominal plant.
    members : tuple of MemberLoop
        The same on every other plant of the run's [robust] set.
    unverified : str
        Why the run itself is not verified; empty where it is.
    statics : Statics or None
        Of the loop at rest.
    compliance, compliance_max : (Perturbation, float) or None, float or None
        On which plant |GS| is largest, and it in m/N; its bound, where the case has one.
    judge : Judgement or None
        Of the code's coefficients on the plants as their function returned them.
    designed_for : Sampling or None
        The rate and delay that the loop was designed for; None where K(s) was designed.
    between : BetweenSamples or None
        S between the samples, on the plants with the largest peaks at the instants; None of an
        unstable loop.
    rounding : RoundingBound or None
        What integers add on the worst plant; None of floating point, and of an unstable loop.
    integer_faults : tuple of str
        What integers may spoil of the move; empty: nothing.
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
    designed_for: Sampling | None = None
    between: BetweenSamples | None = None
    rounding: RoundingBound | None = None
    integer_faults: tuple[str, ...] = ()

    @property
    def order(self) -> int:
        """States of the reduced controller."""
        return len(self.reduced.A)

    @property
    def loops(self) -> tuple[MemberLoop, ...]:
        """The sampled loop on every plant, the nominal one first."""
        return (MemberLoop(Perturbation(), self.sampled), *self.members)

    @property
    def stable(self) -> bool:
        """Whether the sampled loop is stable on every plant."""
        return all(loop.figures.stable for loop in self.loops)

    @property
    def worst(self) -> MemberLoop:
        """The plant with the largest peak of the sampled S."""
        return max(self.loops, key=lambda loop: loop.badness)

    @property
    def shortfalls(self) -> tuple[str, ...]:
        """The requirements that are not met, each on its plant with its figure, the worst plant
        first.

        ω_b is held to its tolerance on the nominal plant alone: on the others it moves with them.
        """
        nominal, *others = self.loops
        failed = [] if self.target.met(nominal.figures) else [nominal]
        failed += [loop for loop in others if not self.target.held(loop.figures)]
        failed.sort(key=lambda loop: -loop.badness)
        words = [f"{_fault(self.target, one.figures)} ({place_words(one.at)})" for one in failed]
        if self.compliance is not None and self.compliance_max is not None:
            at, gain = self.compliance
            if gain > (1.0 + self.target.excess) * self.compliance_max:
                missed = missed_by(gain, self.compliance_max)
                words.append(f"compliance |GS| in m/N {missed} ({place_words(at)})")
        if self.judge is not None and not self.judge.passed:
            words.append(f"the plant as its function returned it: {self.judge.words}")
        return (*words, *self.integer_faults)

    @property
    def weighted_above(self) -> tuple[Finding, ...]:
        """The weighted functions that exceed `weighted_level` by more than `excess` in the code."""
        figures = {} if self.judge is None else self.judge.figures
        return tuple(
            Reason.WEIGHTED_ABOVE(name=name, level=figures[name])
            for name in ("KS", "T")
            if figures.get(name, 0.0) > 1.0 + self.target.excess
        )

    @property
    def passed(self) -> bool:
        """Whether every sampled loop of a verified run keeps its target."""
        return not self.shortfalls and not self.unverified


@dataclass(frozen=True)
class DeployedRun:
    """A run with what was deployed of it: its words, rows and line of the verdict.

    Attributes
    ----------
    run, found : FinishedRun, Deployment
    """

    run: FinishedRun
    found: Deployment

    @property
    def status(self) -> str:
        """`verified`, or not, and the reason."""
        return f"{self.short_status}  {self.reason}".rstrip()

    @property
    def short_status(self) -> str:
        """`verified` without a remark where every bound is kept as the case gives it."""
        found = self.found
        if not found.passed:
            return "not verified"
        if self._percent_over > 0.0:
            return f"verified to {100.0 * found.target.excess:.2g} % of S_max"
        return "verified"

    @property
    def reason(self) -> str:
        """The reason why it is not verified; where it is, what hold and delay have taken of
        S_max."""
        return "; ".join(one.words() for one in self.findings)

    @property
    def findings(self) -> list[Finding]:
        """The findings of `reason`; of several plants that fall short that of the worst alone."""
        run, found = self.run, self.found
        parts = [Reason.RUN_NOT_VERIFIED(words=found.unverified)] if found.unverified else []
        if share := run.case.robust.share_words:
            parts.append(Reason.SHARE_ALONE(claim=share, plants=1 + len(found.members)))
        if found.shortfalls:
            return [*parts, Reason.JUDGED(words=found.shortfalls[0])]
        over, plant = self._percent_over, place_words(found.worst.at) if found.members else ""
        if over > 0.0:
            S_max, excess = run.problem.inner.S_max, found.target.excess
            parts.append(Reason.PEAK_ABOVE(over=over, S_max=S_max, excess=excess, plant=plant))
        return parts

    @property
    def _percent_over(self) -> float:
        """The percentage by which the largest peak exceeds S_max; negative below it."""
        peak = self.found.worst.figures.sensitivity_peak
        return 100.0 * (peak / self.run.problem.inner.S_max - 1.0)

    def check(self, moved: OnHardware | None = None) -> Check:
        """The line `deployable` of the run's verdict, with its simulated move where there is one.

        It is failed where the sampled loop does not keep its target on a plant, and warned of where
        the move does not settle within a force limit.
        """
        found = self.found
        K, worst = found.sampled, found.worst
        figures: dict[str, Any] = {
            "rate_hz": found.rate_hz,
            "delay": found.delay,
            "needed_hz": found.needed_hz,
            "order": len(found.realisation.system.A),
            "stable": found.stable,
            "bandwidth_hz": K.bandwidth / HZ,
            "sensitivity_peak": worst.figures.sensitivity_peak,
            "worst_bandwidth_hz": worst.figures.bandwidth / HZ,
            "plants": 1 + len(found.members),
            "judge": None if found.judge is None else found.judge.entry,
            "move": None if moved is None else moved.limited_entry,
            "rounding": None if found.rounding is None else found.rounding.largest,
            "between_samples": None if found.between is None else found.between.entry,
        }
        check = partial(Check, "deployable", figures=figures)
        if found.shortfalls:
            return check(State.FAILED, (Reason.SHORTFALL(words=found.shortfalls[0]),))
        nominal = Reason.DEPLOYED_ON_MODEL if found.members else Reason.DEPLOYED
        doubts, kept = [*self.findings, *found.weighted_above], [nominal(**_loop_entry(K))]
        if found.members and worst.figures is not K:
            plant = place_words(worst.at)
            kept.append(Reason.WORST_PLANT(plant=plant, **_loop_entry(worst.figures)))
        if move := figures["move"]:
            unsettled = {State.FAILED: Reason.MOVE_NOT_SETTLED, State.UNKNOWN: Reason.MOVE_UNKNOWN}
            if reason := unsettled.get(move.get("state", State.PASSED)):
                doubts.append(reason(force_limit=move["force_limit"]))
        if found.between is not None:
            above, finding = between_finding(
                found.between,
                found.target.S_max,
                found.target.excess + VerdictOptions.between_excess,
            )
            (doubts if above else kept).append(finding)
        if found.rounding is not None:
            kept.append(rounding_finding(found.rounding))
        return check(State.WARNED if doubts else State.PASSED, (*doubts, *kept))

    @property
    def order(self) -> str:
        """The order in words, such as `5 states: 4 after reduction (of 6; 7 synthesised), 1 of the
        lead filter`."""
        run, found = self.run, self.found
        orders = [item.chosen.order for item in found.orders]
        if kind_of(run.problem).as_designed:
            return f"{' + '.join(map(str, orders))} states, as designed"
        kept, before = (
            " + ".join(map(str, each))
            for each in (orders, [item.rows[0].order for item in found.orders])
        )
        states = len(found.realisation.system.A)
        more = states - found.order
        lead = f", {more} of the lead filter" if found.conversion is Conversion.LEAD else ""
        reduced = f"{kept} after reduction (of {before}; {len(run.controller.A)} synthesised)"
        return f"{states} states: {reduced}{lead}"

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """Name, bandwidth, and peak of S of the full, the reduced and the sampled loop."""
        run, found = self.run, self.found
        loops: list[tuple[str, Any]] = [("Full", run.figures), ("Reduced", found.reduced_figures)]
        if kind_of(run.problem).as_designed:
            loops = []  # it was designed as it runs
        rows = []
        for name, figures in (*loops, ("Sampled", found.sampled)):
            if figures is not None and isfinite(figures.bandwidth):
                change = 100.0 * (figures.bandwidth / run.bandwidth - 1.0)
                peak = against(figures.sensitivity_peak, run.problem.inner.S_max)
                words = f"peak {figures.sensitivity_peak:.6g} ({peak})"
                if loops and figures is not run.figures:
                    words += f", bandwidth {round(change, 2) + 0.0:+.2f} %"
                rows.append((name, f"{figures.bandwidth / HZ:.6g} Hz", words))
        if not run.figures.certificate.stable:
            rows.append(
                ("Continuous", "unknown", "unstable without its sampling, which stabilises it")
            )
        return rows


def _fault(target: Target, figures: SampledFigures) -> str:
    """The first of stability, peak and bandwidth that a loop does not keep."""
    if not figures.stable:
        return f"unstable: spectral radius {figures.spectral_radius:.6g}"
    if figures.sensitivity_peak > target.peak:
        return f"peak of S {missed_by(figures.sensitivity_peak, target.S_max)}"
    change = 100.0 * (figures.bandwidth / target.bandwidth - 1.0)
    return f"bandwidth {figures.bandwidth / HZ:.6g} Hz ({change:+.2f} %)"


def _loop_entry(found: SampledFigures) -> dict[str, float]:
    """The figures of a finding about the loop on one plant."""
    return {"bandwidth_hz": found.bandwidth / HZ, "sensitivity_peak": found.sensitivity_peak}


def against(peak: float, S_max: float) -> str:
    """`3.10 % above S_max`."""
    over = round(100.0 * (peak / S_max - 1.0), 2)
    return f"{abs(over):.2f} % {'above' if over > 0.0 else 'below'} S_max" if over else "S_max"
