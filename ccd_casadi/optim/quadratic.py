"""A convex quadratic programme by two solvers, and never an answer that misses its rows.

The dual active-set method (DAQP: Arnström, Bemporad and Axehill 2022) is fast, and where H is
nearly singular calls a success what misses its rows by far; the interior-point method misses none.
"""

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import daqp
import numpy as np

from ccd_casadi.support.arrays import Array

KEPT = 1e-7  # by how much an answer may miss its rows
INSIDE = 1e-6  # and its bounds, to which it can be moved
CURVED = 1e-8  # of a step in its own units: its answer is then one point
SLACK = 1e-3  # of the penalty: σ's curvature; with less DAQP begins so far out that it cycles
UNBOUNDED = 1e30  # what DAQP takes for infinite
QUIET = ("error_on_fail", "print_iter", "print_header", "print_info")
TOLERANCES = {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}
AT_FIRST, ADDED = 200, 50  # rows of a programme, and those that its answer exceeds, at a time
LOST = 1e-8  # share of its factors below which a scalar product is rounding


class Answer(NamedTuple):
    """x (n,) and the multipliers (m,) of the rows."""

    x: Array
    multipliers: Array


def solve_quadratic(
    H: Array, c: Array, A: Array, upper: Array, low: Array, high: Array
) -> Answer | None:
    """min c·x + ½ xᵀ H x over low <= x <= high, A x <= upper; bounds may be infinite.

    None where neither solver keeps the rows of A (m, n), which tells nothing of x. H may be
    nearly singular.
    """
    rows, n = A.shape

    def kept(x: Array) -> bool:
        missed = np.maximum(low - x, x - high).max()
        return bool((A @ x - upper).max(initial=-np.inf) <= KEPT and missed <= INSIDE)

    above, below = np.empty(n + rows), np.full(n + rows, -UNBOUNDED)
    above[:n], above[n:] = high, upper
    np.minimum(above, UNBOUNDED, out=above)
    np.maximum(low, -UNBOUNDED, out=below[:n])
    matrix = np.ascontiguousarray(A, float)
    x, _, flag, info = daqp.solve(np.array(H, float), c, matrix, above, below, **TOLERANCES)
    if flag == 1 and kept(x):
        return Answer(x, np.maximum(info["lam"][n:], 0.0))
    solver = _interior(n, rows)
    found = solver(h=H, g=c, a=A, lba=-np.inf, uba=upper, lbx=low, ubx=high)
    x = np.array(found["x"]).ravel()
    if not solver.stats()["success"] or not kept(x):
        return None
    return Answer(x, np.maximum(np.array(found["lam_a"]).ravel(), 0.0))


def solve_elastic(
    H: Array, c: Array, slopes: Array, value: Array, elastic: Array, low: Array, high: Array,
    penalty: float, radius: float, unit: float, *, free: bool = False,
) -> tuple[Array, Array] | None:  # fmt: skip
    """p (n,) and the multipliers (m,) of the rows of a trust-region step:

        min c·p + ½ pᵀ H p + ρ σ    over  low <= p <= high, 0 <= σ,    value + slopes·p <= elastic σ

    σ is by how much the rows are left exceeded (l∞ penalty; Fletcher 1987, section 12.4), so that
    there is a solution where all are elastic; with `free` it may be negative. Solved in steps of
    one radius and with `unit`, the size of c or ρ, as one: the solvers' tolerances mean the same at
    every radius. Of thousands of rows the first are solved for, and then those too that the answer
    leaves exceeded, until there is none. None as in `solve_quadratic`.
    """
    m, n = slopes.shape
    A, hessian, cost = np.empty((m, n + 1)), np.zeros((n + 1, n + 1)), np.empty(n + 1)
    A[:, :n], A[:, n] = slopes, -elastic
    hessian[:n, :n], cost[:n], cost[n] = radius / unit * H, c / unit, penalty / unit
    hessian.ravel()[:: n + 2] += CURVED
    ends = np.full((2, n + 1), np.inf)
    ends[0, :n], ends[1, :n], ends[0, n] = low / radius, high / radius, -np.inf
    if not free:
        hessian[n, n], ends[0, n] = SLACK * penalty / unit, 0.0
    upper, held = -value / radius, np.arange(min(m, AT_FIRST))
    part: slice | np.ndarray = slice(len(held))  # the first ones are no copy
    while True:
        found = solve_quadratic(hessian, cost, A[part], upper[part], *ends)
        if found is None:
            return None
        if len(held) == m:
            break
        missed = A @ found.x - upper
        missed[part] = -np.inf
        if missed.max() <= KEPT:
            break
        worst = np.argsort(-missed)[:ADDED]
        held = part = np.concatenate([held, worst[missed[worst] > KEPT]])
    multipliers = np.zeros(m)
    multipliers[held] = unit * found.multipliers
    return radius * np.clip(found.x[:n], *ends[:, :n]), multipliers


@lru_cache(maxsize=256)
def _interior(n: int, rows: int) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    options: dict[str, bool | str] = dict.fromkeys(QUIET, False)
    options["linear_solver"] = "qr"  # an LDL factorisation would warn on the terminal
    return ca.conic("programme", "ipqp", shapes, options)


def damped_bfgs(H: Array, s: Array, y: Array) -> Array:
    """H (n, n) with the curvature that a change y of the gradient along the step s shows.

    Powell's damping keeps it positive definite.
    """
    Hs = H @ s
    curvature = float(s @ Hs)
    if curvature <= 1e-16 * float(np.trace(H)):
        return H
    if s @ y < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - float(s @ y))
        y = share * y + (1.0 - share) * Hs
    return np.asarray(H - np.outer(Hs, Hs) / curvature + np.outer(y, y) / float(s @ y))


def symmetric_rank_one(H: Array, s: Array, y: Array) -> Array:
    """H (n, n) with H s = y, which may curve either way; as it is where the denominator is lost."""
    rest = y - H @ s
    size = float(rest @ s)
    if abs(size) <= LOST * float(np.linalg.norm(rest) * np.linalg.norm(s)):
        return H
    return np.asarray(H + np.outer(rest, rest) / size)


def convex(H: Array, least: float) -> Array:
    """H (n, n) with its eigenvalues raised to at least `least`."""
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)
