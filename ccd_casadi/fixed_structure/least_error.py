"""The least RMS error of a fixed structure on a set of plants, within the bounds of the bandwidth.

    min ln e(κ)   s.t.  every bound of `figures` at a bandwidth of at least ω_min,
    e² = mean over the plants of the error's variance under an `ErrorBudget`

By quadratic programmes in a trust region, from a controller that meets the bounds: the gradient
of ln e is exact (adjoint Lyapunov equations), its curvature a damped BFGS one, that of the bounds
exact. The merit is ln e + ρ max(0, max c); a step counts only where every loop stays stable.
A little is paid for bandwidth, so that ω_b is what the bounds leave free at this κ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from ccd_casadi.budget import ErrorBudget
from ccd_casadi.budget.derivatives import Change, rms_error_slope, variance_slopes
from ccd_casadi.budget.frequency import Loop
from ccd_casadi.budget.holding import Hold
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.curvature import lagrangian_hessian
from ccd_casadi.fixed_structure.design import (
    Progress,
    SectionsDesign,
    SectionsOutcome,
    in_problem_units,
    problem_for,
)
from ccd_casadi.fixed_structure.figures import Assessment, Constraints, Curve, Problem, assess
from ccd_casadi.fixed_structure.loop import Sampling
from ccd_casadi.fixed_structure.structure import Structure, state_space, state_spaces
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

STEP = 1e-30  # of κ along the imaginary axis
REWARD = 1e-3  # of ln ω_b in ln e
PENALTIES = (20.0, 200.0, 2000.0)  # the next one where a bound is left passed
FIRST_RADIUS, LARGEST_RADIUS, LEAST_RADIUS = 0.2, 1.0, 1e-7
LEAST_GAIN = 1e-9
FLAT = 1e-4  # least curvature
CONVEXIFYING = 10.0
MOST = 200  # steps
ROWS = 300
ACTIVE = 1e-5
KEPT = 1.0 + 2e-6  # figure over bound that the search leaves


@dataclass(frozen=True)
class RmsError:
    """e of a controller on SISO plants in SI, and its derivatives to κ."""

    plants: tuple[StateSpace, ...]
    structure: Structure
    budget: ErrorBudget
    hold: Hold | None

    def at(self, kappa: Array) -> tuple[float, Array]:
        """ln e (m) at κ in SI, and its gradient; infinite where a loop is unstable."""
        kappa = np.asarray(kappa, float)
        K = state_space(self.structure, kappa)
        stepped = state_spaces(self.structure, kappa + 1j * STEP * np.eye(len(kappa)))
        changes = [
            Change(None, StateSpace(*(part[i].imag / STEP for part in stepped)))
            for i in range(len(kappa))
        ]
        total = None
        for plant in self.plants:
            found = variance_slopes(Loop(plant, K, self.hold), self.budget, changes)
            if found is None:
                return np.inf, np.full(len(kappa), np.nan)
            total = found if total is None else replace(
                total, value=total.value + found.value, gradient=total.gradient + found.gradient
            )  # fmt: skip
        assert total is not None
        value, slope = rms_error_slope(total)
        return value - 0.5 * float(np.log(len(self.plants))), slope


@dataclass(frozen=True)
class LeastError:
    """A design with its RMS error in m over the set, and that of the controller it began with.

    `design.multipliers`: change of ln e per ln of a bound; `design.kkt_residual` is over ‖∇ ln e‖.
    """

    design: SectionsDesign
    error: float
    first_error: float
    steps: int


@dataclass(frozen=True)
class _Point:
    kappa: Array
    tau: float
    assessment: Assessment
    value: float
    slope: Array

    def merit(self, penalty: float) -> float:
        """To be made small."""
        return self.value - REWARD * self.tau + penalty * self.assessment.violation


def least_error(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    budget: ErrorBudget,
    *,
    sampling: Sampling | None = None,
    least_bandwidth: float = 0.0,
    progress: Progress | None = None,
) -> LeastError:
    """From a certified design (and its other local optima) to the least RMS error in m.

    `least_bandwidth` in rad/s. What the judge does not confirm is not handed out: the design that
    it began with is, then. A local optimum, as any search from given starts finds.
    """
    problem = problem_for(plants, design.structure, bounds, sampling, design.frequencies)
    hold = None if sampling is None else Hold(sampling.period, sampling.delay)
    goal = RmsError(
        tuple(p.plant_si() for p in plants), design.structure, replace(budget, window=None), hold
    )
    w0 = problem.plants.omega_0
    floor = float(np.log(max(least_bandwidth, 1e-3 * design.bandwidth) / w0))
    tell = progress or (lambda words: None)
    own = (design.bandwidth, tuple(map(float, design.kappa)))
    others = [(o.bandwidth, o.kappa) for o in design.local_optima[1:] if o.kappa]
    first = float(np.exp(goal.at(design.kappa)[0]))
    best = LeastError(design, first, first, 0)
    steps = 0
    for bandwidth, kappa in [own, *others]:
        if bandwidth < least_bandwidth:
            continue
        start = _point(problem, goal, in_problem_units(problem, np.array(kappa)),
                       float(np.log(bandwidth / w0)))  # fmt: skip
        if not np.isfinite(start.value):
            continue
        end = start
        for penalty in PENALTIES:
            end, count = _descend(problem, goal, end, floor, penalty)
            steps += count
            if end.assessment.violation <= problem.margin:
                break
        made = _judged(problem, plants, sampling, end, design, floor)
        error = float(np.exp(end.value))
        tell(f"{1e9 * error:.4g} nm RMS at {made.bandwidth / HZ:.2f} Hz, {count} steps: "
             f"{made.words}")  # fmt: skip
        if made.certified and error < best.error:
            best = replace(best, design=made, error=error)
    return replace(best, steps=steps)


def _point(problem: Problem, goal: RmsError, kappa: Array, tau: float) -> _Point:
    kappa = np.clip(kappa, *problem.box)
    found = assess(problem, kappa, tau)
    value, slope = np.inf, np.zeros(len(kappa))
    if found.stable:
        P = problem.plants
        value, slope = goal.at(problem.structure.in_units(kappa, P.omega_0, P.force))
    return _Point(kappa, tau, found, value, slope)


def _descend(
    problem: Problem, goal: RmsError, start: _Point, floor: float, penalty: float
) -> tuple[_Point, int]:
    """Steps until they help no longer."""
    point, radius, steps = start, FIRST_RADIUS, 0
    n = len(start.kappa)
    curvature = np.eye(n)
    for turn in range(1, MOST + 1):
        steps = turn
        rows = _rows(point.assessment, radius)
        hessian = FLAT * np.eye(n + 1)
        hessian[:n, :n] += curvature
        found = _programme(problem, point, rows, rows.value, hessian, radius, floor, penalty)
        if found is None:
            break
        mu = np.where(found[2] > 1e-7 * penalty, found[2], 0.0)
        hessian += lagrangian_hessian(problem, point.kappa, point.tau, rows, mu)
        active = np.column_stack([rows.to_kappa, rows.to_tau])[mu > 0.0]
        values, vectors = np.linalg.eigh(hessian + CONVEXIFYING * active.T @ active)
        convex = (vectors * np.maximum(values, FLAT)) @ vectors.T
        found = _programme(problem, point, rows, rows.value, convex, radius, floor, penalty)
        if found is None or found[1] <= LEAST_GAIN:
            break
        change, predicted, _ = found
        trial = _point(problem, goal, point.kappa + change[:n], point.tau + float(change[n]))
        gained = point.merit(penalty) - trial.merit(penalty)
        if gained < 0.7 * predicted and trial.assessment.stable:
            again = _rows(trial.assessment, radius)
            back = again.to_kappa @ change[:n] + again.to_tau * change[n]
            other = _programme(
                problem, point, again, again.value - back, convex, radius, floor, penalty
            )
            if other is not None:
                corrected = _point(problem, goal, point.kappa + other[0][:n],
                                   point.tau + float(other[0][n]))  # fmt: skip
                if point.merit(penalty) - corrected.merit(penalty) > gained:
                    trial, gained = corrected, point.merit(penalty) - corrected.merit(penalty)
        if trial.assessment.stable:
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
    """BFGS, damped so that it stays positive (Powell 1978)."""
    Bs = B @ s
    sBs = float(s @ Bs)
    if not sBs > 1e-20:
        return B
    sy = float(s @ y)
    share = 1.0 if sy >= 0.2 * sBs else 0.8 * sBs / (sBs - sy)
    r = share * y + (1.0 - share) * Bs
    return np.asarray(B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / float(s @ r))


def _rows(found: Assessment, radius: float) -> Constraints:
    """The peaks, and the grid values that a step of this size may lift over their bounds."""
    assert found.peaks is not None
    assert found.near is not None
    parts = (found.peaks, found.near)
    joint = Constraints(*(
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("curve", "plant", "v", "value", "to_kappa", "to_tau")
    ))  # fmt: skip
    slack = joint.value + radius * (np.abs(joint.to_kappa).sum(1) + np.abs(joint.to_tau))
    chosen = np.flatnonzero(slack > 0.0)
    return joint.only(chosen[np.argsort(-slack[chosen], kind="stable")[:ROWS]])


def _programme(
    problem: Problem,
    point: _Point,
    rows: Constraints,
    value: Array,
    hessian: Array,
    radius: float,
    floor: float,
    penalty: float,
) -> tuple[Array, float, Array] | None:
    """(d, δ), what it gains in merit by the model, and the rows' multipliers."""
    n, m = len(point.kappa), len(rows.v)
    A = np.column_stack([rows.to_kappa, rows.to_tau, -np.ones(m)])
    H = np.zeros((n + 2, n + 2))
    H[: n + 1, : n + 1], H[n + 1, n + 1] = hessian, FLAT
    cost = np.concatenate([point.slope, [-REWARD, penalty]])
    low, high = np.full(n + 2, -radius), np.full(n + 2, radius)
    low[:n] = np.minimum(np.maximum(problem.box[0] - point.kappa, -radius), 0.0)
    high[:n] = np.maximum(np.minimum(problem.box[1] - point.kappa, radius), 0.0)
    low[n] = min(max(floor - point.tau, -radius), 0.0)
    low[n + 1], high[n + 1] = 0.0, 1e4
    shapes = {"h": ca.Sparsity.dense(n + 2, n + 2), "a": ca.Sparsity.dense(m, n + 2)}
    for name, options in (("daqp", {}), ("ipqp", {"print_iter": False, "print_header": False,
                                                  "print_info": False})):  # fmt: skip
        solver = ca.conic("programme", name, shapes, {"error_on_fail": False, **options})
        found = solver(h=H, g=cost, a=A, lba=-np.inf, uba=-value, lbx=low, ubx=high)
        x = np.array(found["x"]).ravel()
        if solver.stats()["success"] and (A @ x + value).max(initial=-1.0) <= 1e-7:
            gain = -float(found["cost"]) + penalty * point.assessment.violation
            return x[: n + 1], gain, np.maximum(np.array(found["lam_a"]).ravel(), 0.0)
    return None


def _judged(
    problem: Problem,
    plants: Sequence[ScaledPlant],
    sampling: Sampling | None,
    end: _Point,
    design: SectionsDesign,
    floor: float,
) -> SectionsDesign:
    """The end as a design: certified by the judge, with residual and multipliers."""
    structure, P = design.structure, problem.plants
    kappa = structure.in_units(end.kappa, P.omega_0, P.force)
    controller = state_space(structure, kappa)
    judged = certify(plants, controller, problem.bounds, sampling, integrator=structure.integrator)
    peaks = end.assessment.peaks
    assert peaks is not None
    active = peaks.only(np.abs(peaks.value) <= ACTIVE)
    n = len(end.kappa)
    columns, names = [np.column_stack([active.to_kappa, active.to_tau])], []
    for i, name in enumerate(structure.names):
        for row, sign, word in ((0, -1.0, "lower"), (1, 1.0, "upper")):
            if abs(end.kappa[i] - problem.box[row, i]) <= ACTIVE:
                columns.append(sign * np.eye(n + 1)[i : i + 1])
                names.append((name, word))
    if abs(end.tau - floor) <= ACTIVE:
        columns.append(-np.eye(n + 1)[n:])
    matrix = np.concatenate(columns).T
    goal = np.append(-end.slope, REWARD)
    mu = nnls(matrix, goal, maxiter=100 * matrix.shape[1])[0] if matrix.shape[1] else np.zeros(0)
    residual = float(np.abs(matrix @ mu - goal).max() / np.abs(goal).max())
    multipliers: dict[str, float] = {}
    for code, value in zip(active.curve, mu, strict=False):
        if value > 0.0:
            word = Curve(int(code)).name
            multipliers[word] = multipliers.get(word, 0.0) + float(value)
    count = len(active.v)
    ends = tuple((*item, float(v)) for item, v in zip(names, mu[count:], strict=False))
    least = float(np.exp(floor)) * P.omega_0
    good = judged.passed and judged.bandwidth >= least / KEPT
    return replace(
        design,
        outcome=SectionsOutcome.CERTIFIED if good else SectionsOutcome.NOT_CERTIFIED,
        words=judged.words,
        kappa=kappa,
        controller=controller,
        bandwidth=judged.bandwidth,
        certificate=judged,
        multipliers=multipliers,
        at_box=ends,
        kkt_residual=residual,
        short={},
    )
