"""The interface of the outer problem min J(x), x = (θ, what else a kind adds), to its search.

`outer_search` calls it in this order: `prepared`, `solve_formulation` (surrogates, or local solves
on the truth), `polished` (a local solve, then a wider search for a better controller at its θ),
`extended` where plants exceed a bound at the design, `verified`. Each kind of inner problem
implements it.

`ThetaOuter` is that of any kind of controller whose value v(θ) has a gradient at each θ: local
solves by steps over the kinks of v (`optim.pieces`). A kind adds what only it knows: how a value
is held against a wider search, and how the design is judged.

*The truth* is the inner problem itself, in contrast to its surrogate. Lengths in x are shares of
the box of its bounds.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.codesign.formulations import Direct, Formulation, Lifted, solve_lifted
from ccd_casadi.codesign.gaussian_processes import with_sample
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.outer_problem import FormulationResult, KnownSamples, distinct
from ccd_casadi.codesign.verified import Solution, Verified
from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.optim.pieces import Box, Local, PiecesOptions, descend
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import plural
from ccd_casadi.support.time_budget import ends_early, time_is_up
from ccd_casadi.synthesis.weights import Weights
from surrogates import design

if TYPE_CHECKING:
    from ccd_casadi.codesign.post_optimal import PostOptimal


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
    """Whether the plant at another θ takes as long as a search for its controller."""
    return plant_of(problem).expensive


class OuterSearch(ABC):
    """The search for designs of one kind, on a sampler's store and workers."""

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
        """Keep those of θ (k, n_θ) at which no cheap bound proves J >= threshold; by default
        all."""
        return thetas

    @property
    def retries_pay(self) -> bool:
        """Whether an x that is not stationary is searched again from perturbed starts."""
        return True

    @property
    def bounds(self) -> Box:
        """The bounds of x."""
        return box(self.problem)

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
                "plan": "sobol", "points": formulation.sample_count(len(self.problem.names)),
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
            words = f"no design meets its constraints from {plural(starts, 'start')}"
            return FormulationResult(message=words)
        optima = distinct(
            [(end.objective, end.x) for end in ends], self.bounds, starts, self.same_optimum
        )
        return FormulationResult(optima.best.x, outer=optima, agreed=True)

    @abstractmethod
    def fallback(self, outcome: FormulationResult, seed: int) -> FormulationResult:
        """Replace an outcome without x: by a design to continue from, or a message why not."""

    @abstractmethod
    def polish(self, x: Array) -> PolishedDesign:
        """Local solve on the truth from x, then compare with a wider search of the inner problem
        at its θ (`gap`)."""

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


class OuterJudge(ABC):
    """The judge of the end of a search."""

    @abstractmethod
    def verify(self, end: PolishedDesign, rounds: int) -> Verified:
        """Judge the design on the truth, after this number of `rounds` of the whole search."""


class OuterDescription(ABC):
    """The words about a run and its design."""

    def failure_reason(self, solution: Solution, share: float | None) -> str:
        """Explain why a solution is not verified. `share`: part of the tolerance of a robust set of
        plants up to which the homotopy found designs."""
        return str(solution.result["reason"])

    def point_of(self, theta: Sequence[float], weights: Weights) -> Array:
        """x of a design at θ (SI) with these weights."""
        return np.array(theta)

    @abstractmethod
    def responses(self, x: Array) -> "PostOptimal":
        """Derivatives of an optimum at x to the data of the problem (post-optimal sensitivity)."""


class Outer(OuterSearch, OuterJudge, OuterDescription):
    """The outer problem of one kind of inner problem: a function takes the part that it needs.

    What a search has found out (warm starts, plants) is passed on by another `Outer`: none of them
    changes.
    """

    def prepare(self, seed: int) -> "Outer":
        """This, ready for a search: for instance with warm starts for the controller."""
        return self

    def resume(self, folder: Path, seed: int) -> "Outer":
        """This, with the warm starts and plants of the run in a folder, where a kind has them."""
        return self

    def add_exceeding_plants(self, end: PolishedDesign) -> "Outer | None":
        """This, with the plants on which an end exceeds a bound, to search again; None where there
        are none."""
        return None

    def add_refuting_plants(self, verified: Verified) -> "Outer | None":
        """This, with the plants by which the judge refutes a design, to search again from it; None
        where there are none."""
        return None


@dataclass(frozen=True)
class ThetaDescentOptions:
    """Numbers of descents over θ by the pieces of J."""

    settled: float = 1e-7  # of J: steps that promise less are not taken
    far_radius: float = 0.1  # of the box: the first one where the optimum may be far away
    descents: int = 3  # at most, each with the better controllers that the one before has found
    steps: int = 15  # per parameter, at most: from near by it takes half of that


class ThetaOuter(Outer, ABC):
    """See the module; `words` say why its kind has nothing to begin with, where it has not."""

    words = ""
    options = ThetaDescentOptions()

    @property
    def global_check_is_cheap(self) -> bool:
        return False

    def fallback(self, outcome: FormulationResult, seed: int) -> FormulationResult:
        """None: what falls short at the nearest θ, in words."""
        nearest = self.sampler.nearest
        words = self.words if nearest is None else nearest.shortfall
        return replace(outcome, message=words or outcome.message)

    def polish(self, x: Array) -> PolishedDesign:
        """Polished by the pieces of J; a kind without a wider search has nothing to set against."""
        problem, sampler = self.problem, self.sampler
        with sampler.spent.on("polish"):
            best = sampler.values(self.theta_of(x), "polishing")[0]
            best = pieces_from(sampler, best, self.options.settled)
        from ccd_casadi.codesign.optimality import theta_kkt

        kkt = theta_kkt(problem, best, sampler)
        return PolishedDesign(
            np.array(best.theta), best.value, objective_of(problem, best), kkt, np.nan
        )

    def local_solve(
        self, sample: InnerSample, earlier: Sequence[Place], settled: float | None = None
    ) -> Place | None:
        problem = self.problem
        far = self.options.far_radius, self.options.settled
        first, least = far if settled is None else (PiecesOptions.radius, settled)
        best = pieces_from(self.sampler, sample, least, first, earlier)
        J = objective_of(problem, best)
        if not np.isfinite(J):
            return None
        from ccd_casadi.codesign.optimality import ThetaKktOptions, theta_kkt

        stationary = theta_kkt(problem, best).stationarity <= ThetaKktOptions().smooth
        return Place(np.array(best.theta), J, stationary)

    def responses(self, x: Array) -> "PostOptimal":
        raise UserError("insight has no derivatives of an optimum of this kind of controller")


def pieces_from(
    sampler: Sampler,
    best: InnerSample,
    settled: float,
    first: float = PiecesOptions.radius,
    ends: Sequence[Place] = (),
    options: ThetaDescentOptions = ThetaDescentOptions(),
) -> InnerSample:
    """Descend J from a sample by its pieces, with what is known near by.

    It ends where the pieces promise no more, or near a stationary point of `ends`, and begins again
    from the best where a better controller was found on the way for what had been known.

    Parameters
    ----------
    sampler, best : Sampler, InnerSample
        The first θ, solved.
    settled : float
        Gain of J that the pieces may still promise at the end, relative.
    first : float
        First radius of a step, as a share of the box.
    ends : sequence of Place
        Where other descents ended.
    options : ThetaDescentOptions

    Returns
    -------
    InnerSample
        The best θ on the way.
    """
    problem, required = sampler.problem, [best]
    bounds = box(problem)
    ended = [(bounds.shares(place.x), place.objective) for place in ends if place.stationary]

    def at(z: Array) -> Local | None:
        if time_is_up():
            return None
        required.extend(sampler.values(bounds.point(z), "local solve"))
        return local(required[-1])

    @cache
    def local(sample: InnerSample) -> Local | None:
        J, gradient = objective_of(problem, sample), objective_gradient(problem, sample)
        if not (np.isfinite(J) and np.isfinite(gradient).all()):
            return None
        return Local(bounds.shares(sample.theta), J, gradient)

    def known() -> list[Local]:
        return [found for found in map(local, sampler.solved.values()) if found is not None]

    def constraints(z: Array) -> tuple[Array, Array]:
        found = hardware_at(problem, bounds.lower + bounds.width * z)
        return found.constraints, found.slopes

    for _ in range(options.descents):
        start, improvements = local(best), sampler.improvements
        if start is None:
            break
        steps = options.steps * len(problem.names)
        descend(
            at, start, known, constraints, steps=steps, settled=settled, first=first, ended=ended
        )
        best = min(sampler.latest(required), key=lambda sample: objective_of(problem, sample))
        if sampler.improvements == improvements or ends_early("local solve"):
            break
    return best
