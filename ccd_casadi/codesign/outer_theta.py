"""The outer problem over θ alone: of any kind of controller whose value has a gradient at each θ.

A formulation works on v(θ) with its envelope gradients. A kind adds what only it knows: how a value
is held against a wider search, and how the design is judged.
"""

from abc import ABC
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.codesign.formulation import FormulationResult, KnownSamples
from ccd_casadi.codesign.lifted import Lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.outer import End, Outer, Place
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.codesign.theta_direct import FAR, SETTLED, pieces_from
from ccd_casadi.codesign.theta_kkt import SMOOTH, theta_kkt
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.optim.pieces import FIRST
from ccd_casadi.sampling.samples import InnerSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


class ThetaOuter(Outer, ABC):
    """See the module; `words` say why its kind has nothing to begin with, where it has not."""

    words = ""

    @property
    def global_check_is_cheap(self) -> bool:
        return False

    def solve_lifted(
        self, formulation: Lifted, seed: int, given: KnownSamples | None = None
    ) -> FormulationResult:
        """Nested; what is lifted are the exact gradients, as x is θ."""
        options = Nested(
            "sobol", formulation.points or 6 * len(self.problem.names), formulation.starts,
            formulation.tolerance, formulation.max_refinements, formulation.kernel,
        )  # fmt: skip
        return solve_nested(self.sampler, options, seed=seed, given=given, gradients=True)

    def fallback(self, outcome: FormulationResult, seed: int) -> FormulationResult:
        """None: what falls short at the nearest θ, in words."""
        nearest = self.sampler.nearest
        words = self.words if nearest is None else nearest.shortfall
        return replace(outcome, message=words or outcome.message)

    def polished(self, x: Array) -> End:
        """Polished by the pieces of J; a kind without a wider search has nothing to set against."""
        problem, sampler = self.problem, self.sampler
        with sampler.spent.on("polish"):
            best = sampler.values(self.theta_of(x), "polishing")[0]
            best = pieces_from(sampler, best, SETTLED)
        kkt = theta_kkt(problem, best, sampler)
        return End(np.array(best.theta), best.value, objective_of(problem, best), kkt, 0.0)

    def local_solve(
        self, sample: InnerSample, known: Sequence[Place], settled: float | None = None
    ) -> Place | None:
        problem = self.problem
        first, least = (FAR, SETTLED) if settled is None else (FIRST, settled)
        best = pieces_from(self.sampler, sample, least, first)
        J = objective_of(problem, best)
        if not np.isfinite(J):
            return None
        stationary = theta_kkt(problem, best).stationarity <= SMOOTH
        return Place(np.array(best.theta), J, stationary)

    def responses(self, x: Array) -> PostOptimal:
        raise UserError("insight has no derivatives of an optimum of this kind of controller")
