"""The quadratic programme of a trust-region step, with every bound elastic.

    min  c·p + ½ pᵀ H p + ρ σ    over  low <= p <= high, 0 <= σ,    value + slopes·p <= σ

It always has a solution: σ is by how much the linear model leaves its bounds exceeded (l∞ penalty;
Fletcher 1987, section 12.4).
"""

from typing import NamedTuple

import numpy as np

from ccd_casadi.optim.quadratic import solve_quadratic
from ccd_casadi.support.arrays import Array

ROWS = 400  # of a programme at most
FLAT = 1e-4  # least curvature, which leaves a linear programme one
LARGEST = 1e4  # of σ


class Answer(NamedTuple):
    """p (n,), the multipliers (m,) of the rows, and what the programme gains, ≥ 0 from p = 0."""

    change: Array
    multipliers: Array
    gain: float


def solve_elastic(
    slopes: Array, value: Array, cost: Array, hessian: Array, low: Array, high: Array,
    penalty: float,
) -> Answer | None:  # fmt: skip
    """Solve it for `slopes` (m, n), m <= ROWS; None where neither solver keeps the rows."""
    m, n = slopes.shape
    A = np.empty((m, n + 1))
    A[:, :n], A[:, n] = slopes, -1.0
    H = np.zeros((n + 1, n + 1))
    H[:n, :n], H[n, n] = hessian, FLAT
    bounds = np.append(low, 0.0), np.append(high, LARGEST)
    found = solve_quadratic(H, np.append(cost, penalty), A, -value, *bounds)
    return None if found is None else Answer(found.x[:n], found.multipliers, -found.value)
