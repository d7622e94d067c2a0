"""max ω_b over κ, or a smooth goal of κ made small, within the bounds of every loop.

    min v(κ) - reward τ + ρ max(0, max c(κ, τ)),   κ in its box,  τ = ln(ω_b/ω₀) >= floor

by `optim.trust_region`, with all local peaks and the grid values near their bounds as rows. A step
counts only where every closed loop stays stable.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ccd_casadi.fixed_structure.figures import assess, constraints, hessians
from ccd_casadi.fixed_structure.loop_problem import Assessment, Constraints, LoopProblem
from ccd_casadi.optim.quadratic import symmetric_rank_one
from ccd_casadi.optim.trust_region import Data, Iterate, Model, Radius, Rows, Step, minimise
from ccd_casadi.support.arrays import Array

FIRST_RADIUS, LARGEST_RADIUS = 0.2, 1.5
PENALTY = 20.0  # above the sum of multipliers: a per cent of a bound is worth so many of ω_b
RESTORING = 400.0  # that of an end that is to be brought within its bounds
PENALTIES = (20.0, 200.0, 2000.0)  # of a goal; the next one where a bound is left passed
LEAST_RADIUS, LEAST_GAIN = 1e-7, 1e-9
MERGED = 1e-3  # in κ and τ: searches as close as that are one
MOST = 200  # steps with one penalty

Goal = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class Point:
    """A controller at a bandwidth: κ, τ = ln(ω_b/ω₀), its assessment."""

    kappa: Array
    tau: float
    assessment: Assessment

    def merit(self) -> float:
        """τ - ρ violation, to be made large."""
        return self.tau - PENALTY * self.assessment.violation


@dataclass(frozen=True)
class Ascent:
    """Where a local search is, the radius it has, and how many loops it looked at.

    `done`: further steps do not help.
    """

    point: Point
    radius: float = FIRST_RADIUS
    evaluations: int = 1
    done: bool = False


class LoopModel(Model[Assessment]):
    """The bounds of a set of loops as rows over x = (κ, τ); `goal` gives v(κ) and its gradient.

    `known`: x where searches have been; another one ends when it comes there.
    """

    corrected = True

    def __init__(
        self,
        problem: LoopProblem,
        goal: Goal | None = None,
        reward: float = 1.0,
        floor: float = -np.inf,
    ) -> None:
        self.problem, self.goal, self.reward = problem, goal, reward
        self.known: list[Array] = []
        # A step that fails is followed by one from the same place.
        self.all_rows = lru_cache(2)(
            lambda here: all_rows(problem, here.x[:-1], float(here.x[-1]), here.data)
        )
        # Where nothing bounds ω_b it stops at the end of the grid instead of running away.
        top = float(np.log(problem.plants.frequency(problem.base[-1])))
        self.low = np.append(problem.box[0], floor)
        self.high = np.append(problem.box[1], top)

    def at(self, x: Array) -> Iterate[Assessment] | None:
        """With every loop stable, and v finite."""
        kappa = np.clip(x[:-1], *self.problem.box)
        return self.assessed(kappa, float(x[-1]), assess(self.problem, kappa, float(x[-1])))

    def assessed(self, kappa: Array, tau: float, found: Assessment) -> Iterate[Assessment] | None:
        """The iterate of an assessment."""
        value, slope = 0.0, np.zeros(len(kappa))
        if found.stable and self.goal is not None:
            value, slope = self.goal(kappa)
        if not found.stable or not np.isfinite(value):
            return None
        x, gradient = np.append(kappa, tau), np.append(slope, -self.reward)
        return Iterate(x, value - self.reward * tau, gradient, found.violation, found)

    def rows(self, here: Iterate[Assessment], radius: float) -> Rows:
        """Peaks with their curvature, and the grid near them without."""
        kappa, tau, peaks = here.x[:-1], float(here.x[-1]), here.data.peaks
        assert peaks is not None
        found = self.all_rows(here)

        def second(index: np.ndarray) -> Array:
            return hessians(self.problem, kappa, tau, found.only(index))

        slopes = np.column_stack([found.to_kappa, found.to_tau])
        return Rows(found.value, slopes, hessians=second, curved=len(peaks.v))

    def learnt(
        self,
        H: Array,
        here: Iterate[Assessment],
        there: Iterate[Assessment],
        step: Step,
        radius: float,
    ) -> Array:
        """That of v."""
        if self.goal is None:
            return H
        return symmetric_rank_one(H, there.x - here.x, there.gradient - here.gradient)

    def ended(self, here: Iterate[Assessment], there: Iterate[Assessment]) -> bool:
        """Where another search has been."""
        return self.is_known(there.x)

    def is_known(self, x: Array) -> bool:
        """Whether another search has been there."""
        return any(np.abs(x - other).max() <= MERGED for other in self.known)


def all_rows(problem: LoopProblem, kappa: Array, tau: float, found: Assessment) -> Constraints:
    """The peaks, and after them the values near."""
    assert found.peaks is not None
    assert found.near is not None
    return found.peaks.and_those(constraints(problem, kappa, tau, found.near))


def ascend(
    problem: LoopProblem,
    start: Point,
    *,
    iterations: int,
    radius: float = FIRST_RADIUS,
    least_radius: float = 1e-6,
    least_gain: float = 1e-8,
    restoring: bool = False,
) -> Ascent:
    """Climb to a larger ω_b, or with `restoring` within the bounds first, from a start whose loops
    are stable; ends where steps do not help."""
    model = LoopModel(problem)
    model.restoring = restoring
    begin = model.assessed(start.kappa, start.tau, start.assessment)
    assert begin is not None
    n = len(begin.x)
    end = minimise(
        model, begin, np.zeros((n, n)), Radius(radius, least_radius, LARGEST_RADIUS),
        steps=iterations, penalty=RESTORING if restoring else PENALTY, least_gain=least_gain,
    )  # fmt: skip
    x = end.best.x
    point = Point(x[:-1], float(x[-1]), end.best.data)
    return Ascent(point, end.radius.value, end.evaluations, end.done)


def descend(
    model: Model[Data], start: Iterate[Data], H: Array, within: float
) -> tuple[Iterate[Data], int]:
    """From a stable start to where steps help no longer, and how many loops were looked at.

    `within`: a violation that needs no larger penalty. H (n + 1, n + 1): the first of v.
    """
    end, evaluations = start, 0
    for penalty in PENALTIES:
        found = minimise(
            model, end, H, Radius(FIRST_RADIUS, LEAST_RADIUS, 1.0), steps=MOST, penalty=penalty,
            least_gain=LEAST_GAIN,
        )  # fmt: skip
        end, evaluations = found.best, evaluations + found.evaluations
        if end.violation <= within:
            break
    return end, evaluations
