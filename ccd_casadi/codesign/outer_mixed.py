"""The outer problem with mixed-sensitivity controllers, x = (θ, ln ω_S, ln ω_T).

One synthesis with exact derivatives costs a millisecond: formulations and local solves go through
x, and the whole inner problem over (ω_S, ω_T) at a θ is held against what they end with.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import call
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.codesign.final_judgement import (
    check_references,
    judge_survival,
    other_damping,
    second_on_weighted,
)
from ccd_casadi.codesign.kinked import PeakDescentOptions, descend, polish
from ccd_casadi.codesign.lifted_kkt import TrueDesign, kkt_certificate
from ccd_casadi.codesign.outer import Outer, Place, PolishedDesign
from ccd_casadi.codesign.outer_problem import FormulationResult, lifted_bounds
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.codesign.verified_mixed import VerifiedDesign
from ccd_casadi.inner_problem.objective import final_design, objective
from ccd_casadi.inner_problem.problem import box, plant_of
from ccd_casadi.optim.pieces import Box
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.synthesis.weights import Weights
from surrogates import design

if TYPE_CHECKING:
    from ccd_casadi.codesign.post_optimal import PostOptimal


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
        from ccd_casadi.codesign.design_plants import failure_words  # where a search failed

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
