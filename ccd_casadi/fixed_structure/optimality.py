"""First-order optimality of a controller, and what its bandwidth gains from the plant.

    ∇τ = Σ μ_j ∇c_j + ends of the box,  μ >= 0;      dτ*/dθ = -Σ μ_j ∂c_j/∂θ   (envelope theorem)

over the constraints that bind: at κ* the derivative of κ to θ does not enter. Where more binds than
κ leaves free μ is not unique, and τ*(θ) has a kink: each μ gives the gradient on one side of it, or
one between those (`Envelope`).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from ccd_casadi.fixed_structure.composite import kinds_of_rows
from ccd_casadi.fixed_structure.figures import to_theta
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopProblem
from ccd_casadi.support.arrays import Array

ACTIVE = 1e-5  # ln of the share of its bound within which a constraint binds
RESIDUAL = 1e-3  # of ∇τ, which is 1: above it there is no envelope gradient


@dataclass(frozen=True)
class Envelope:
    """Every gradient to θ that the optimality of the controller leaves to its value v:

        {direct + to_thetaᵀ μ :  rowsᵀ μ = goal,  μ >= 0}        in the unit of v

    over what binds; `rows` (M, n + 1) are slopes to (κ, τ), `multipliers` (M,) one such μ.
    `to_theta` (m, n_θ) is of the m constraints, which come first and are named by kind: the ends of
    κ's box have none.
    """

    names: tuple[str, ...]
    direct: Array
    to_theta: Array
    rows: Array
    goal: Array
    multipliers: Array

    @property
    def gradient(self) -> Array:
        """dv/dθ (n_θ,) by the μ that is given: on one side, where there is a kink."""
        return self.direct + self.multipliers[: len(self.to_theta)] @ self.to_theta

    def times(self, scale: float) -> "Envelope":
        """That of `scale` v."""
        return replace(self, direct=scale * self.direct, to_theta=scale * self.to_theta)


@dataclass(frozen=True)
class Optimality:
    """What binds, its multipliers (change of ln ω_b per ln of a bound), the residual over ‖∇τ‖,
    and by how much a bound is passed (logarithm).

    `kinds` names the bound of each that is active; `ends` are the parameters at an end of their
    box, as (name, "lower" or "upper", multiplier); `rows` (M, n + 1) are the slopes to (κ, τ) of
    what is active, the ends last.
    """

    active: Constraints
    kinds: tuple[str, ...]
    multipliers: Array
    ends: tuple[tuple[str, str, float], ...]
    residual: float
    violation: float
    rows: Array

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
        return Optimality(active, (), np.zeros(0), (), 1.0, point.assessment.violation, matrix.T)
    mu, _ = nnls(matrix, goal, maxiter=100 * matrix.shape[1])
    residual = float(np.abs(matrix @ mu - goal).max())
    count = len(active.v)
    found = tuple((*end, float(value)) for end, value in zip(ends, mu[count:], strict=True))
    kinds = tuple(kinds_of_rows(problem, active))
    short = point.assessment.violation
    return Optimality(active, kinds, mu[:count], found, residual, short, matrix.T)


def log_bandwidth_envelope(
    problem: LoopProblem, kappa: Array, found: Optimality
) -> Envelope | None:
    """That of ln ω_b*(θ); None where the conditions of optimality do not hold."""
    if found.residual > RESIDUAL or found.violation > ACTIVE:
        return None
    slopes = -to_theta(problem, kappa, found.active)
    n = found.rows.shape[1]
    mu = np.append(found.multipliers, [value for _, _, value in found.ends])
    goal = np.eye(n)[n - 1]
    return Envelope(found.kinds, np.zeros(slopes.shape[1]), slopes, found.rows, goal, mu)
