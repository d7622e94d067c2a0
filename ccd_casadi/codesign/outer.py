"""What the outer problem asks of one kind of inner problem; its search is written against this.

A kind knows how its formulations run, how a design is polished on the truth and what the whole
inner problem at θ has to say against it, and how the design that is left is judged.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.formulation import FormulationResult, KnownSamples
from ccd_casadi.codesign.formulations import Direct, Formulation
from ccd_casadi.codesign.gaussian_processes import with_sample
from ccd_casadi.codesign.lifted import Lifted, solve_lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.outer_problem import distinct
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.codesign.verified import Solution, Verified
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.optim.pieces import Box
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import counted
from surrogates import design


@dataclass(frozen=True)
class Place:
    """Where a local solve on the truth ended: x, J, and whether it is a stationary point."""

    x: Array
    objective: float
    stationary: bool


@dataclass(frozen=True)
class PolishedDesign:
    """A polished design of the truth before it is judged.

    `x` begins with θ. `gap`: by how much (relative) the whole inner problem at θ is better, NaN
    where its search found nothing or was not made;
    `objective` infinite where the design is not certified or breaks a bound.
    """

    x: Array
    value: float
    objective: float
    kkt: KktCertificate
    gap: float

    @property
    def feasible(self) -> bool:
        """Whether its constraints are met."""
        return bool(np.isfinite(self.objective))


def is_expensive(problem: CoDesignProblem) -> bool:
    """Whether the elements of another θ take as long as a search there."""
    return plant_of(problem).nearby is not None


class Outer(ABC):
    """The outer problem of one kind of inner problem, on a sampler's store and workers."""

    kkt_level: float  # residual up to which an end counts as stationary
    same_optimum = 1e-2  # of the box: ends of local solves on the truth that are closer are one
    extra_variables: tuple[str, ...] = ()  # what else x holds, logarithms

    def __init__(self, sampler: Sampler) -> None:
        self.sampler = sampler

    @property
    def problem(self) -> CoDesignProblem:
        """The problem, with what a search has added to it."""
        return self.sampler.problem

    def theta_of(self, x: Array) -> Array:
        """θ of a point."""
        return np.asarray(x, float)[: len(self.problem.names)]

    @property
    def global_check_is_cheap(self) -> bool:
        """Whether local solves may start from points that are no better."""
        return not is_expensive(self.problem)

    def promising(self, thetas: Array, least: float) -> Array:
        """Those of θ (k, n_θ) where it is not shown beforehand that J is `least` or more."""
        return thetas

    @property
    def retries_pay(self) -> bool:
        """Whether searches from beside an end that is not stationary pay."""
        return True

    @property
    def bounds(self) -> Box:
        """The bounds of x."""
        return box(self.problem)

    def prepared(self, seed: int) -> "Outer":
        """With what every search needs before it begins."""
        return self

    def resumed(self, folder: Path, seed: int) -> "Outer":
        """With what the run in a folder ended with, where its kind needs that."""
        return self

    def solve_formulation(
        self, formulation: Formulation, seed: int, given: KnownSamples | None = None
    ) -> FormulationResult:
        """One formulation, from the samples that are given where there are any.

        Lifted over θ alone is nested: what is lifted are the exact gradients.
        """
        if isinstance(formulation, Direct):
            with self.sampler.spent.on("search"):
                return self.solve_on_truth(formulation.starts, seed)
        if lifted := isinstance(formulation, Lifted):
            if self.extra_variables:
                return solve_lifted(self.sampler, formulation, seed=seed, given=given)
            formulation = Nested(**vars(formulation) | {
                "plan": "sobol", "points": formulation.sampled(len(self.problem.names)),
            })  # fmt: skip
        return solve_nested(self.sampler, formulation, seed=seed, given=given, gradients=lifted)

    def solve_on_truth(self, starts: int, seed: int) -> FormulationResult:
        """The direct formulation: local solves from the case's start and a Sobol set beside it.

        From one start that has a design it is the polish that follows.
        """
        spread = design("sobol", *box(self.problem), starts, seed)
        thetas = np.vstack([self.problem.start, spread])[:starts]
        begun = self.sampler.values(thetas, "direct")
        if starts == 1 and begun[0].feasible:
            return FormulationResult(begun[0].joint, agreed=True)
        places: list[Place] = []
        for sample in begun:
            place = self.local_solve(sample, places)
            places += [] if place is None else [place]
        if not places:
            words = f"no design meets its constraints from {counted(starts, 'start')}"
            return FormulationResult(message=words)
        ends = distinct(
            [(one.objective, one.x) for one in places], self.bounds, starts, self.same_optimum
        )
        return FormulationResult(ends.best.x, outer=ends, agreed=True)

    @abstractmethod
    def fallback(self, outcome: FormulationResult, seed: int) -> FormulationResult:
        """A formulation that found nothing: a design to go on from, or why there is none."""

    @abstractmethod
    def polished(self, x: Array) -> PolishedDesign:
        """Polish a point on the truth, and hold the whole inner problem there against it."""

    def extended(self, end: PolishedDesign) -> "Outer | None":
        """With what stood against an end, to be searched again; None where nothing did."""
        return None

    def with_training_sample(
        self, outcome: FormulationResult, end: PolishedDesign
    ) -> FormulationResult:
        """With surrogates that have an end among their samples, which they did not foresee."""
        values, slopes = self.training_samples(end, outcome.surrogates[0].lower.size)
        found = [
            with_sample(process, end.x[: process.lower.size], value, slope)
            for process, value, slope in zip(outcome.surrogates, values, slopes, strict=True)
        ]
        return replace(outcome, surrogates=tuple(found))

    def training_samples(self, end: PolishedDesign, inputs: int) -> tuple[Array, Array]:
        """Values (k,) and slopes (k, n) at an end of what surrogates of n = `inputs` fit."""
        found = self.sampler.values(self.theta_of(end.x), "the end")[0]
        return np.array([end.value]), np.array([found.gradient])

    @abstractmethod
    def local_solve(
        self, sample: InnerSample, known: Sequence[Place], settled: float | None = None
    ) -> Place | None:
        """A local solve on the truth from a sample; none goes on near `known` stationary points.

        `settled`: relative change of J at which it ends.
        """

    def failure_reason(self, solution: Solution, share: float | None) -> str:
        """Why a solution is not verified; `share` of a robust set that was held on the way."""
        return str(solution.result["reason"])

    @abstractmethod
    def verified(self, end: PolishedDesign, rounds: int) -> Verified:
        """The design judged on the truth, after so many `rounds` of the whole search."""

    def point_of(self, run: FinishedRun) -> Array:
        """x of a run's design."""
        return np.array(run.theta)

    @abstractmethod
    def responses(self, x: Array) -> PostOptimal:
        """How an optimum at x answers to what was given."""
