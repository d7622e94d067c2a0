"""The quadratic programme of a trust-region step, with every bound elastic.

    min  c·p + ½ pᵀ H p + ρ σ    over  low <= p <= high, 0 <= σ,    value + slopes·p <= σ

It always has a solution: σ is by how much the linear model leaves its bounds passed (l∞ penalty;
Fletcher 1987, section 12.4).
"""

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import daqp
import numpy as np

from ccd_casadi.support.arrays import Array

ROWS = 400  # of a programme at most
FLAT = 1e-4  # least curvature, which leaves a linear programme one
KEPT = 1e-7  # by how much a programme's answer may miss its own rows
LARGEST = 1e4  # of σ
UNBOUNDED = 1e30
TOLERANCES = {"primal_tol": 1e-10, "dual_tol": 1e-12, "zero_tol": 1e-13}


class Answer(NamedTuple):
    """p (n,), the multipliers (m,) of the rows, and what the programme gains, ≥ 0 from p = 0."""

    change: Array
    multipliers: Array
    gain: float


def solve_elastic(
    slopes: Array, value: Array, cost: Array, hessian: Array, low: Array, high: Array,
    penalty: float,
) -> Answer | None:  # fmt: skip
    """Solve it for `slopes` (m, n), m <= ROWS; None where neither solver keeps the rows.

    The dual active-set method (DAQP: Arnström, Bemporad and Axehill 2022) is fast, CasADi's
    interior-point method misses nothing.
    """
    m, n = slopes.shape
    A = np.empty((m, n + 1))
    A[:, :n], A[:, n] = slopes, -1.0
    H = np.zeros((n + 1, n + 1))
    H[:n, :n], H[n, n] = hessian, FLAT
    c = np.append(cost, penalty)
    lower = np.concatenate([low, [0.0], np.full(m, -UNBOUNDED)])
    upper = np.concatenate([high, [LARGEST], -value])
    x, gain, flag, info = daqp.solve(H, c, A, upper, lower, **TOLERANCES)
    multipliers = info["lam"][n + 1 :]
    if flag != 1 or not _kept(A, x, value):
        solver = _interior(n + 1, m)
        found = solver(h=H, g=c, a=A, lba=-np.inf, uba=-value, lbx=lower[: n + 1],
                       ubx=upper[: n + 1])  # fmt: skip
        x, multipliers = (np.array(found[key]).ravel() for key in ("x", "lam_a"))
        gain = float(found["cost"])
        if not solver.stats()["success"] or not _kept(A, x, value):
            return None
    return Answer(x[:n], np.maximum(multipliers, 0.0), -gain)


def _kept(A: Array, x: Array, value: Array) -> bool:
    return bool((A @ x + value).max(initial=0.0) <= KEPT)


@lru_cache(maxsize=64)
def _interior(n: int, rows: int) -> ca.Function:
    shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
    quiet = {"print_iter": False, "print_header": False, "print_info": False}
    return ca.conic("programme", "ipqp", shapes, {"error_on_fail": False, **quiet})
