"""First-order optimality of a controller, and what its bandwidth gains from the plant.

    ∇τ = Σ μ_j ∇c_j + ends of the box,  μ >= 0;      dτ*/dθ = -Σ μ_j ∂c_j/∂θ   (envelope theorem)

over the constraints that bind: at κ* the derivative of κ to θ does not enter. Where more binds than
κ leaves free μ is not unique, and τ*(θ) has a kink: each μ gives the gradient on one side of it, or
one between those (`Envelope`).
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.figures import to_theta
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopProblem
from ccd_casadi.optim.kkt import non_negative
from ccd_casadi.support.arrays import Array

ACTIVE = 1e-5  # ln of the share of its bound within which a constraint binds
NEAR = 1e-3  # the same within which it may bind at a kink that the search has not quite reached
RESIDUAL = 1e-3  # of ∇τ, which is 1: above it there is no envelope gradient


@dataclass(frozen=True)
class Envelope:
    """Every gradient to θ that the optimality of the controller leaves to its value v:

        {direct + to_thetaᵀ μ :  rowsᵀ μ = goal,  μ >= 0}        in the unit of v

    over what binds; `rows` (M, n + 1) are slopes to (κ, τ), `multipliers` (M,) one such μ.
    `to_theta` (m, n_θ) is of the m constraints, which come first and are named by kind: the ends of
    κ's box have none. `slack` (M,): by how much a constraint is off its bound, in logarithms; with
    μ slack a row counts that all but binds.
    """

    names: tuple[str, ...]
    direct: Array
    to_theta: Array
    rows: Array
    goal: Array
    multipliers: Array
    slack: Array

    @property
    def gradient(self) -> Array:
        """dv/dθ (n_θ,) by the μ that is given: on one side, where there is a kink."""
        return self.direct + self.multipliers[: len(self.to_theta)] @ self.to_theta

    def times(self, scale: float) -> "Envelope":
        """That of `scale` v."""
        return replace(self, direct=scale * self.direct, to_theta=scale * self.to_theta)


@dataclass(frozen=True)
class Optimality:
    """The conditions rowsᵀ μ = goal, μ >= 0, of what binds at a point, and how well they hold.

    `rows` (M, n + 1) are slopes to (κ, τ): first of the `active` bounds, each named in `kinds`,
    then of the ends of κ's box, (name, "lower" or "upper"), and of a least τ. `multipliers` (M,):
    change of the goal per ln of what a row is held against, of which a bound is `shares`: all, but
    for a shape whose room is not open yet; `residual` is over ‖goal‖∞; `violation`: by how much a
    bound is passed (logarithm). `near`: what all but binds, which counts for none of this.
    """

    active: Constraints
    near: Constraints
    kinds: tuple[str, ...]
    box_ends: tuple[tuple[str, str], ...]
    rows: Array
    goal: Array
    multipliers: Array
    residual: float
    violation: float
    shares: Array

    @property
    def ends(self) -> tuple[tuple[str, str, float], ...]:
        """The parameters at an end of their box, with their multipliers."""
        mu = self.multipliers[len(self.kinds) :]
        return tuple((*end, float(value)) for end, value in zip(self.box_ends, mu, strict=False))

    def named(self) -> dict[str, float]:
        """The multipliers by kind of bound, summed over plants and peaks."""
        found: dict[str, float] = {}
        for name, mu in zip(self.kinds, self.multipliers * self.shares, strict=False):
            if mu > 0.0:
                found[name] = found.get(name, 0.0) + float(mu)
        return found


def optimality(
    problem: LoopProblem, point: Point, goal: Array | None = None, floor: float = -np.inf
) -> Optimality:
    """Non-negative least squares on the active constraints of a point whose loops are stable.

    `goal` (n + 1,) is the gradient to (κ, τ) of what is made large, by default τ; `floor` the least
    τ.
    """
    peaks = point.assessment.peaks
    assert peaks is not None
    binds = np.abs(peaks.value) <= ACTIVE
    active, near = peaks.only(binds), peaks.only(~binds & (np.abs(peaks.value) <= NEAR))
    n = len(point.kappa)
    unit = np.eye(n + 1)
    rows, ends = [np.column_stack([active.to_kappa, active.to_tau])], []
    for i, name in enumerate(problem.structure.names):
        for row, sign, word in ((0, -1.0, "lower"), (1, 1.0, "upper")):
            if abs(point.kappa[i] - problem.box[row, i]) <= ACTIVE:
                rows.append(sign * unit[i : i + 1])
                ends.append((name, word))
    if abs(point.tau - floor) <= ACTIVE:
        rows.append(-unit[n:])
    shares, closed = np.ones(sum(map(len, rows))), problem.closed(active, point.tau)
    # ∂ ln(shape x - (shape - 1)/x)/∂ ln shape
    shares[: len(closed)] -= problem.inverse_square(active, point.tau)
    shares[: len(closed)] /= 1.0 - closed
    matrix, goal = np.concatenate(rows), unit[n] if goal is None else goal
    return Optimality(
        active, near, tuple(problem.kinds_of(active)), tuple(ends), matrix, goal,
        *non_negative(matrix, goal), point.assessment.violation, shares,
    )  # fmt: skip


def envelope_of(
    problem: LoopProblem, kappa: Array, optimality: Optimality, direct: Array | None = None
) -> Envelope | None:
    """That of ln ω_b*(θ), or of a value made small whose slope at a fixed κ is `direct` (n_θ,).

    None where the conditions of optimality do not hold.
    """
    if optimality.residual > RESIDUAL or optimality.violation > ACTIVE:
        return None
    near, count = optimality.near, len(optimality.kinds)
    slopes = np.concatenate([to_theta(problem, kappa, part) for part in (optimality.active, near)])
    if direct is None:
        direct, slopes = np.zeros(slopes.shape[1]), -slopes
    at = np.full(len(near.v), count)  # behind those that bind, before the ends of the box
    rows = np.insert(optimality.rows, at, np.column_stack([near.to_kappa, near.to_tau]), axis=0)
    return Envelope(
        (*optimality.kinds, *problem.kinds_of(near)), direct, slopes, rows, optimality.goal,
        np.insert(optimality.multipliers, at, 0.0),
        np.insert(np.zeros(len(optimality.rows)), at, np.abs(near.value)),
    )  # fmt: skip
