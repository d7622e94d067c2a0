"""γ_opt and the central controller of one plant with one set of weights, compiled."""

import numpy as np

from ccd_casadi.kernels.balance import balancing, in_coordinates, rounding_noise
from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.figures import Code, Figure
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import gamma_lower_bound, optimal_gamma
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.kernels.lapack import stable_subspace
from ccd_casadi.kernels.riccati import NOISE, level_hamiltonian, lqr_hamiltonian

_COUNT = int(Figure.COUNT)
GAMMA_TOLERANCE = 1e-11
ENOUGH = 1e-8  # relative error of γ_opt above which it is looked for in balanced coordinates too


@compiled
def central_controller(Ag, B1, B2, C1, C2, d1, d2, H0, gamma):
    """A_K = A + B2 F - B1 C2, B_K = B1, C_K = F, F = -(B2ᵀX + D12ᵀC1)/d2², X at γ; and ok."""
    p, m = C2.shape[0], B2.shape[1]
    t = gamma**2 - d1**2
    _, U1, U2, _, ok = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    N = Ag.shape[0]
    if not ok:
        return np.zeros((N, N)), B1, np.zeros((m, N)), False
    X = np.linalg.solve(np.ascontiguousarray(U1.T), np.ascontiguousarray(U2.T))
    X = 0.5 * (X + X.T)
    F = -(np.ascontiguousarray(B2.T) @ X + d2 * C1[p : p + m]) / d2**2
    return Ag + B2 @ F - B1 @ C2, B1, F, True


@compiled
def _balanced(gp, H0, bound, p, m):
    """The generalized plant and H0 in balanced coordinates, and their τ."""
    t = max((1.3 * bound) ** 2 - gp[5] ** 2, 1e-12)  # where the search begins
    τ = balancing(level_hamiltonian(H0, gp[1], gp[3], gp[5], t))
    gp = in_coordinates(gp, τ)
    return gp, lqr_hamiltonian(gp[0], gp[2], gp[3], gp[6], p, m), τ


@compiled
def synthesise(A, B, C, w, grid, sigma, backoff, guess, balanced):
    """γ_opt and the central controller at backoff·γ_opt. Returns the row, A_K, B_K, C_K.

    The row's code is CERTIFIED where the controller may go on to be assessed. `balanced` solves
    in balanced coordinates, with the noise of rounding measured; the controller is in the
    plant's own ones always.
    """
    row = np.full(_COUNT, np.nan)
    gp = generalized_plant(A, B, C, w)
    m, p, N = B.shape[1], C.shape[0], gp[0].shape[0]
    H0 = lqr_hamiltonian(gp[0], gp[2], gp[3], gp[6], p, m)
    bound, _ = gamma_lower_bound(prepare(A, B, C), w, grid, sigma)
    τ, noise = np.ones(N), NOISE
    if balanced:
        gp, H0, τ = _balanced(gp, H0, bound, p, m)
        noise = rounding_noise(H0)
    Ag, B1, B2, C1, C2, d1, d2 = gp
    gamma_opt, limited, forms, converged, error = optimal_gamma(
        H0, B1, C1, d1, bound, guess, GAMMA_TOLERANCE, noise
    )
    if converged and ENOUGH < error < np.inf and not balanced:
        other, H0_other, _ = _balanced(gp, H0, bound, p, m)
        again, at_bound, more, closed, left = optimal_gamma(
            H0_other, other[1], other[3], d1, bound, gamma_opt, GAMMA_TOLERANCE, noise
        )
        forms += more
        # only what both agree on within their errors is the same optimum
        if closed and not at_bound and left < error and abs(again - gamma_opt) <= error * again:
            gamma_opt, error = again, left
    row[Figure.GAMMA_OPT], row[Figure.GAMMA_LOWER_BOUND] = gamma_opt, bound
    row[Figure.LIMITED_BY_BOUND], row[Figure.SCHUR_FORMS] = limited, forms
    row[Figure.GAMMA_ERROR] = error
    Ak, Bk, Ck, ok = central_controller(Ag, B1, B2, C1, C2, d1, d2, H0, backoff * gamma_opt)
    row[Figure.CODE] = Code.CERTIFIED.value
    if not ok:
        row[Figure.CODE] = Code.RICCATI_FAILED.value
    if not converged:
        row[Figure.CODE] = Code.GAMMA_NOT_CONVERGED.value
    if balanced:
        back = τ.reshape(-1, 1)
        return row, Ak * (back / τ), Bk * back, Ck / τ
    return row, Ak, Bk, Ck
