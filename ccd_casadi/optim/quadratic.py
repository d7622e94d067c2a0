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
UNBOUNDED = 1e30  # what DAQP takes for infinite
QUIET = ("error_on_fail", "print_iter", "print_header", "print_info")
TOLERANCES = {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}


class Answer(NamedTuple):
    """x (n,), the multipliers (m,) of the rows, and the least value."""

    x: Array
    multipliers: Array
    value: float


def solve_quadratic(
    H: Array, c: Array, A: Array, upper: Array, low: Array, high: Array, *, singular: bool = False
) -> Answer | None:
    """min c·x + ½ xᵀ H x over low <= x <= high, A x <= upper; bounds may be infinite.

    None where neither solver keeps the rows of A (m, n), which tells nothing of x. `singular`: H
    may be nearly so.
    """
    rows, n = A.shape

    def kept(x: Array) -> bool:
        missed = max((low - x).max(), (x - high).max())
        return bool((A @ x - upper).max(initial=-np.inf) <= KEPT and missed <= INSIDE)

    above = np.minimum(np.concatenate([high, upper]), UNBOUNDED)
    below = np.concatenate([np.maximum(low, -UNBOUNDED), np.full(rows, -UNBOUNDED)])
    matrix = np.ascontiguousarray(A, float)
    x, value, flag, info = daqp.solve(np.array(H, float), c, matrix, above, below, **TOLERANCES)
    if flag == 1 and kept(x):
        return Answer(x, np.maximum(info["lam"][n:], 0.0), float(value))
    solver = _interior(n, rows, singular)
    found = solver(h=H, g=c, a=A, lba=-np.inf, uba=upper, lbx=low, ubx=high)
    x = np.array(found["x"]).ravel()
    if not solver.stats()["success"] or not kept(x):
        return None
    return Answer(x, np.maximum(np.array(found["lam_a"]).ravel(), 0.0), float(found["cost"]))


@lru_cache(maxsize=256)
def _interior(n: int, rows: int, singular: bool) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    options: dict[str, bool | str] = dict.fromkeys(QUIET, False)
    if singular:  # an LDL factorisation would warn on the terminal
        options["linear_solver"] = "qr"
    return ca.conic("programme", "ipqp", shapes, options)
