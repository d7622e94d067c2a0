"""The Hessians of constraints c_j to (κ, τ) that are logarithms of singular values.

With ∂_a M = P_i ∂_a K_i Q_i (see `mimo_figures`) and R = Uᵀ S G V, a of channel i, b of channel j,

    ∂²_ab M = -P_i ∂_a K_i R_ij ∂_b K_j Q_j - P_j ∂_b K_j R_ji ∂_a K_i Q_i + δ_ij P_i ∂²_ab K_i Q_i,

and of σ as an eigenvalue of [0 M; Mᴴ 0], with X_m = u_mᴴ ∂M v and Y_m = uᴴ ∂M v_m,

    ∂²σ = Re(uᴴ ∂²M v) + ½ Σ_{m≠} |X_m + Ȳ_m|²/(σ - σ_m) + ½ Σ_m |X_m - Ȳ_m|²/(σ + σ_m).

Where σ_m comes close to σ the gap is kept from zero: both are constraints, and the trust region
holds where the model does. A peak moves as κ does: -c_xκ c_xκᵀ/c_xx is added, x = ln v.
"""

import numpy as np

from ccd_casadi.fixed_structure.curvature import STEP
from ccd_casadi.fixed_structure.loop_problem import Constraints, Curve
from ccd_casadi.fixed_structure.mimo_figures import Rows, evaluate_rows
from ccd_casadi.fixed_structure.mimo_levels import MatrixProblem
from ccd_casadi.fixed_structure.structure import second_slopes
from ccd_casadi.support.arrays import Array

LEAST_GAP = 1e-2  # of two singular values, relative, that the model counts with


def whole_hessians(problem: MatrixProblem, kappa: Array, tau: float, rows: Constraints) -> Array:
    """(M, n + 1, n + 1): ∂²c_j to (κ, τ), κ first."""
    n, m = len(kappa), len(rows.v)
    out = np.zeros((m, n + 1, n + 1))
    if not m:
        return out

    def at(v: Array) -> Rows:
        return evaluate_rows(problem, kappa, tau, rows.curve, rows.plant, v)

    here, up, down = at(rows.v), at(rows.v * np.exp(STEP)), at(rows.v * np.exp(-STEP))
    out[:, :n, :n] = _second(problem, kappa, rows.v, here)
    c_xx = (up.slope - down.slope) / (2.0 * STEP)
    c_xk = (up.to_kappa - down.to_kappa) / (2.0 * STEP)
    end = rows.curve == Curve.CROSSING
    fixed = end | (rows.curve == Curve.S_LOW)
    top = ~fixed & (c_xx < 0.0) & (np.abs(here.slope) < 1e-3 * np.sqrt(np.abs(c_xx)))
    shift = c_xk / np.where(top, -c_xx, np.inf)[:, None]
    out[:, :n, :n] += shift[:, :, None] * c_xk[:, None, :]
    if end.any():
        chain = rows.to_tau[end] / np.where(here.slope[end] == 0.0, 1.0, here.slope[end])
        out[end, :n, n] = out[end, n, :n] = chain[:, None] * c_xk[end]
        out[end, n, n] = chain**2 * c_xx[end]
    return out


def _second(problem: MatrixProblem, kappa: Array, v: Array, at: Rows) -> Array:
    """∂²ln σ/∂κ² (M, n, n) at fixed frequencies."""
    structure = problem.structure
    n, rows = len(kappa), np.arange(len(v))
    sigma = at.s[rows, at.at]
    owner = np.empty(n, int)
    for i, place in enumerate(structure.slices):
        owner[place] = i
    dK = at.k[:, owner] * at.log_slopes
    left, right = at.left[rows, at.at][:, owner], at.right[rows, :, at.at][:, owner]
    inner = at.inner[:, owner][:, :, owner]
    mixed = (left * dK)[:, :, None] * inner * (dK * right)[:, None, :]
    out = -(mixed + np.swapaxes(mixed, 1, 2)).real
    for i, (own, part) in enumerate(structure.split(kappa)):
        place = structure.slices[i]
        g = at.log_slopes[:, place]
        curved = second_slopes(own, part, 1j * v) + g[:, :, None] * g[:, None, :]
        weight = at.left[rows, at.at, i] * at.k[:, i] * at.right[rows, i, at.at]
        out[:, place, place] += (weight[:, None, None] * curved).real
    X = at.left[:, :, owner] * (dK * right)[:, None, :]  # (M, m, n)
    Y = (left * dK)[:, None, :] * np.swapaxes(at.right, 1, 2)[:, :, owner]
    plus, minus = X + np.conj(Y), X - np.conj(Y)
    gap = sigma[:, None] - at.s
    floor = LEAST_GAP * sigma[:, None]
    gap = np.where(np.abs(gap) < floor, np.where(gap < 0.0, -floor, floor), gap)
    share = 0.5 / gap
    share[rows, at.at] = 0.0
    other = 0.5 / (sigma[:, None] + at.s)
    out += np.einsum("mk,mka,mkb->mab", share, plus, np.conj(plus), optimize=True).real
    out += np.einsum("mk,mka,mkb->mab", other, minus, np.conj(minus), optimize=True).real
    first = at.to_kappa
    return np.asarray(out / sigma[:, None, None] - first[:, :, None] * first[:, None, :])
