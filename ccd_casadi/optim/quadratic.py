"""A convex quadratic programme by two solvers, and never an answer that misses its rows."""

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array

KEPT = 1e-7  # by how much an answer may miss its rows
INSIDE = 1e-6  # and its bounds, to which it can be moved
# The dual active-set method is fast, and where H is nearly singular calls a success what misses
# them by far; the interior-point method misses nothing.
OPTIONS: dict[str, dict[str, Any]] = {
    "daqp": {"daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}},
    "ipqp": {"print_iter": False, "print_header": False, "print_info": False},
}
# Where H may be nearly singular: an LDL factorisation then warns on the terminal.
SINGULAR = {"linear_solver": "qr"}


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
    for name in OPTIONS:
        solver = _solver(name, n, rows, singular and name == "ipqp")
        found = solver(h=H, g=c, a=A, lba=-np.inf, uba=upper, lbx=low, ubx=high)
        x = np.array(found["x"]).ravel()
        missed = max((low - x).max(), (x - high).max())
        kept = (A @ x - upper).max() <= KEPT and missed <= INSIDE
        if solver.stats()["success"] and kept:
            mu = np.maximum(np.array(found["lam_a"]).ravel(), 0.0)
            return Answer(x, mu, float(found["cost"]))
    return None


@lru_cache(maxsize=256)
def _solver(name: str, n: int, rows: int, singular: bool) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    options = {"error_on_fail": False, **OPTIONS[name], **(SINGULAR if singular else {})}
    return ca.conic("programme", name, shapes, options)
