"""Quadratic programmes by their active sets, and quasi-Newton updates of their Hessians."""

from dataclasses import dataclass
from typing import NamedTuple

import daqp
import numpy as np
from scipy import sparse

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class QuadraticOptions:
    """Numbers of quadratic programmes, in the units in which they are solved."""

    row_error: float = 1e-7  # largest violation of A x <= upper in a solution
    bound_error: float = 1e-6  # of its bounds: larger, as the caller clips x to them
    primal: float = 1e-10  # DAQP's tolerances
    dual: float = 1e-12
    zero: float = 1e-13
    interior: float = 1e-10  # Clarabel's, of rows of size one
    unbounded: float = 1e30  # from here on DAQP takes a bound for infinite
    regularisation: float = 1e-8  # added to the diagonal of H: the solution is then unique
    slack_curvature: float = 1e-3  # of σ over ρ; with less DAQP starts far out and cycles
    first_rows: int = 200  # of a large programme, solved for at first
    added_rows: int = 50  # most violated rows added per round


class QuadraticSolution(NamedTuple):
    """x (n,) and the multipliers (m,) >= 0 of the rows of A."""

    x: Array
    multipliers: Array


def solve_quadratic(
    H: Array, c: Array, A: Array, upper: Array, low: Array, high: Array,
    options: QuadraticOptions = QuadraticOptions(),
) -> QuadraticSolution | None:  # fmt: skip
    """min c·x + ½ xᵀ H x over low <= x <= high, A x <= upper, by DAQP, or else by Clarabel.

    H (n, n) is positive semidefinite and may be nearly singular, bounds may be infinite. None where
    neither solver returns a feasible x, which does not prove that there is none.
    """
    (m, n), unbounded = A.shape, options.unbounded

    def feasible(x: Array) -> bool:
        bound_violation = np.maximum(low - x, x - high).max()
        row_violation = (A @ x - upper).max(initial=-np.inf)
        return bool(row_violation <= options.row_error and bound_violation <= options.bound_error)

    # DAQP's form: blower <= (x, A x) <= bupper
    bupper, blower = np.empty(n + m), np.full(n + m, -unbounded)
    bupper[:n], bupper[n:] = high, upper
    np.minimum(bupper, unbounded, out=bupper)
    np.maximum(low, -unbounded, out=blower[:n])
    x, _, flag, info = daqp.solve(
        np.array(H, float), c, np.ascontiguousarray(A, float), bupper, blower,
        primal_tol=options.primal, dual_tol=options.dual, zero_tol=options.zero,
    )  # fmt: skip
    if flag == 1 and feasible(x):
        return QuadraticSolution(x, np.maximum(info["lam"][n:], 0.0))
    other = _interior(H, c, A, upper, low, high, options)
    return other if other is not None and feasible(other.x) else None


def _interior(
    H: Array, c: Array, A: Array, upper: Array, low: Array, high: Array, options: QuadraticOptions
) -> QuadraticSolution | None:  # fmt: skip
    """The same by an interior point, for programmes whose rows differ by orders of magnitude: DAQP
    finds no feasible x there."""
    import clarabel  # slow to import, and seldom needed

    m, n = A.shape
    size = np.maximum(np.abs(A).max(axis=1, initial=0.0), np.finfo(float).tiny)
    over, under = np.isfinite(high), np.isfinite(low)
    rows = np.vstack([A / size[:, None], np.eye(n)[over], -np.eye(n)[under]])
    right = np.concatenate([upper / size, high[over], -low[under]])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = options.interior
    cones = [clarabel.NonnegativeConeT(len(right))]
    curvature = sparse.csc_matrix(np.triu(H))
    answer = clarabel.DefaultSolver(
        curvature, c, sparse.csc_matrix(rows), right, cones, settings
    ).solve()
    if answer.status != clarabel.SolverStatus.Solved:
        return None
    return QuadraticSolution(np.array(answer.x), np.maximum(answer.z[:m], 0.0) / size)


def solve_elastic(
    H: Array, c: Array, jacobian: Array, g: Array, elastic: Array, low: Array, high: Array,
    penalty: float, radius: float, unit: float, *, free: bool = False,
    options: QuadraticOptions = QuadraticOptions(),
) -> tuple[Array, Array] | None:  # fmt: skip
    """The step p of a trust region with an l∞ penalty ρ (Fletcher 1987, section 12.4):

        min c·p + ½ pᵀ H p + ρ σ    over  low <= p <= high, 0 <= σ,    g + ∇g·p <= elastic σ

    σ is the violation that is left, so where every row is elastic there is a solution.

    It is scaled to p/radius, σ/radius and to costs in `unit`: the solvers' absolute tolerances mean
    the same at every radius. Many rows are treated as cutting planes: the first are solved for, and
    the most violated ones are added until none is violated.

    Parameters
    ----------
    H, c, jacobian, g : array (n, n), (n,), (m, n), (m,)
    elastic : array (m,)
        0 of a row that must hold.
    low, high : array (n,)
    penalty, radius : float
        ρ, and the half width of the trust region.
    unit : float
        Size of c or ρ.
    free : bool
        σ may be negative (the largest row is minimised).

    Returns
    -------
    p (n,) and the multipliers (m,) of the rows; None as in `solve_quadratic`
    """
    m, n = jacobian.shape  # the variables are (p, σ)/radius
    A, hessian, cost = np.empty((m, n + 1)), np.zeros((n + 1, n + 1)), np.empty(n + 1)
    A[:, :n], A[:, n] = jacobian, -elastic
    hessian[:n, :n], cost[:n], cost[n] = radius / unit * H, c / unit, penalty / unit
    hessian.ravel()[:: n + 2] += options.regularisation  # the diagonal
    lower, higher = np.full(n + 1, -np.inf), np.full(n + 1, np.inf)
    lower[:n], higher[:n] = low / radius, high / radius
    if not free:
        hessian[n, n], lower[n] = options.slack_curvature * penalty / unit, 0.0
    upper, rows = -g / radius, np.arange(min(m, options.first_rows))
    part: slice | np.ndarray = slice(len(rows))  # of the first rows no copy is made
    while True:
        solution = solve_quadratic(hessian, cost, A[part], upper[part], lower, higher, options)
        if solution is None:
            return None
        if len(rows) == m:
            break
        violation = A @ solution.x - upper
        violation[part] = -np.inf
        if violation.max() <= options.row_error:
            break
        worst = np.argsort(-violation)[: options.added_rows]
        rows = part = np.concatenate([rows, worst[violation[worst] > options.row_error]])
    multipliers = np.zeros(m)
    multipliers[rows] = unit * solution.multipliers
    return radius * np.clip(solution.x[:n], lower[:n], higher[:n]), multipliers


def damped_bfgs(H: Array, s: Array, y: Array) -> Array:
    """Update a Hessian by BFGS with Powell's damping, which keeps it positive definite:

        H - H s sᵀ H/(sᵀ H s) + ȳ ȳᵀ/(sᵀ ȳ),   ȳ = t y + (1 - t) H s,   sᵀ ȳ >= 0.2 sᵀ H s.

    Parameters
    ----------
    H, s, y : array (n, n), (n,), (n,)
        The step s changes the gradient by y.

    Returns
    -------
    array (n, n)

    References
    ----------
    J. Nocedal and S. J. Wright, Numerical Optimization, procedure 18.2.
    """
    Hs = H @ s
    curvature = float(s @ Hs)
    if curvature <= 1e-16 * float(np.trace(H)):
        return H
    if s @ y < 0.2 * curvature:
        t = 0.8 * curvature / (curvature - float(s @ y))
        y = t * y + (1.0 - t) * Hs
    return np.asarray(H - np.outer(Hs, Hs) / curvature + np.outer(y, y) / float(s @ y))


def symmetric_rank_one(H: Array, s: Array, y: Array, *, least: float = 1e-8) -> Array:
    """Update a Hessian by SR1, H + r rᵀ/(rᵀ s) with r = y - H s. It may be indefinite.

    Parameters
    ----------
    H, s, y : array (n, n), (n,), (n,)
        The step s changes the gradient by y.
    least : float
        The update is skipped where |rᵀ s| <= least ‖r‖ ‖s‖: the denominator is rounding.

    Returns
    -------
    array (n, n)

    References
    ----------
    J. Nocedal and S. J. Wright, Numerical Optimization, section 6.2.
    """
    r = y - H @ s
    denominator = float(r @ s)
    if abs(denominator) <= least * float(np.linalg.norm(r) * np.linalg.norm(s)):
        return H
    return np.asarray(H + np.outer(r, r) / denominator)


def convex(H: Array, least: float) -> Array:
    """The symmetric H = V Λ Vᵀ (n, n) with V max(Λ, least) Vᵀ in its place."""
    eigenvalues, V = np.linalg.eigh(H)
    return np.asarray((V * np.maximum(eigenvalues, least)) @ V.T)
