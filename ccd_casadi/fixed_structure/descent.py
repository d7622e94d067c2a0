"""A smooth goal of κ made small within rows of bounds, by quadratic programmes in a trust region.

    min v(κ) - reward τ + ρ max(0, max c(κ, τ)),   κ in its box,  τ >= floor

τ is ln of a bandwidth. The curvature of v is learnt by symmetric rank-one updates, which may curve
either way, that of the bounds is the model's own; their sum is made convex. Steps count only where
loops are stable; ρ grows while a bound is left passed.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import casadi as ca
import numpy as np

from ccd_casadi.fixed_structure.figures import Constraints
from ccd_casadi.fixed_structure.trust_region import OPTIONS
from ccd_casadi.support.arrays import Array

PENALTIES = (20.0, 200.0, 2000.0)  # the next one where a bound is left passed
FIRST_RADIUS, LARGEST_RADIUS, LEAST_RADIUS = 0.2, 1.0, 1e-7
LEAST_GAIN = 1e-9
LOST = 1e-8  # share of its factors below which a scalar product is rounding
FLAT = 1e-4  # least curvature
CONVEXIFYING = 10.0  # times AᵀA of the active rows
MOST = 200  # steps with one penalty
ROWS = (64, 128, 300)  # sizes of programmes, so that few solvers are made
KEPT = 1e-7  # by how much a programme's answer may miss its own rows


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

    def solved(rows: Constraints, value: Array, hessian: Array) -> tuple | None:
        low, high = np.full(n + 1, -radius), np.full(n + 1, radius)
        low[:n] = np.minimum(np.maximum(box[0] - point.kappa, -radius), 0.0)
        high[:n] = np.maximum(np.minimum(box[1] - point.kappa, radius), 0.0)
        low[n] = min(max(floor - point.tau, -radius), 0.0)
        cost = np.append(point.slope, -reward)
        slopes = np.column_stack([rows.to_kappa, rows.to_tau])
        found = _programme(slopes, value, cost, hessian, low, high, penalty)
        return None if found is None else (*found[:2], found[2] + penalty * point.violation)

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
    return rows.only(chosen[np.argsort(-slack[chosen], kind="stable")[: ROWS[-1]]])


def _programme(
    slopes: Array,
    value: Array,
    cost: Array,
    hessian: Array,
    low: Array,
    high: Array,
    penalty: float,
) -> tuple[Array, Array, float] | None:
    """p, the multipliers of value + slopes·p <= σ, and -(cost·p + ½ pᵀHp + ρ σ)."""
    m, n = slopes.shape
    size = next(size for size in ROWS if size >= m)
    A = np.zeros((size, n + 1))
    A[:m, :n], A[:m, n] = slopes, -1.0
    upper = np.ones(size)
    upper[:m] = -value
    H = np.zeros((n + 1, n + 1))
    H[:n, :n], H[n, n] = hessian, FLAT
    ends = np.append(low, 0.0), np.append(high, 1e4)
    for name in ("daqp", "ipqp"):
        solver = _solver(name, n + 1, size)
        found = solver(h=H, g=np.append(cost, penalty), a=A, lba=-np.inf, uba=upper,
                       lbx=ends[0], ubx=ends[1])  # fmt: skip
        x = np.array(found["x"]).ravel()
        if solver.stats()["success"] and (A @ x - upper).max() <= KEPT:
            mu = np.maximum(np.array(found["lam_a"]).ravel()[:m], 0.0)
            return x[:n], mu, -float(found["cost"])
    return None


@lru_cache(maxsize=32)
def _solver(name: str, n: int, rows: int) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    return ca.conic("programme", name, shapes, {"error_on_fail": False, **OPTIONS[name]})
