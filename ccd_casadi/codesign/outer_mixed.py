"""The outer problem with mixed-sensitivity controllers, and the verified designs that it ends with.

One synthesis with exact derivatives costs a millisecond: formulations and local solves go through
x = (θ, ln ω_S, ln ω_T), and the whole inner problem over (ω_S, ω_T) at a θ is held against what
they end with.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf, isfinite
from operator import call
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from ccd_casadi.codesign.final_judgement import (
    ReferenceCheck,
    RobustCheck,
    check_references,
    judge_survival,
    other_damping,
    second_on_weighted,
)
from ccd_casadi.codesign.kinked import PeakDescentOptions, descend, polish
from ccd_casadi.codesign.optimality import TrueDesign, kkt_certificate
from ccd_casadi.codesign.outer import Outer, Place, PolishedDesign
from ccd_casadi.codesign.outer_problem import FormulationResult, lifted_bounds
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.result_entries import mixed_dict
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.verdict import Check, OwnSet, State
from ccd_casadi.codesign.verified import Solution, Verified
from ccd_casadi.inner_problem.objective import binding, final_design, objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, design_choices, plant_of
from ccd_casadi.inner_problem.sweep import active_constraints, missed_bounds
from ccd_casadi.optim.pieces import Box
from ccd_casadi.plants.plant import hardware_cost, named_values
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.synthesis import Design
from ccd_casadi.synthesis.weights import Weights
from surrogates import design

if TYPE_CHECKING:
    from ccd_casadi.codesign.post_optimal import PostOptimal


def set_findings(robust: RobustCheck) -> dict[str, Any]:
    """Arguments of `survives` for a set that was searched along its shift.

    Parameters
    ----------
    robust : RobustCheck
        The worst of the set.

    Returns
    -------
    dict
        `own` and `own_findings`.
    """
    own = OwnSet.KEPT if robust.passed else OwnSet.BROKEN
    why = Reason.SET_KEPT if robust.passed else Reason.SET_NOT_KEPT
    why = Reason.SET_UNSTABLE if robust.peak == inf else why
    at = {"shift": robust.at.shift, "damping": robust.at.damping}
    return {"own": own, "own_findings": (why(plants=robust.plants, peak=robust.peak, **at),)}


@dataclass(frozen=True, kw_only=True)
class VerifiedDesign(Verified):
    """The design of a run with its controller and every true figure.

    Attributes
    ----------
    x : (n_θ + 2,) array
        (θ, ln ω_S, ln ω_T), SI.
    design : Design
        Made anew, not from a store.
    references : tuple of ReferenceCheck
        On closer models of the plant.
    """

    x: Array
    design: Design
    references: tuple[ReferenceCheck, ...] = ()

    kkt_level: ClassVar[float] = 1e-4  # the polish reaches 1e-6

    @property
    def certified(self) -> bool:
        return self.design.figures.certified and bool(self.judgement.passed)

    @property
    def bandwidth(self) -> float:
        return self.design.figures.bandwidth

    @property
    def point(self) -> Array:
        return self.x

    @property
    def active(self) -> tuple[str, ...]:
        problem = self.problem
        ends = {f"{name} {end}" for name in problem.names for end in ("lower", "upper")}
        inner = active_constraints(problem.inner, self.design.figures)
        return (*filter(ends.__contains__, self.kkt.active), *inner, *binding(problem, self.theta))

    def figures(self) -> dict[str, Any]:
        return mixed_dict(self.problem, self.theta, self.design)

    def evidence(self, predicted: float) -> dict[str, Any]:
        free = self.design.figures
        found: dict[str, Any] = {
            "surrogate_bandwidth_hz": predicted / HZ,
            "without_suspension": {
                "stable": free.certificate.stable,
                "bandwidth_hz": free.bandwidth / HZ,
                "sensitivity_peak": free.sensitivity_peak,
            },
            "references": {
                check.name: {
                    "certified": check.certified,
                    "reason": check.outcome.value,
                    "stable": check.figures.certificate.stable,
                    "bandwidth_hz": check.figures.bandwidth / HZ,
                    "sensitivity_peak": check.figures.sensitivity_peak,
                    "gamma": check.figures.gamma,
                }
                for check in self.references
            },
            "gap": None,  # nothing bounds KS, and so no ω_b, but the weights that are searched
        }
        if self.robust is not None:
            found["robust"] = {
                "nominal_sensitivity_peak": self.robust.nominal,
                "stable": isfinite(self.robust.peak),
                "worst_sensitivity_peak": self.robust.peak,
                "worst_shift": self.robust.at.shift,
                "worst_damping": self.robust.at.damping,
                "plants": self.robust.plants,
                **({} if self.damping is None else self.damping.entry),
            }
        return found

    def checks(self) -> dict[str, bool]:
        found = {} if self.robust is None else {"robust": self.robust.passed}
        if self.references:
            stable = [check.figures.certificate.stable for check in self.references]
            found["closer_models"] = all(stable)
        return found

    def certified_line(self) -> Check:
        design, bounds = self.design.figures, self.problem.inner.bounds
        norm, norm_bound = design.certificate.norm, design.certificate.norm_bound
        figures = {"norm": norm, "norm_bound": norm_bound}
        figures["sensitivity_peak"] = design.sensitivity_peak
        found = [Reason.BOUNDS_MET()]
        if not design.certified:
            found = [Reason.NOT_CERTIFIED()]
        elif not self.feasible:
            found = [Reason.BOUND_NOT_MET(bounds=list(bounds))]
        if "compliance_max" in bounds:
            figures["compliance_max"] = design.compliance
            found.append(Reason.COMPLIANCE())
        good = design.certified and self.feasible
        state = State.PASSED if good else State.FAILED
        return Check("certified", state, (*found, Reason.NORM()), figures)

    def own_set(self) -> dict[str, Any]:
        found = [
            (check.name, check.figures.certificate.stable, check.figures.sensitivity_peak)
            for check in self.references
        ]
        return {"closer": found, **({} if self.robust is None else set_findings(self.robust))}

    def better(self) -> Finding:
        return Reason.WEIGHTS_BETTER()


@dataclass(frozen=True)
class MixedOuterOptions:
    """Numbers of the outer problem with mixed-sensitivity controllers."""

    polishes: int = 3  # at most, each from a better controller of the whole inner problem
    inner_gap: float = 1e-6  # relative: by how much the whole inner problem may be better
    stationary: float = 1e-4  # residual of an end whose basin is not searched again


class MixedOuter(Outer):
    """The outer problem of mixed sensitivity; see the module."""

    options = MixedOuterOptions()
    kkt_level = VerifiedDesign.kkt_level
    extra_variables = ("omega_S", "omega_T")

    @property
    def bounds(self) -> Box:
        return lifted_bounds(self.problem)

    def fallback(self, outcome: FormulationResult, seed: int) -> FormulationResult:
        """The true inner problem at a few θ separates an infeasible case from a formulation that
        failed."""
        points = design("sobol", *box(self.problem), 8, seed)
        with self.sampler.spent.on("rescue"):
            samples = self.sampler.values(points, "search for a feasible design")
        feasible = [sample for sample in samples if sample.feasible]
        if not feasible:
            nearest = self.sampler.nearest  # None: no time was left for any
            words = samples[0].shortfall if nearest is None else nearest.shortfall
            return FormulationResult(iterates=outcome.iterates, message=words)
        best = max(feasible, key=lambda sample: sample.bandwidth)
        return replace(outcome, x=best.joint, agreed=False)

    def polish(self, x: Array) -> PolishedDesign:
        """Polished; where the inner problem has a better design at its θ, on from that one."""
        sampler, truth = self.sampler, self.sampler.truth
        lower, upper = self.bounds
        width = 1e-9 * self.bounds.width  # within rounding of a bound: onto it
        for _ in range(self.options.polishes):
            before = len(sampler.trace)
            polishing = Progress(1, "polishing on the truth", quiet=sampler.quiet)
            with polishing as progress, sampler.spent.on("polish"):
                end = polish(truth, x)
                progress.advance()
            sampler.report(before)
            at_bounds = np.where(end.x - lower <= width, lower, end.x)
            at_bounds = np.where(upper - end.x <= width, upper, at_bounds)
            onto = TrueDesign(truth, at_bounds)
            end = onto if onto.acceptable else end
            with sampler.spent.on("checks"):
                inner = sampler.values(end.theta, "verifying")[0]
            bandwidth = end.design.figures.bandwidth
            gap = inner.bandwidth / bandwidth - 1.0 if inner.feasible else np.nan
            if not gap > self.options.inner_gap:
                break
            x = inner.joint
        J = end.objective if end.acceptable else np.inf
        return PolishedDesign(end.x, bandwidth, J, end.kkt, float(gap))

    def training_samples(self, end: PolishedDesign, inputs: int) -> tuple[Array, Array]:
        if inputs < end.x.size:
            return super().training_samples(end, inputs)
        found = self.sampler.quantities(end.x)[0]
        return found.values[:-1], found.gradients[:-1]

    def local_solve(
        self, sample: InnerSample, earlier: Sequence[Place], settled: float | None = None
    ) -> Place | None:
        truth = self.sampler.truth
        # where no design is feasible it goes from the middle of the weights' frequencies
        begin = np.where(np.isfinite(sample.joint), sample.joint, np.mean(self.bounds, axis=0))
        basins = [(place.x, place.objective) for place in earlier if place.stationary]
        settled = PeakDescentOptions().settled if settled is None else settled
        end = descend(truth, begin, ended=basins, settled=settled)
        for x in (end, begin):
            made = TrueDesign(truth, x)
            if made.acceptable:
                return Place(x, made.objective, made.kkt.stationarity <= self.options.stationary)
        return None

    def failure_reason(self, solution: Solution, share: float | None) -> str:
        if solution.result["status"] == "verified":
            return str(solution.result["reason"])
        return failure_words(self.sampler, solution, share)

    def verify(self, end: PolishedDesign, rounds: int) -> VerifiedDesign:
        problem, sampler, x = self.problem, self.sampler, end.x
        here = TrueDesign(sampler.truth, x)
        theta = tuple(float(v) for v in self.theta_of(x))
        figures = here.design.figures
        # Never from a store: it cannot know all that the design depends on.
        final = final_design(problem, theta, (figures.omega_S, figures.omega_T))
        loops = loops_of(problem, theta, final.controller)
        tasks: dict[str, tuple[Callable[[], Any]]] = {
            "survival": (partial(judge_survival, problem, loops, final.figures),),
            "second": (partial(second_on_weighted, problem, theta, final),),
            "damping": (partial(other_damping, problem, loops),),
        }
        judged = dict(results(sampler.workers, call, tasks))
        found, robust = judged["survival"]
        return VerifiedDesign(
            problem=problem,
            x=x,
            theta=theta,
            design=final,
            value=final.figures.bandwidth,
            objective=objective(problem, theta, final.figures.bandwidth),
            hardware_cost=hardware_cost(plant_of(problem), theta),
            kkt=kkt_certificate(here, second=True),
            inner_gap=end.gap,
            feasible=final.figures.certified and here.acceptable,
            references=check_references(problem, theta, final, sampler.workers, sampler.quiet),
            robust=robust,
            damping=judged["damping"],
            survival=found,
            second=judged["second"],
        )

    def point_of(self, theta: Sequence[float], weights: Weights) -> Array:
        return np.append(theta, np.log([weights.omega_S, weights.omega_T]))

    def responses(self, x: Array) -> "PostOptimal":
        from ccd_casadi.codesign.post_optimal import post_optimal

        return post_optimal(self.problem, x, self.sampler.quiet)


def failure_words(sampler: Sampler, best: Solution, share: float | None) -> str:
    """Describe why a search failed: where it searched, how near it came, what may be tried."""
    problem, words = sampler.problem, str(best.result["reason"])
    if best.verified is not None:
        figures = cast(VerifiedDesign, best.verified).design.figures
        missed = " and ".join(missed_bounds(problem.inner, figures))
        parts = [words, missed, remedies(problem, share) if missed else ""]
        return "; ".join(part for part in parts if part)
    where = ""
    if sampler.nearest is not None and np.isfinite(sampler.nearest.violation):
        where = f"nearest at {named_values(plant_of(problem).names, sampler.nearest.theta)}: "
    thetas = len({entry.theta for entry in sampler.trace})
    return f"{search_words(problem, thetas)}; {where}{words}; {remedies(problem, share)}"


def search_words(problem: CoDesignProblem, thetas: int) -> str:
    """Describe which controllers were searched, and where."""
    inner, robust = problem.inner, problem.robust
    ranges = (("omega_S", inner.omega_S), ("omega_T", inner.omega_T))
    ends_hz = [f"{name} {low / HZ:g} to {high / HZ:g}" for name, (low, high) in ranges]
    made = ""
    if robust is not None and robust.shift:
        ends = {"low": "its lower end", "nominal": "its middle", "high": "its upper end"}
        places = [ends[choice.robust.design_at] for choice in design_choices(problem)
                  if choice.robust]  # fmt: skip
        named = " and ".join(filter(None, (", ".join(places[:-1]), places[-1])))
        made = f", made on the plant at {named} of +-{100 * robust.shift:g} %"
    return (
        f"none found among the mixed-sensitivity H-infinity controllers{made} at {thetas} theta "
        f"({', '.join(ends_hz)} Hz)"
    )


def remedies(problem: CoDesignProblem, share: float | None = None) -> str:
    """List what may be tried where none was found; `share` of the range that was held, if known."""
    ways = ["wider bounds of theta, omega_S_hz or omega_T_hz", "a larger S_max or S_low"]
    robust = problem.robust
    if robust is not None:
        narrower = "a narrower range in [robust]"
        if share:
            held = f"+-{100 * share * robust.shift:.3g} %" if robust.shift else f"{share:.2g} of it"
            narrower += f" ({held} was held on the way)"
        ways.append(narrower)
    ways.append("another kind of controller (`robustness --controller` judges any)")
    return f"one may exist all the same; try {', '.join(ways[:-1])}, or {ways[-1]}"
