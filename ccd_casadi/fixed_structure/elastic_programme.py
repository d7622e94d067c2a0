"""The quadratic programme of a trust-region step, with every bound elastic.

    min  c·p + ½ pᵀ H p + ρ σ    over  low <= p <= high, 0 <= σ,    value + slopes·p <= σ

It always has a solution: σ is by how much the linear model leaves its bounds passed (l∞ penalty;
Fletcher 1987, section 12.4).
"""

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array

ROWS = (64, 128, 256, 400)  # sizes of programmes, so that few solvers are made
FLAT = 1e-4  # least curvature, which leaves a linear programme one
KEPT = 1e-7  # by how much a programme's answer may miss its own rows
LARGEST = 1e4  # of σ
# The dual active-set method is fast, the interior-point method misses nothing.
OPTIONS: dict[str, dict[str, Any]] = {
    "daqp": {"daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}},
    "ipqp": {"print_iter": False, "print_header": False, "print_info": False},
}


class Answer(NamedTuple):
    """p (n,), the multipliers (m,) of the rows, and what the programme gains, ≥ 0 from p = 0."""

    change: Array
    multipliers: Array
    gain: float


def solve_elastic(
    slopes: Array, value: Array, cost: Array, hessian: Array, low: Array, high: Array,
    penalty: float,
) -> Answer | None:  # fmt: skip
    """Solve it for `slopes` (m, n), m <= ROWS[-1]; None where neither solver keeps the rows."""
    m, n = slopes.shape
    size = next(size for size in ROWS if size >= m)
    A = np.zeros((size, n + 1))
    A[:m, :n], A[:m, n] = slopes, -1.0
    upper = np.ones(size)
    upper[:m] = -value
    H = np.zeros((n + 1, n + 1))
    H[:n, :n], H[n, n] = hessian, FLAT
    for name in ("daqp", "ipqp"):
        solver = _solver(name, n + 1, size)
        found = solver(h=H, g=np.append(cost, penalty), a=A, lba=-np.inf, uba=upper,
                       lbx=np.append(low, 0.0), ubx=np.append(high, LARGEST))  # fmt: skip
        x = np.array(found["x"]).ravel()
        if solver.stats()["success"] and (A @ x - upper).max() <= KEPT:
            mu = np.maximum(np.array(found["lam_a"]).ravel()[:m], 0.0)
            return Answer(x[:n], mu, -float(found["cost"]))
    return None


@lru_cache(maxsize=64)
def _solver(name: str, n: int, rows: int) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    return ca.conic("programme", name, shapes, {"error_on_fail": False, **OPTIONS[name]})
