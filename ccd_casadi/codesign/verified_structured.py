"""A verified design with a controller of fixed structure: its figures, checks and lines."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.codesign.outer_problem import FormulationResult, GlobalCheck
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.structured_entries import (
    active_of,
    bound_words,
    box_findings,
    design_dict,
    proof_dict,
    robust_dict,
    sections_controller,
)
from ccd_casadi.codesign.verdict import Check, State
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.fixed_structure.bounds import Bounds, kind_and_channel
from ccd_casadi.fixed_structure.certificate import SetCertificate
from ccd_casadi.fixed_structure.design import DesignOptions, SectionsDesign
from ccd_casadi.fixed_structure.judgement import Judgement, judgement_of
from ccd_casadi.fixed_structure.multi_start import BandwidthOptimum
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.objective import binding
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.searched_problem import Scenario, state_of, with_state
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue, structured_value
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, plant_words_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of, with_structured
from ccd_casadi.sampling.structured_units import from_controller
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import HZ

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.box_proof import Proof


@dataclass(frozen=True)
class Costs:
    """ω_b in rad/s (NaN: none certified) at the ends of climbs from the design: `on_model` on the
    model alone, `continuous` on the set without hold and delay. At least that much is reached.
    """

    on_model: float
    continuous: float


def costs_of(problem: CoDesignProblem, theta: Sequence[float], kappa: Array) -> Costs:
    """The climbs from a certified design with parameters κ (SI)."""
    model = tuple(map(float, uncertain_plant(problem, theta).nominal))

    def climbed(easier: CoDesignProblem) -> float:
        eased = with_structured(easier, minimise="bandwidth")
        value = structured_value(from_controller(eased, kappa.tolist()), theta)
        return value.bandwidth if value.feasible else float("nan")

    alone = with_state(problem, scenarios=((0, model),))
    return Costs(climbed(alone), climbed(with_structured(problem, sampling=None)))


class Gap(Protocol):
    """The bound on every controller, of the extension `limitations`."""

    def finding(self, bandwidth: float) -> Finding:
        """Make the finding of the verdict, with a design's ω_b in rad/s."""

    def entry(self, bandwidth: float) -> dict[str, Any]:
        """Write the entry of result.json."""


@dataclass(frozen=True, kw_only=True)
class VerifiedStructured(Verified):
    """The design of a run, judged on its set and on the whole box of plants.

    Attributes
    ----------
    design : SectionsDesign
        Certified anew on its set.
    multistart : StructuredValue or None
        A multi-start search at θ; None where the time was up for one.
    wide, checked : SetCertificate, int
        The judge's certificate on a lattice of this number of plants of the box.
    proof : Proof
        For the whole box.
    drawn : Yield or None
        Where that is not proven: how many random plants of the box survive.
    worst : Excess
        The worst plant that was found.
    rounds : int
        Of the search.
    costs : Costs
        What easier problems reach at θ.
    prices : mapping
        dω_b/d ln t in rad/s of every tolerance t.
    gap : Gap or None
        Of ω_b: what no controller reaches.
    reported : (float, Yield) or None
        The time of its move in s, where J counts it.
    counterexamples : tuple of (option, point)
        Plants of the box by which judge or proof refute the design.
    """

    design: SectionsDesign
    multistart: StructuredValue | None
    wide: SetCertificate
    checked: int
    proof: "Proof"
    drawn: Yield | None
    worst: Excess
    rounds: int
    costs: Costs
    prices: Mapping[str, float]
    gap: Gap | None
    reported: tuple[float, Yield | None] | None = None
    counterexamples: tuple[Scenario, ...] = ()

    # Of ∇J: the envelope gradient of a controller that is itself optimal to 1e-3 is right to 2e-3,
    # and differences of two such say nothing of a small curvature.
    kkt_level: ClassVar[float] = 1e-2
    saddle: ClassVar[float] = -math.inf

    @cached_property
    def judgement(self) -> Judgement:
        """The judgement by the case's own bounds; the certificate's are within `looseness` of
        them."""
        found, bounds = judgement_of(self.wide, self.checked), bounds_of(self.problem)
        if not self.wide.plants or not all(plant.stable for plant in self.wide.plants):
            return found
        plants = self.wide.plants
        each = [bounds.shares(one) | bounds.channel_shares(one.channels) for one in plants]
        worst = {name: max(shares[name] for shares in each) for name in each[0]}
        return replace(found, figures={**found.figures, **worst})

    @property
    def set_is_met(self) -> bool:
        """Whether the whole set is: by the judge, proof, draws, and along its common shift."""
        return self.wide.passed and not self.proof.denies and self.all_drawn and self.along

    @property
    def along(self) -> bool:
        """Whether it is met all along its common shift, as far as that is known."""
        found = self.survival
        return found is None or found.within(*kind_of(self.problem).common_shifts())

    @property
    def all_drawn(self) -> bool:
        """Whether none of the plants that were drawn fails."""
        return self.drawn is None or self.drawn.survived == self.drawn.draws

    @property
    def active(self) -> tuple[str, ...]:
        constraints = plant_of(self.problem).constraint_names
        bounds = [name for name in self.kkt.active if name not in constraints]
        return (*bounds, *active_of(self.design), *binding(self.problem, self.theta))

    def figures(self) -> dict[str, Any]:
        return design_dict(self.problem, self.theta, self.design)

    def evidence(self, predicted: float) -> dict[str, Any]:
        structured, state = structured_of(self.problem), state_of(self.problem)
        found: dict[str, Any] = {
            "surrogate_bandwidth_hz": predicted / HZ if structured.figure is BANDWIDTH else None,
            "race": [
                {"bandwidth_hz": optimum.bandwidth / HZ, "searches": optimum.count}
                for optimum in self.optima
            ],
            "rounds": self.rounds,
            "anchors": [list(kappa) for kappa in state.warm_starts],
            "robust": self._robust_entry(),
            "proof": proof_dict(self.proof),
            "costs": json_values({f"{name}_hz": w / HZ for name, w in vars(self.costs).items()})
            | {"tolerances_hz": {name: 0.01 * w / HZ for name, w in self.prices.items()}},
            "gap": None if self.gap is None else self.gap.entry(self.bandwidth),
            "between_samples": None if self.between is None else self.between.entry,
        }
        if structured.figure is not BANDWIDTH:
            entry = structured.figure.entry
            found |= {
                f"{entry}_of_set": self.value,
                f"surrogate_{entry}": predicted,
                f"{entry}_raced": None if self.multistart is None else self.multistart.value,
                "error_anchors": [list(kappa) for kappa in state.error_warm_starts],
            }
        if structured.uncertainty.ranges:
            found["varies"] = {name: ends for name, *ends in structured.uncertainty.ranges}
        if self.reported is not None:
            time, drawn = self.reported
            found |= {"move_time": time, "move_time_fresh": None if drawn is None else drawn.entry}
        if structured.weighted_level is None:
            words = "KS and T are not bounded: the case gives no controller.weighted_level"
            found["notes"] = [*plant_of(self.problem).notes(self.theta), words]
        return found

    def _robust_entry(self) -> dict[str, Any]:
        """The judge on a lattice of the box, and the worst plant that was searched."""
        stable = [plant for plant in self.wide.plants if plant.stable]
        scenarios = state_of(self.problem).scenarios
        return {
            **robust_dict(self.wide, self.checked, self.worst),
            "stable": len(stable) == len(self.wide.plants),
            "worst_sensitivity_peak": max((plant.S_peak for plant in stable), default=None),
            "worst_plant": {"option": self.worst.option, "point": self.worst.point.tolist()},
            "set": [{"option": option, "point": list(point)} for option, point in scenarios],
            "yield": None if self.drawn is None else self.drawn.entry,
            **({} if self.damping is None else self.damping.entry),
        }

    def largest_at(self, bounds: Bounds, peak_hz: float) -> dict[str, tuple[str, float]]:
        judged = self.design.certificate
        if judged is None or not all(plant.stable for plant in judged.plants):
            return {}
        words, low = plant_words_of(self.problem, self.theta), bounds.omega_low / HZ
        shares = [bounds.shares(plant) for plant in judged.plants]
        found = {}
        for name in shares[0]:
            i = max(range(len(shares)), key=lambda i: shares[i][name])
            at = {"S_max": judged.plants[i].S_peak_frequency / HZ, "S_low": low}
            alone = len(shares) == 1
            label = "" if alone or i >= len(words) else words[i]
            found[name] = (label, at.get(name, math.nan))
        return found

    def proven_figures(self) -> set[str]:
        if not self.proof.applies:
            return set()
        raw = {"S_MAX": "S_max", "S_LOW": "S_low"}
        found = set()
        for name, level in self.proof.levels.items():
            kind, channel = kind_and_channel(name)
            if level <= 1.0 + self.proof.slack:
                found.add(raw.get(kind, kind) + (f" of {channel}" if channel else ""))
        return found

    def checks(self) -> dict[str, bool]:
        drawn = None if self.reported is None else self.reported[1]
        later = {} if drawn is None else {"move_time": drawn.survived == drawn.draws}
        return {"robust": self.set_is_met, **later}

    def controller_entry(self) -> dict[str, Any]:
        return sections_controller(self.design, self.problem.sampling)

    def certified_line(self) -> Check:
        judged = self.design.certificate
        figures: dict[str, Any] = {} if judged is None else {"figures_over_bounds": judged.worst}
        line = partial(Check, "certified", figures=figures)
        if not self.certified:
            return line(State.FAILED, (Reason.JUDGED(words=self.design.words),))
        if not self.feasible:
            return line(State.FAILED, (Reason.CONSTRAINT_NOT_MET(),))
        count = 0 if judged is None else len(judged.plants)
        untested = () if judged is None else judged.grid_only
        most, levels = 1.0 + self.proof.slack, self.proof.levels
        on_grid = bound_words(name for name in untested if not levels.get(name, math.inf) <= most)
        kept = (Reason.JUDGED_ON_MODEL if count == 1 else Reason.JUDGED_ON_PLANTS)(plants=count)
        if on_grid:  # a check that does not exist for a sampled loop is not passed
            figures["on_grid_alone"] = on_grid
            return line(State.WARNED, (Reason.ON_GRID_ALONE(), kept))
        return line(State.PASSED, (kept,))

    def own_set(self) -> dict[str, Any]:
        return box_findings(self.wide, self.checked, self.proof, self.worst, self.drawn,
                            along=self.along)  # fmt: skip

    @property
    def optima(self) -> tuple[BandwidthOptimum, ...]:
        """The ends of the multi-start search at θ."""
        return () if self.multistart is None else self.multistart.design.local_optima

    def better(self) -> Finding:
        found = math.nan if self.multistart is None else self.multistart.value
        key = self.problem.figure.key
        return Reason.CONTROLLER_BETTER(merit=key, better=found, own=self.value)

    def no_gradient(self) -> Finding:
        return Reason.NO_GRADIENT(controller_residual=self.design.kkt_residual)

    def bound(self) -> Finding:
        return super().bound() if self.gap is None else self.gap.finding(self.bandwidth)

    def search_findings(
        self, outcome: FormulationResult, global_check: GlobalCheck | None
    ) -> tuple[tuple[Finding, ...], Mapping[str, Any]]:
        known, figures = super().search_findings(outcome, global_check)
        if self.multistart is None:
            return known, figures
        ends, figure = Reason.MULTISTART(), self.problem.figure
        if self.multistart.feasible and figure is not BANDWIDTH:
            ends = Reason.MULTISTART_OF(merit=figure.key, value=self.multistart.value)
        design = self.multistart.design
        if design.found is not None and design.found < DesignOptions.repeats:
            known = (*known[:1], Reason.NOT_REPEATED(multistart=design.starts), *known[1:])
        found = [optimum.bandwidth / HZ for optimum in self.optima]
        figures = {**figures, "local_optima_hz": found, "best_found": design.found}
        return (*known, ends), figures
