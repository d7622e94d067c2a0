"""The gradient of ω_b*(θ) by the envelope theorem.

    dω_b*/dθ = ∂ω_b/∂θ - Σ μ_i ∂g_i/∂θ,   ∂ω_b/∂x = Σ μ_i ∂g_i/∂x at the inner optimum,

x = (ln ω_S, ln ω_T), g the active constraints, ends of the ranges included.
"""

import numpy as np

from ccd_casadi.optim.kkt import non_negative
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities

RESIDUAL = 1e-3  # relative; above it the point is no stationary one and has no envelope gradient


def bandwidth_gradient(
    optimum: Sensitivities, active: tuple[str, ...], bounded: tuple[str, ...]
) -> Array:
    """dω_b*/dθ (n_θ,) in rad/s per unit of θ; NaN where the optimality conditions do not hold.

    `bounded` names the rows 1 to -2 of the optimum's values, as `InnerProblem.bounds` does.
    """
    x = optimum.to_break_frequencies
    columns, slopes = [], []
    zero = np.zeros(optimum.to_theta.shape[1])
    for name in active:
        if name in bounded:
            i = 1 + bounded.index(name)
            columns.append(x[i])
            slopes.append(optimum.to_theta[i])
        else:
            variable, end = name.split()
            sign = 1.0 if end == "upper" else -1.0
            columns.append(sign * np.eye(2)[0 if variable == "omega_S" else 1])
            slopes.append(zero)
    mu, residual = non_negative(np.reshape(columns, (-1, 2)), x[0])
    if residual > RESIDUAL:
        return np.full_like(zero, np.nan)
    return optimum.to_theta[0] - mu @ np.reshape(slopes, (-1, len(zero)))
