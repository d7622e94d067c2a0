"""The design that a run ends with, and what was found out about it: alike for every controller.

`Verified` is one interface: results, verdicts and pages use nothing else. It holds what the outer
problem is judged by; each kind of controller adds what only it knows (`figures`, `evidence`, some
lines of the verdict), or overrides what most have not. `Solution` is what a whole run leaves.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ccd_casadi.codesign.final_judgement import OtherDamping, RobustCheck, judge_on_model
from ccd_casadi.codesign.outer_problem import FormulationResult, GlobalCheck, outputs_of
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.result_entries import controller_dict
from ccd_casadi.codesign.survival import Survival
from ccd_casadi.codesign.verdict import Check, VerdictOptions, search_evidence, survives
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.judgement import Judgement
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.second_engine import NOT_COMPARED, EngineComparison
from surrogates import GaussianProcess, Quality

if TYPE_CHECKING:
    from ccd_casadi.lti.norms import BetweenSamples


@dataclass(frozen=True, kw_only=True)
class Verified(ABC):
    """A design at θ, judged on the truth.

    Attributes
    ----------
    problem : CoDesignProblem
        With what a search has added to the case's: a plant set, controllers to start from.
    theta : tuple of float
        SI.
    design : Any
        Has the `controller`, whether it is `certified`, and its `bandwidth`, unless its kind reads
        these elsewhere.
    value, objective, hardware_cost : float
        What J = w1 f + w2 v counts of the controller (v, SI), J and f.
    kkt : KktCertificate
        Of optimality.
    inner_gap : float
        By how much (relative) a search of the whole inner problem at θ finds a better v; NaN where
        it found nothing.
    feasible : bool
        Certified, within its bounds, and λ(θ) <= 0.
    survival, damping : Survival, OtherDamping
        How far resonances may be off the model, and what other damping does; None where the loop is
        not stable.
    second : EngineComparison
        Its norms by another engine.
    between : BetweenSamples or None
        S between the samples of a loop that was designed as sampled.
    robust : RobustCheck or None
        A dense check of the case's own set, of a design whose judge takes its model alone.
    """

    problem: CoDesignProblem
    theta: tuple[float, ...]
    design: Any
    value: float
    objective: float
    hardware_cost: float
    kkt: KktCertificate
    inner_gap: float
    feasible: bool
    survival: Survival | None
    damping: OtherDamping | None
    second: EngineComparison = NOT_COMPARED
    between: "BetweenSamples | None" = None
    robust: RobustCheck | None = None

    kkt_level: ClassVar[float]  # KKT residual over ‖∇J‖∞, up to which it counts as stationary
    saddle: ClassVar[float] = VerdictOptions().saddle  # least curvature that is not a saddle's

    @property
    def controller(self) -> StateSpace:
        """The controller K(s), SI."""
        return self.design.controller

    @property
    def certified(self) -> bool:
        """Whether the closed loop is certified, whatever λ(θ) is."""
        return self.design.certified

    @property
    def bandwidth(self) -> float:
        """ω_b in rad/s, whatever J counts."""
        return self.design.bandwidth

    @property
    def point(self) -> Array:
        """The input of the formulation's surrogates, which take as many of it as they have: θ, with
        mixed sensitivity ln ω_S and ln ω_T (rad/s) after it."""
        return np.array(self.theta)

    @property
    @abstractmethod
    def active(self) -> tuple[str, ...]:
        """Names of the bounds and constraints that bind."""

    @abstractmethod
    def figures(self) -> dict[str, Any]:
        """The design's figures, by keys of result.json."""

    @abstractmethod
    def evidence(self, predicted: float) -> dict[str, Any]:
        """Return the further evidence of this kind, by keys of result.json; `predicted` is v by the
        surrogate."""

    def largest_at(self, bounds: Bounds, peak_hz: float) -> dict[str, tuple[str, float]]:
        """Find where each figure of the judge is largest: the plant in words, empty where there is
        one, and the frequency in Hz; `peak_hz` is that of the peak of |S| on one plant."""
        return {"S_max": ("", peak_hz), "S_low": ("", bounds.omega_low / HZ)}

    def proven_figures(self) -> set[str]:
        """Return the figures of the judge that a proof holds on the whole set."""
        return set()

    def checks(self) -> dict[str, bool]:
        """Further checks of this kind by name, each whether the design passes it."""
        return {}

    def controller_entry(self) -> dict[str, Any]:
        """Return the content of controller.json."""
        return controller_dict(self.controller)

    @abstractmethod
    def certified_line(self) -> Check:
        """Write the line on what its certificate rests on."""

    def survives_line(self) -> Check:
        """Write the line on what the loop survives off its model, and whether the case's own set is
        kept."""
        damping = "" if self.damping is None else self.damping.words
        line = survives(
            self.survival, S_max=self.problem.inner.S_max, other_damping=damping, **self.own_set()
        )
        held = kind_of(self.problem).common_shifts()
        return replace(line, figures={**line.figures, "set_shift": list(held)})

    def own_set(self) -> dict[str, Any]:
        """Return the arguments of `survives` about the case's own set of plants, and closer
        models."""
        return {}

    @abstractmethod
    def better(self) -> Finding:
        """State what the whole inner problem has found better at θ, by `inner_gap`."""

    def no_gradient(self) -> Finding | None:
        """State why J may have no gradient at θ; None where it always has one."""
        return None

    def search_findings(
        self, outcome: FormulationResult, global_check: GlobalCheck | None
    ) -> tuple[tuple[Finding, ...], Mapping[str, Any]]:
        """State where something better was searched for and not found, with figures of the line."""
        solved = outcome.outer
        starts, optima = (0, 0) if solved is None else (solved.starts, len(solved.optima))
        return search_evidence(starts, optima, global_check, self.bound())

    @cached_property
    def judgement(self) -> Judgement:
        """The judgement on the plants as their function returned them."""
        return judge_on_model(self.problem, self.theta, self.controller)

    def bound(self) -> Finding:
        """State the bound that no controller exceeds at θ: by default that none is known."""
        return Reason.GAP_UNKNOWN()


@dataclass(frozen=True)
class Solution(NotebookHtml):
    """Result of a run: the JSON result and the objects behind it.

    Parameters
    ----------
    result, outcome : dict, FormulationResult
        The content of result.json, and how the formulation ended.
    verified, quality : Verified or None, tuple of Quality
        The design (None: infeasible, or searched and not judged), and that of its surrogates.
    problem : CoDesignProblem or None
        The one solved: of a robust case that leaves its design plant open, the best one's.
    """

    result: dict[str, Any]
    outcome: FormulationResult
    verified: Verified | None
    quality: tuple[Quality, ...] = ()
    problem: CoDesignProblem | None = None

    @property
    def surrogates(self) -> dict[str, tuple[GaussianProcess, str]]:
        """The last ones by what they are of, each with its unit: the bandwidth in rad/s; over θ in
        the case's units, lifted over ln ω_S and ln ω_T (rad/s) too. Direct has none.

        `surrogates.to_casadi` makes functions of them.
        """
        names = outputs_of(BANDWIDTH if self.problem is None else self.problem.figure)
        # nested fits the first output alone, lifted all, direct none
        pairs = zip(names.items(), self.outcome.surrogates, strict=False)
        return {name: (process, unit) for (name, unit), process in pairs}
