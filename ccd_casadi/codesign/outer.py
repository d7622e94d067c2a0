"""The interface of the outer problem min J(x), x = (θ, what else a kind adds), to its search.

`outer_search` calls it in this order: `prepared`, `solve_formulation` (surrogates, or local solves
on the truth), `polished` (a local solve, then a wider search for a better controller at its θ),
`extended` where plants exceed a bound at the design, `verified`. Each kind of inner problem
implements it.

*The truth* is the inner problem itself, in contrast to its surrogate. Lengths in x are shares of
the box of its bounds.
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
from ccd_casadi.support.time_budget import ends_early
from surrogates import design


@dataclass(frozen=True)
class Place:
    """The end of a local solve on the truth: x (n,), J, and whether x is a stationary point."""

    x: Array
    objective: float
    stationary: bool


@dataclass(frozen=True)
class PolishedDesign:
    """A local optimum of the truth, before it is judged.

    Attributes
    ----------
    x : array (n,)
        θ first.
    value : float
        Optimal value of the inner problem at θ, SI: ω_b in rad/s, or what the case minimises.
    objective : float
        J; inf where the design is not certified or exceeds a bound.
    kkt : KktCertificate
    gap : float
        Relative improvement by a multi-start search for the controller at θ; NaN where it found
        nothing or was not made.
    """

    x: Array
    value: float
    objective: float
    kkt: KktCertificate
    gap: float

    @property
    def feasible(self) -> bool:
        """Whether it is certified and meets its constraints."""
        return bool(np.isfinite(self.objective))


def is_expensive(problem: CoDesignProblem) -> bool:
    """Whether the plant at another θ takes as long as a search for its controller: finite elements.

    Such a plant has cheap models `nearby` θ that are solved already.
    """
    return plant_of(problem).nearby is not None


class Outer(ABC):
    """The outer problem of one kind of inner problem, on a sampler's store and workers."""

    kkt_level: float  # scaled KKT residual up to which x counts as stationary
    same_optimum = 1e-2  # of the box: ends of local solves that are closer are one optimum
    extra_variables: tuple[str, ...] = ()  # components of x after θ, by their logarithms

    def __init__(self, sampler: Sampler) -> None:
        self.sampler = sampler

    @property
    def problem(self) -> CoDesignProblem:
        """The problem, with the plants and warm starts that searches have added to it."""
        return self.sampler.problem

    def theta_of(self, x: Array) -> Array:
        """θ of a point."""
        return np.asarray(x, float)[: len(self.problem.names)]

    @property
    def global_check_is_cheap(self) -> bool:
        """Whether the global check also starts local solves where J is not lower than at its x."""
        return not is_expensive(self.problem)

    def promising(self, thetas: Array, threshold: float) -> Array:
        """Those of θ (k, n_θ) at which no cheap bound proves J >= threshold; by default all."""
        return thetas

    @property
    def retries_pay(self) -> bool:
        """Whether an x that is not stationary is searched again from perturbed starts."""
        return True

    @property
    def bounds(self) -> Box:
        """The bounds of x."""
        return box(self.problem)

    def prepared(self, seed: int) -> "Outer":
        """This, ready for a search: for instance with warm starts for the controller."""
        return self

    def resumed(self, folder: Path, seed: int) -> "Outer":
        """This, with the warm starts and plants of the run in a folder, where a kind has them."""
        return self

    def solve_formulation(
        self, formulation: Formulation, seed: int, given: KnownSamples | None = None
    ) -> FormulationResult:
        """Solve one formulation, from the samples `given` by a run that is retrained, if any.

        Where x is θ alone there is nothing to lift but the gradients: lifted is then nested on
        samples with exact gradients.
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
        """The direct formulation: local solves from the case's start and from Sobol points.

        A single start with a design is returned as it is: the polish that follows is the local
        solve from it.
        """
        sobol = design("sobol", *box(self.problem), starts, seed)
        thetas = np.vstack([self.problem.start, sobol])[:starts]
        samples = self.sampler.values(thetas, "direct")
        if starts == 1 and samples[0].feasible:
            return FormulationResult(samples[0].joint, agreed=True)
        ends: list[Place] = []
        for sample in samples:
            if ends and ends_early("local solve"):
                continue
            end = self.local_solve(sample, ends)
            ends += [] if end is None else [end]
        if not ends:
            words = f"no design meets its constraints from {counted(starts, 'start')}"
            return FormulationResult(message=words)
        optima = distinct(
            [(end.objective, end.x) for end in ends], self.bounds, starts, self.same_optimum
        )
        return FormulationResult(optima.best.x, outer=optima, agreed=True)

    @abstractmethod
    def fallback(self, outcome: FormulationResult, seed: int) -> FormulationResult:
        """Replace an outcome without x: by a design to continue from, or a message why not."""

    @abstractmethod
    def polished(self, x: Array) -> PolishedDesign:
        """Local solve on the truth from x, then compare with a wider search of the inner problem
        at its θ (`gap`)."""

    def extended(self, end: PolishedDesign) -> "Outer | None":
        """This, with the plants on which an end exceeds a bound, to search again; None where there
        are none."""
        return None

    def with_training_sample(
        self, outcome: FormulationResult, end: PolishedDesign
    ) -> FormulationResult:
        """The outcome with the true sample at an end added to its surrogates, for an end that they
        did not predict."""
        values, gradients = self.training_samples(end, outcome.surrogates[0].lower.size)
        surrogates = [
            with_sample(process, end.x[: process.lower.size], value, gradient)
            for process, value, gradient in zip(outcome.surrogates, values, gradients, strict=True)
        ]
        return replace(outcome, surrogates=tuple(surrogates))

    def training_samples(self, end: PolishedDesign, inputs: int) -> tuple[Array, Array]:
        """Values (k,) and gradients (k, n) at an end of what k surrogates fit; n = `inputs`."""
        sample = self.sampler.values(self.theta_of(end.x), "the end")[0]
        return np.array([end.value]), np.array([sample.gradient])

    @abstractmethod
    def local_solve(
        self, sample: InnerSample, earlier: Sequence[Place], settled: float | None = None
    ) -> Place | None:
        """Local solve on the truth from a sample; None where it finds no feasible design.

        It stops where it comes near a stationary point of `earlier` ends: the basin is known.
        `settled`: relative change of J per step at which it stops, the kind's own by default.
        """

    def failure_reason(self, solution: Solution, share: float | None) -> str:
        """Why a solution is not verified. `share`: part of the tolerance of a robust set of plants
        up to which the homotopy found designs."""
        return str(solution.result["reason"])

    @abstractmethod
    def verified(self, end: PolishedDesign, rounds: int) -> Verified:
        """Judge the design on the truth, after this number of `rounds` of the whole search."""

    def point_of(self, run: FinishedRun) -> Array:
        """x of a run's design."""
        return np.array(run.theta)

    @abstractmethod
    def responses(self, x: Array) -> PostOptimal:
        """Derivatives of an optimum at x to the data of the problem (post-optimal sensitivity)."""
