"""A smooth goal of κ made small within rows of bounds, by quadratic programmes in a trust region.

    min v(κ) - reward τ + ρ max(0, max c(κ, τ)),   κ in its box,  τ >= floor

τ is ln of a bandwidth. The curvature of v is learnt by symmetric rank-one updates, which may curve
either way, that of the bounds is the model's own; their sum is made convex. Steps count only where
loops are stable; ρ grows while a bound is left passed.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ccd_casadi.fixed_structure.elastic_programme import FLAT, ROWS, Answer, solve_elastic
from ccd_casadi.fixed_structure.loop_problem import Constraints
from ccd_casadi.support.arrays import Array

PENALTIES = (20.0, 200.0, 2000.0)  # the next one where a bound is left passed
FIRST_RADIUS, LARGEST_RADIUS, LEAST_RADIUS = 0.2, 1.0, 1e-7
LEAST_GAIN = 1e-9
LOST = 1e-8  # share of its factors below which a scalar product is rounding
CONVEXIFYING = 10.0  # times AᵀA of the active rows
MOST = 200  # steps with one penalty


@dataclass(frozen=True)
class Point:
    """An iterate: κ, τ, the largest c above 0 (infinite: unstable), v and its slope, all rows c."""

    kappa: Array
    tau: float
    violation: float
    value: float
    slope: Array
    rows: Constraints | None


class Model(Protocol):
    """What is searched on."""

    def at(self, kappa: Array, tau: float) -> Point:
        """The point there; κ is put into its box."""

    def hessian(self, point: Point, rows: Constraints, mu: Array) -> Array:
        """Of Σ μ c to (κ, τ), for multipliers μ >= 0."""


def descend(
    model: Model, start: Point, box: Array, floor: float, reward: float, within: float
) -> tuple[Point, int]:
    """From a stable start to where steps help no longer, and how many there were.

    `within`: a violation that needs no larger penalty.
    """
    end, steps = start, 0
    for penalty in PENALTIES:
        end, count = _with_penalty(model, end, box, floor, reward, penalty)
        steps += count
        if end.violation <= within:
            break
    return end, steps


def _with_penalty(
    model: Model, start: Point, box: Array, floor: float, reward: float, penalty: float
) -> tuple[Point, int]:
    point, radius, steps = start, FIRST_RADIUS, 0
    n = len(start.kappa)
    smooth = bool(start.slope.any())
    curvature = np.eye(n) if smooth else np.zeros((n, n))

    def merit(at: Point) -> float:
        return at.value - reward * at.tau + penalty * at.violation

    def solved(rows: Constraints, value: Array, hessian: Array) -> Answer | None:
        low, high = np.full(n + 1, -radius), np.full(n + 1, radius)
        low[:n] = np.minimum(np.maximum(box[0] - point.kappa, -radius), 0.0)
        high[:n] = np.maximum(np.minimum(box[1] - point.kappa, radius), 0.0)
        low[n] = min(max(floor - point.tau, -radius), 0.0)
        cost = np.append(point.slope, -reward)
        slopes = np.column_stack([rows.to_kappa, rows.to_tau])
        found = solve_elastic(slopes, value, cost, hessian, low, high, penalty)
        if found is None:
            return None
        return found._replace(gain=found.gain + penalty * point.violation)

    for turn in range(1, MOST + 1):
        steps = turn
        rows = _chosen(point, radius)
        hessian = np.zeros((n + 1, n + 1))
        hessian[:n, :n] = curvature
        found = solved(rows, rows.value, _convex(hessian))
        if found is None:
            break
        mu = np.where(found[1] > 1e-7 * penalty, found[1], 0.0)
        hessian = hessian + model.hessian(point, rows, mu)
        active = np.column_stack([rows.to_kappa, rows.to_tau])[mu > 0.0]
        convex = _convex(hessian + CONVEXIFYING * active.T @ active)
        found = solved(rows, rows.value, convex)
        if found is None or found[2] <= LEAST_GAIN:
            break
        change, _, predicted = found
        trial = model.at(point.kappa + change[:n], point.tau + float(change[n]))
        gained = merit(point) - merit(trial)
        if gained < 0.7 * predicted and trial.rows is not None:  # second-order correction
            again = _chosen(trial, radius)
            back = again.to_kappa @ change[:n] + again.to_tau * change[n]
            other = solved(again, again.value - back, convex)
            if other is not None:
                corrected = model.at(point.kappa + other[0][:n], point.tau + float(other[0][n]))
                if merit(point) - merit(corrected) > gained:
                    trial, gained = corrected, merit(point) - merit(corrected)
        if smooth and trial.rows is not None:
            curvature = _updated(curvature, trial.kappa - point.kappa, trial.slope - point.slope)
        size = float(np.abs(change).max())
        if gained > 0.0:
            point = trial
        if gained > 0.7 * predicted:
            radius = min(max(radius, 2.0 * size), LARGEST_RADIUS)
        elif gained < 0.2 * predicted:
            radius = (0.5 if gained > 0.0 else 0.3) * min(radius, size)
        if radius < LEAST_RADIUS:
            break
    return point, steps


def _updated(B: Array, s: Array, y: Array) -> Array:
    """Symmetric rank one, left as it is where its denominator is lost (Nocedal & Wright 6.26)."""
    rest = y - B @ s
    size = float(rest @ s)
    if abs(size) <= LOST * float(np.linalg.norm(rest) * np.linalg.norm(s)):
        return B
    return np.asarray(B + np.outer(rest, rest) / size)


def _convex(H: Array) -> Array:
    """H with its eigenvalues raised to at least `FLAT`."""
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors * np.maximum(values, FLAT)) @ vectors.T)


def _chosen(point: Point, radius: float) -> Constraints:
    """The rows that a step of this size may lift over their bounds, the highest if too many."""
    rows = point.rows
    assert rows is not None
    slack = rows.value + radius * (np.abs(rows.to_kappa).sum(1) + np.abs(rows.to_tau))
    chosen = np.flatnonzero(slack > 0.0)
    return rows.only(chosen[np.argsort(-slack[chosen], kind="stable")[: ROWS]])
