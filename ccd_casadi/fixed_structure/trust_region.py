"""max ω_b over κ by sequential quadratic programming in a trust region.

    max δ - ρ σ - ½ pᵀHp   s.t.  c_j + ∇c_j·p <= σ,  |p| <= Δ,  κ + d in its box,  σ >= 0,

p = (d, δ), with all local peaks and the grid values near their bounds as rows. H is the Hessian of
the Lagrangian with the multipliers of the linear programme (H = 0), made convex. A step counts only
where every closed loop stays stable, and where τ - ρ max(0, max c) rises: the exact penalty
function of the largest violation. (Fletcher & Sainz de la Maza 1989.)
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.curvature import hessians
from ccd_casadi.fixed_structure.elastic_programme import FLAT, ROWS, solve_elastic
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.loop_problem import Assessment, Constraints, LoopProblem
from ccd_casadi.support.arrays import Array

FIRST_RADIUS = 0.2
LARGEST_RADIUS = 1.5
PENALTY = 20.0  # above the sum of multipliers: a per cent of a bound is worth so many of ω_b
ENOUGH = 0.7  # of the predicted gain: with it a model is trusted further
STEADY = 3  # steps at one radius, each of a middling gain, after which a larger one is tried
WIDER = 10.0
PROGRAMMES = 6  # around each other, for one step
SETTLED = 1e-2  # of the radius: a step that moves less from one programme to the next
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
    """Where a local search is, the radius it has, and how many loops it looked at.

    `done`: further steps do not help.
    """

    point: Point
    radius: float
    evaluations: int
    done: bool = False


@dataclass(frozen=True)
class Step:
    """p = (d, δ), the gain of merit that the model predicts, and that it would have with straight
    rows; the Lagrangian's curvature there."""

    change: Array
    predicted: float
    straight: float
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
    point, evaluations, steady, done = start, 0, 0, False
    for _ in range(iterations):
        step = best_step(problem, point, radius, penalty)
        if step is None or step.straight <= least_gain or radius < least_radius:
            done = True
            break
        if step.predicted <= least_gain:  # so curved that the model finds nothing as far as this
            radius *= 0.3
            continue
        trial = _moved(problem, point, step.change)
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
        steady += 1
        if gained > ENOUGH * step.predicted:
            radius, steady = min(max(radius, 1.4 * size), LARGEST_RADIUS), 0
        elif gained < 0.2 * step.predicted:
            radius, steady = (0.5 if gained > 0.0 else 0.3) * min(radius, size), 0
        elif steady == STEADY:
            # What a small step gains less than predicted may be a violation so small that the
            # linear rows overshoot it, whatever the radius: it is the gain that asks for more.
            radius, steady = min(WIDER * radius, LARGEST_RADIUS), 0
    return Ascent(point, radius, evaluations, done)


def _moved(problem: LoopProblem, point: Point, change: Array) -> Point:
    kappa = np.clip(point.kappa + change[:-1], *problem.box)
    tau = point.tau + float(change[-1])
    return Point(kappa, tau, assess(problem, kappa, tau))


def best_step(
    problem: LoopProblem, point: Point, radius: float, penalty: float = PENALTY
) -> Step | None:
    """The best step that the model knows; None where its programme has no answer.

    Of those peaks that hold the step the model is quadratic, of the other rows linear:
    programmes around the step before, each with the curvature of what holds it, until it stays.
    """
    rows, peaks = _rows(point.assessment, radius)
    n, m = len(point.kappa) + 1, len(rows.v)
    slopes = np.column_stack([rows.to_kappa, rows.to_tau])
    curved, known = np.zeros((m, n, n)), np.zeros(m, bool)
    violation = point.assessment.violation
    at, value, convex, p = slopes, rows.value, FLAT * np.eye(n), np.zeros(n)
    best: Step | None = None
    for turn in range(PROGRAMMES):
        found = _programme(problem, point, at, value, convex, p, radius, penalty)
        if found is None:
            break
        if turn == 0:
            level = float((rows.value + slopes @ found[0]).max(initial=0.0))
            straight = float(found[0][-1]) + penalty * (violation - level)
        moved = float(np.abs(found[0] - p).max())
        p, mu = found
        holds = mu > 1e-7 * penalty
        fresh = holds & peaks & ~known
        curved[fresh] = hessians(problem, point.kappa, point.tau, rows.only(fresh))
        known |= fresh
        bend = curved @ p
        at, value = slopes + bend, rows.value - 0.5 * bend @ p
        level = float((value + at @ p).max(initial=0.0))
        gain = float(p[-1]) + penalty * (violation - level)
        hessian = np.einsum("m,mij->ij", np.where(holds, mu, 0.0), curved)
        lam, vectors = np.linalg.eigh(hessian + CONVEXIFYING * at[holds].T @ at[holds])
        convex = (vectors * np.maximum(lam, FLAT)) @ vectors.T
        if best is None or gain > best.predicted:
            best = Step(p, gain, straight, convex)
        if not fresh.any() and moved < SETTLED * radius:
            break
    return best


def _corrected(
    problem: LoopProblem, point: Point, step: Step, trial: Point, radius: float, penalty: float
) -> Array | None:
    """The second-order correction: the same model with the constraints as they are at the trial."""
    rows, _ = _rows(trial.assessment, radius)
    slopes = np.column_stack([rows.to_kappa, rows.to_tau])
    value = rows.value - slopes @ step.change
    found = _programme(problem, point, slopes, value, step.hessian, step.change, radius, penalty)
    return None if found is None else found[0]


def _programme(
    problem: LoopProblem,
    point: Point,
    slopes: Array,
    value: Array,
    hessian: Array,
    centre: Array,
    radius: float,
    penalty: float,
) -> tuple[Array, Array] | None:
    """p and the multipliers of the rows value + slopes·p <= σ; H acts on p less the centre."""
    n = slopes.shape[1]
    cost = -hessian @ centre
    cost[n - 1] -= 1.0
    low, high = np.full(n, -radius), np.full(n, radius)
    low[: n - 1] = np.minimum(np.maximum(problem.box[0] - point.kappa, -radius), 0.0)
    high[: n - 1] = np.maximum(np.minimum(problem.box[1] - point.kappa, radius), 0.0)
    # Where nothing bounds ω_b it stops at the end of the grid instead of running away.
    room = float(np.log(problem.plants.frequency(problem.base[-1]))) - point.tau
    high[n - 1] = max(min(radius, room), -radius)
    found = solve_elastic(slopes, value, cost, hessian, low, high, penalty)
    return None if found is None else found[:2]


def _rows(found: Assessment, radius: float) -> tuple[Constraints, np.ndarray]:
    """The constraints that a step of this size may meet, the highest where they are too many;
    and which of them are peaks."""
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
    if len(chosen) > ROWS:
        chosen = chosen[np.argsort(-slack[chosen])[: ROWS]]
    return joint.only(chosen), chosen < len(found.peaks.v)
