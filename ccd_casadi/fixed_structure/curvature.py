"""The Hessians of the constraints c_j to (κ, τ), exact but for one difference in frequency.

At a fixed frequency, with g = ∂ln K,

    ∂²ln|S| = -Re(S T g gᵀ + T ∂²ln K),   ∂²ln|KS| = ∂²ln|T| = -Re(S T g gᵀ - S ∂²ln K),

and a peak moves as κ does: -c_xκ c_xκᵀ/c_xx is added, x = ln v. (T here is without weight.)
"""

from functools import singledispatch

import numpy as np

from ccd_casadi.fixed_structure.figures import IS_OF_S, loop_rows, to_parameters
from ccd_casadi.fixed_structure.loop_problem import Constraints, Curve, LoopProblem, Problem
from ccd_casadi.fixed_structure.structure import second_slopes
from ccd_casadi.support.arrays import Array

STEP = 1e-5  # of ln v


@singledispatch
def hessians(problem: LoopProblem, kappa: Array, tau: float, rows: Constraints) -> Array:
    """(M, n + 1, n + 1): ∂²c_j to (κ, τ), κ first."""
    assert isinstance(problem, Problem)
    n, m = len(kappa), len(rows.v)
    out = np.zeros((m, n + 1, n + 1))
    if not m:
        return out
    _, slope, S, g = loop_rows(problem, kappa, tau, rows.curve, rows.plant, rows.v)
    T = 1.0 - S
    of_s = IS_OF_S[rows.curve]
    second = second_slopes(problem.structure, kappa, 1j * rows.v)
    weighted = np.where(of_s, -T, S)[:, None, None] * second
    out[:, :n, :n] = (weighted - (S * T)[:, None, None] * g[:, :, None] * g[:, None, :]).real
    slopes, gradients = [], []
    for sign in (1.0, -1.0):
        moved = rows.v * np.exp(sign * STEP)
        _, near, *parts = loop_rows(problem, kappa, tau, rows.curve, rows.plant, moved)
        slopes.append(near)
        gradients.append(to_parameters(rows.curve, *parts))
    c_xx = (slopes[0] - slopes[1]) / (2.0 * STEP)
    c_xk = (gradients[0] - gradients[1]) / (2.0 * STEP)
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
