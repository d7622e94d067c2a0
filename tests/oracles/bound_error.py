"""What rounding leaves in the bound γ_jω, and so in a γ_opt that the bound limits."""

import numpy as np

from ccd_casadi.kernels.adjoint import direction
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import BACKWARD, gamma_lower_bound
from ccd_casadi.kernels.generalized_plant import squared_weights
from ccd_casadi.kernels.sensitivity import Column
from ccd_casadi.support.arrays import Array

EPS = 2.0**-52
DEVIATIONS = 4.0  # standard deviations of the rounding that `bound_error` admits


def bound_error(A: Array, B: Array, C: Array, w: Array, ω: float) -> float:
    """δγ_jω/γ_jω that rounding leaves in the bound attained at ω, through σ_p(G(jω)).

    δσ = l δT r, l = u* C (jω - T)⁻¹, r = (jω - T)⁻¹ B v, in coordinates of the Schur form T of A.
    Its own backward error is |δT| = BACKWARD |T|, spread evenly over the entries; the solves at ω
    leave eps |T_ij| in each, which is more where eigenvalues stand in an unlucky order. Next to a
    transmission zero of small damping σ is small and its error is not.
    """
    T, B, C = prepare(A, B, C)
    n = T.shape[0]
    M, right, σ, u, v = direction(T, B, C, ω)
    if σ == 0.0:
        return 0.0  # fewer inputs than outputs, or none that acts: the bound is |W1|
    left = np.linalg.solve(M.T, u.conj() @ C)
    form = BACKWARD * np.linalg.norm(T) / n * np.linalg.norm(left) * np.linalg.norm(right @ v)
    squares = [np.abs(part) ** 2 for part in (left, M, right, v)]
    dσ = np.hypot(form, EPS * np.sqrt(np.linalg.multi_dot(squares)))
    W1, W2, W3 = squared_weights(w, ω)
    force = W2 / σ**2
    return float(DEVIATIONS * W1 / (W1 + force + W3) * force / (force + W3) * dσ / σ)


def gamma_error(
    row: Array, A: Array, B: Array, C: Array, w: Array, grid: Array, gain: Array
) -> float:
    """δγ_opt/γ_opt of a design's row: of its search, and of the bound where that limits it."""
    error = float(row[Column.GAMMA_ERROR])
    if row[Column.LIMITED_BY_BOUND]:
        error += bound_error(A, B, C, w, gamma_lower_bound(prepare(A, B, C), w, grid, gain)[1])
    return error
