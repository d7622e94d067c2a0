"""The Hessians of the constraints c_j to (κ, τ), exact but for one difference in frequency.

At a fixed frequency they are those of `kernels.loop_curvature`, and a peak moves as κ does:
-c_xκ c_xκᵀ/c_xx is added, x = ln v.
"""

from functools import singledispatch

import numpy as np

from ccd_casadi.fixed_structure.figures import evaluate_rows
from ccd_casadi.fixed_structure.loop_problem import Constraints, Curve, LoopProblem
from ccd_casadi.kernels.loop_curvature import second
from ccd_casadi.support.arrays import Array

STEP = 1e-5  # of ln v


@singledispatch
def hessians(problem: LoopProblem, kappa: Array, tau: float, rows: Constraints) -> Array:
    """(M, n + 1, n + 1): ∂²c_j to (κ, τ), κ first."""
    n, m, P = len(kappa), len(rows.v), problem.plants.count
    out = np.zeros((m, n + 1, n + 1))
    if not m:
        return out
    loop = problem.loop(kappa, tau)
    out[:, :n, :n] = second(rows.curve, rows.plant // P, rows.plant % P, rows.v, loop)
    (_, slope, *_), up, down = (
        evaluate_rows(problem, kappa, tau, rows.curve, rows.plant, rows.v * np.exp(step))
        for step in (0.0, STEP, -STEP)
    )
    c_xx, c_xk = ((up[i] - down[i]) / (2.0 * STEP) for i in (1, 2))
    end = rows.curve == Curve.CROSSING
    fixed = end | (rows.curve == Curve.S_LOW)
    top = ~fixed & (c_xx < 0.0) & (np.abs(slope) < 1e-3 * np.sqrt(np.abs(c_xx)))
    shift = c_xk / np.where(top, -c_xx, np.inf)[:, None]
    out[:, :n, :n] += shift[:, :, None] * c_xk[:, None, :]
    if end.any():
        chain = rows.to_tau[end] / np.where(slope[end] == 0.0, 1.0, slope[end])
        out[end, :n, n] = out[end, n, :n] = chain[:, None] * c_xk[end]
        out[end, n, n] = chain**2 * c_xx[end]
    return out
