"""max ω_b over κ by sequential quadratic programming in a trust region.

    max δ - ρ σ - ½ pᵀHp   s.t.  c_j + ∇c_j·p <= σ,  |p| <= Δ,  κ + d in its box,  σ >= 0,

p = (d, δ), with all local peaks and the grid values near their bounds as rows. H is the Hessian of
the Lagrangian with the multipliers of the linear programme (H = 0), made convex. A step counts only
where every closed loop stays stable, and where τ - ρ max(0, max c) rises: the exact penalty
function of the largest violation. (Fletcher & Sainz de la Maza 1989.) The programmes are solved by
CasADi's DAQP, or by its interior-point method where that one fails.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.fixed_structure.curvature import lagrangian_hessian
from ccd_casadi.fixed_structure.figures import Assessment, Constraints, LoopProblem, assess
from ccd_casadi.support.arrays import Array

FIRST_RADIUS = 0.2
LARGEST_RADIUS = 1.5
PENALTY = 20.0  # above the sum of multipliers: a per cent of a bound is worth so many of ω_b
ROWS = (64, 128, 256, 400)  # sizes of programmes, so that few solvers are made
FLAT = 1e-4  # least curvature, which leaves a linear programme one
ENOUGH = 0.7  # of the predicted gain: with it a model is trusted further
KEPT = 1e-7  # by how much a programme's answer may miss its own rows
# The dual active-set method is fast, the interior-point method misses nothing.
OPTIONS: dict[str, dict[str, Any]] = {
    "daqp": {"daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}},
    "ipqp": {"print_iter": False, "print_header": False, "print_info": False},
}
CONVEXIFYING = 10.0  # times AᵀA of the active rows: changes nothing along them


@dataclass(frozen=True)
class Point:
    """An iterate: κ, τ = ln(ω_b/ω₀), its assessment."""

    kappa: Array
    tau: float
    assessment: Assessment

    def merit(self, penalty: float = PENALTY) -> float:
        """τ - ρ violation, to be made large."""
        return self.tau - penalty * self.assessment.violation


@dataclass(frozen=True)
class Ascent:
    """Where a local search ended, the radius it had, and how many loops it looked at."""

    point: Point
    radius: float
    evaluations: int


@dataclass(frozen=True)
class Step:
    """p = (d, δ), the gain of merit that the model predicts, the rows and their multipliers."""

    change: Array
    predicted: float
    rows: Constraints
    multipliers: Array
    hessian: Array


def ascend(
    problem: LoopProblem,
    start: Point,
    *,
    iterations: int,
    radius: float = FIRST_RADIUS,
    least_radius: float = 1e-6,
    least_gain: float = 1e-8,
    penalty: float = PENALTY,
) -> Ascent:
    """Climb from a start whose loops are stable; ends where steps no longer help."""
    point, evaluations = start, 0
    for _ in range(iterations):
        step = best_step(problem, point, radius, penalty)
        if step is None or step.predicted <= least_gain:
            break
        trial = _moved(problem, point, step)
        evaluations += 1
        gained = trial.merit(penalty) - point.merit(penalty)
        if gained < ENOUGH * step.predicted and trial.assessment.stable:
            again = _corrected(problem, point, step, trial, radius, penalty)
            if again is not None:
                other = _moved(problem, point, again)
                evaluations += 1
                better = other.merit(penalty) - point.merit(penalty)
                if better > gained:
                    trial, gained = other, better
        size = float(np.abs(step.change).max())
        if gained > 0.0:
            point = trial
        if gained > ENOUGH * step.predicted:
            radius = min(max(radius, 2.0 * size), LARGEST_RADIUS)
        elif gained < 0.2 * step.predicted:
            radius = (0.5 if gained > 0.0 else 0.3) * min(radius, size)
        if radius < least_radius:
            break
    return Ascent(point, radius, evaluations)


def _moved(problem: LoopProblem, point: Point, step: Step) -> Point:
    kappa = np.clip(point.kappa + step.change[:-1], *problem.box)
    tau = point.tau + float(step.change[-1])
    return Point(kappa, tau, assess(problem, kappa, tau))


def best_step(
    problem: LoopProblem, point: Point, radius: float, penalty: float = PENALTY
) -> Step | None:
    """The step of the quadratic model; None where its programme has no answer."""
    rows = _rows(point.assessment, radius)
    flat = FLAT * np.eye(len(point.kappa) + 1)
    linear = _programme(problem, point, rows, rows.value, flat, radius, penalty)
    if linear is None:
        return None
    mu = np.where(linear.multipliers > 1e-7 * penalty, linear.multipliers, 0.0)
    hessian = lagrangian_hessian(problem, point.kappa, point.tau, rows, mu)
    active = np.column_stack([rows.to_kappa, rows.to_tau])[mu > 0.0]
    values, vectors = np.linalg.eigh(hessian + CONVEXIFYING * active.T @ active)
    convex = (vectors * np.maximum(values, FLAT)) @ vectors.T
    return _programme(problem, point, rows, rows.value, convex, radius, penalty) or linear


def _corrected(
    problem: LoopProblem, point: Point, step: Step, trial: Point, radius: float, penalty: float
) -> Step | None:
    """The second-order correction: the same model with the constraints as they are at the trial."""
    rows = _rows(trial.assessment, radius)
    back = rows.to_kappa @ step.change[:-1] + rows.to_tau * step.change[-1]
    value = rows.value - back
    return _programme(problem, point, rows, value, step.hessian, radius, penalty)


def _programme(
    problem: LoopProblem,
    point: Point,
    rows: Constraints,
    value: Array,
    hessian: Array,
    radius: float,
    penalty: float,
) -> Step | None:
    n, m = len(point.kappa), len(rows.v)
    size = next(size for size in ROWS if size >= m)
    A = np.zeros((size, n + 2))
    A[:m, :n], A[:m, n], A[:m, n + 1] = rows.to_kappa, rows.to_tau, -1.0
    upper = np.ones(size)
    upper[:m] = -value
    H = np.zeros((n + 2, n + 2))
    H[: n + 1, : n + 1], H[n + 1, n + 1] = hessian, FLAT
    cost = np.zeros(n + 2)
    cost[n], cost[n + 1] = -1.0, penalty
    low, high = np.full(n + 2, -radius), np.full(n + 2, radius)
    low[:n] = np.minimum(np.maximum(problem.box[0] - point.kappa, -radius), 0.0)
    high[:n] = np.maximum(np.minimum(problem.box[1] - point.kappa, radius), 0.0)
    violation = point.assessment.violation
    low[n + 1], high[n + 1] = 0.0, 1e4
    for name in ("daqp", "ipqp"):
        solver = _solver(name, n + 2, size)
        found = solver(h=H, g=cost, a=A, lba=-np.inf, uba=upper, lbx=low, ubx=high)
        x = np.array(found["x"]).ravel()
        if solver.stats()["success"] and (A @ x - upper).max() <= KEPT:
            break
    else:
        return None
    predicted = -float(found["cost"]) + penalty * violation
    mu = np.maximum(np.array(found["lam_a"]).ravel()[:m], 0.0)
    return Step(x[: n + 1], predicted, rows, mu, hessian)


@lru_cache(maxsize=64)
def _solver(name: str, n: int, rows: int) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    return ca.conic("programme", name, shapes, {"error_on_fail": False, **OPTIONS[name]})


def _rows(found: Assessment, radius: float) -> Constraints:
    """The constraints that a step of this size may meet, the highest where they are too many."""
    assert found.peaks is not None
    assert found.near is not None
    parts = (found.peaks, found.near)
    joint = Constraints(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("curve", "plant", "v", "value", "to_kappa", "to_tau")
        )
    )
    reach = radius * (np.abs(joint.to_kappa).sum(1) + np.abs(joint.to_tau))
    slack = joint.value + reach
    chosen = np.flatnonzero(slack > 0.0)
    if len(chosen) > ROWS[-1]:
        chosen = chosen[np.argsort(-slack[chosen])[: ROWS[-1]]]
    return joint.only(chosen)
