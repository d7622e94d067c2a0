"""Hardware and controller together: J over θ, κ and ω_b within the bounds of every loop.

    min cost(z) - reward e^(τ - τ₀),   c(κ, τ; z) <= 0,  λ(z) <= 0,      z: θ in shares of its box

by `optim.trust_region`, with the rows of `local_search` and their slopes to z. Where c bends, it
bends most where a resonance that moves with z meets a notch that moves with κ: its Hessian is that
to all three.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.figures import BESIDE, assess, hessians, to_theta
from ccd_casadi.fixed_structure.local_search import all_rows
from ccd_casadi.fixed_structure.loop_problem import Assessment, LoopProblem
from ccd_casadi.optim.trust_region import Iterate, Model, Rows
from ccd_casadi.support.arrays import Array

FAR = 3.0  # radii of κ and τ by which a row may lie below its bound and still be looked at

ToFirstOrder = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Goal:
    """The cost of z and its slopes (n,), λ (m,) and its slopes (m, n), what e^(τ - τ₀) is worth."""

    cost: Callable[[Array], tuple[float, Array]]
    constraints: ToFirstOrder
    reward: float
    tau: float


@dataclass(frozen=True)
class Joint:
    """The loops at a point x = (z, κ, τ)."""

    problem: LoopProblem
    assessment: Assessment


class JointModel(Model[Joint]):
    """`family` gives the loops of the set at z, in the same units at every z; `low` and `high`
    bound z. J counts in its reward."""

    corrected = True

    def __init__(
        self, family: Callable[[Array], LoopProblem], goal: Goal, low: Array, high: Array
    ) -> None:
        self.family, self.goal, self.count = family, goal, len(low)
        kappa = family(0.5 * (low + high)).box
        self.low = np.concatenate([low, kappa[0], [-np.inf]])
        self.high = np.concatenate([high, kappa[1], [np.inf]])

    def at(self, x: Array) -> Iterate[Joint] | None:
        """With every loop stable."""
        x = np.clip(x, self.low, self.high)
        z, kappa, tau = self._parts(x)
        problem = self.family(z)
        found = assess(problem, kappa, tau)
        if not found.stable:
            return None
        cost, slope = self.goal.cost(z)
        worth = float(np.exp(tau - self.goal.tau))
        gradient = np.concatenate([slope / self.goal.reward, np.zeros(len(kappa)), [-worth]])
        violation = max(found.violation, float(self.goal.constraints(z)[0].max(initial=0.0)))
        value = cost / self.goal.reward - worth
        return Iterate(x, value, gradient, violation, Joint(problem, found))

    def rows(self, here: Iterate[Joint], radius: float) -> Rows:
        """Peaks, λ, and the grid near the peaks."""
        z, kappa, tau = self._parts(here.x)
        problem, found = here.data.problem, all_rows(here.data.assessment)
        peaks = here.data.assessment.peaks
        assert peaks is not None
        steep = np.abs(found.to_kappa).sum(1) + np.abs(found.to_tau)
        kept = np.flatnonzero(found.value + FAR * radius * np.maximum(steep, 1.0) > 0.0)
        curved = int((kept < len(peaks.v)).sum())
        found = found.only(kept)
        own = to_theta(problem, kappa, found)
        value, slope = self.goal.constraints(z)
        slopes = np.zeros((len(found.v) + len(value), len(here.x)))
        slopes[: len(found.v)] = np.column_stack([own, found.to_kappa, found.to_tau])
        slopes[len(found.v) :, : self.count] = slope

        def second(index: np.ndarray) -> Array:
            others = [self.family(z + BESIDE * unit) for unit in np.eye(self.count)]
            return hessians(problem, kappa, tau, found.only(index), others)

        return Rows(
            np.concatenate([found.value, value]), slopes,
            hard=np.arange(len(slopes)) >= len(found.v), hessians=second, curved=curved,
        )  # fmt: skip

    def _parts(self, x: Array) -> tuple[Array, Array, float]:
        return x[: self.count], x[self.count : -1], float(x[-1])
