"""First-order optimality of a controller, and what its bandwidth gains from the plant.

    ∇τ = Σ μ_j ∇c_j + ends of the box,  μ >= 0;      dτ*/dθ = -Σ μ_j ∂c_j/∂θ   (envelope theorem)

over the constraints that bind: at κ* the derivative of κ to θ does not enter.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ccd_casadi.fixed_structure.composite import kinds_of_rows
from ccd_casadi.fixed_structure.figures import to_theta
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopProblem
from ccd_casadi.fixed_structure.trust_region import Point
from ccd_casadi.support.arrays import Array

ACTIVE = 1e-5  # ln of the share of its bound within which a constraint binds
RESIDUAL = 1e-3  # of ∇τ, which is 1: above it there is no envelope gradient


@dataclass(frozen=True)
class Optimality:
    """What binds, its multipliers (change of ln ω_b per ln of a bound), the residual over ‖∇τ‖,
    and by how much a bound is passed (logarithm).

    `kinds` names the bound of each that is active; `ends` are the parameters at an end of their
    box, as (name, "lower" or "upper", multiplier).
    """

    active: Constraints
    kinds: tuple[str, ...]
    multipliers: Array
    ends: tuple[tuple[str, str, float], ...]
    residual: float
    violation: float

    def named(self) -> dict[str, float]:
        """The multipliers by kind of bound, summed over plants and peaks."""
        found: dict[str, float] = {}
        for name, mu in zip(self.kinds, self.multipliers, strict=True):
            if mu > 0.0:
                found[name] = found.get(name, 0.0) + float(mu)
        return found


def optimality(problem: LoopProblem, point: Point) -> Optimality:
    """Non-negative least squares on the active constraints of a point whose loops are stable."""
    peaks = point.assessment.peaks
    assert peaks is not None
    active = peaks.only(np.abs(peaks.value) <= ACTIVE)
    n = len(point.kappa)
    columns = [np.column_stack([active.to_kappa, active.to_tau])]
    ends = []
    for i, name in enumerate(problem.structure.names):
        for row, sign, word in ((0, -1.0, "lower"), (1, 1.0, "upper")):
            if abs(point.kappa[i] - problem.box[row, i]) <= ACTIVE:
                columns.append(sign * np.eye(n + 1)[i : i + 1])
                ends.append((name, word))
    matrix = np.concatenate(columns).T
    goal = np.eye(n + 1)[n]
    if matrix.shape[1] == 0:
        return Optimality(active, (), np.zeros(0), (), 1.0, point.assessment.violation)
    mu, _ = nnls(matrix, goal, maxiter=100 * matrix.shape[1])
    residual = float(np.abs(matrix @ mu - goal).max())
    count = len(active.v)
    found = tuple((*end, float(value)) for end, value in zip(ends, mu[count:], strict=True))
    kinds = tuple(kinds_of_rows(problem, active))
    return Optimality(active, kinds, mu[:count], found, residual, point.assessment.violation)


def log_bandwidth_gradient(problem: LoopProblem, kappa: Array, found: Optimality) -> Array:
    """d ln ω_b*/dθ (n_θ,); NaN where the conditions of optimality do not hold."""
    slopes = to_theta(problem, kappa, found.active)
    if found.residual > RESIDUAL or found.violation > ACTIVE:
        return np.full(slopes.shape[1], np.nan)
    return -found.multipliers @ slopes
