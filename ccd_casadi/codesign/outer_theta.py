"""The outer problem over θ alone: of any kind of controller whose value has a gradient at each θ.

A formulation works on v(θ) with its envelope gradients, local solves by steps that pass its kinks
(`optim.pieces`). A kind adds what only it knows: how a value
is held against a wider search, and how the design is judged.
"""

from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.outer import Outer, Place, PolishedDesign
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.codesign.theta_kkt import ThetaKktOptions, theta_kkt
from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.optim.pieces import Local, PiecesOptions, descend
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.time_budget import ends_early, time_is_up


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

    def polished(self, x: Array) -> PolishedDesign:
        """Polished by the pieces of J; a kind without a wider search has nothing to set against."""
        problem, sampler = self.problem, self.sampler
        with sampler.spent.on("polish"):
            best = sampler.values(self.theta_of(x), "polishing")[0]
            best = pieces_from(sampler, best, self.options.settled)
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
        stationary = theta_kkt(problem, best).stationarity <= ThetaKktOptions().smooth
        return Place(np.array(best.theta), J, stationary)

    def responses(self, x: Array) -> PostOptimal:
        raise UserError("insight has no derivatives of an optimum of this kind of controller")


def pieces_from(
    sampler: Sampler,
    best: InnerSample,
    settled: float,
    first: float = PiecesOptions.radius,
    ends: Sequence[Place] = (),
    options: ThetaDescentOptions = ThetaDescentOptions(),
) -> InnerSample:
    """From a sample to where the pieces of J promise no more, or near a stationary point of `ends`,
    with what is known near by.

    Again from the best where a better controller was found on the way for what had been known.
    """
    problem, asked = sampler.problem, [best]
    bounds = box(problem)
    ended = [(bounds.shares(place.x), place.objective) for place in ends if place.stationary]

    def at(z: Array) -> Local | None:
        if time_is_up():
            return None
        asked.extend(sampler.values(bounds.point(z), "local solve"))
        return local(asked[-1])

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
        best = min(sampler.latest(asked), key=lambda sample: objective_of(problem, sample))
        if sampler.improvements == improvements or ends_early("local solve"):
            break
    return best
