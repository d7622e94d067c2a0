"""γ_opt and the central controller of one plant with one set of weights, compiled."""

import numpy as np

from ccd_casadi.kernels.balance import balancing, in_coordinates, rounding_noise
from ccd_casadi.kernels.blocks import add, symmetric_part, transposed
from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.disturbance import disturbance_bound, filter_solution, innovations_plant
from ccd_casadi.kernels.figures import Code, Column
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import gamma_lower_bound, optimal_gamma
from ccd_casadi.kernels.generalized_plant import MixedPlant, plant_matrices
from ccd_casadi.kernels.lapack import solve, stable_subspace
from ccd_casadi.kernels.riccati import NOISE, level_hamiltonian, lqr_hamiltonian

_COUNT = int(Column.COUNT)
GAMMA_TOLERANCE = 1e-11
ENOUGH = 1e-8  # relative error of γ_opt above which it is looked for in balanced coordinates too


@compiled
def central_controller(gp, H0, gamma):
    """A_K = A + B2 F - B1 C2, B_K = B1, C_K = F, F = -(B2ᵀX + D12ᵀC1)/d2², X at γ; and ok."""
    Ag, B1, B2, C1, C2, d1, d2 = gp
    p, m = C2.shape[0], B2.shape[1]
    t = gamma**2 - d1**2
    _, U1, U2, _, ok = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    N = Ag.shape[0]
    X, regular = solve(transposed(U1), transposed(U2))
    if not (ok and regular):
        return np.zeros((N, N)), B1, np.zeros((m, N)), False
    X = symmetric_part(X, 0.5)
    F, Ak = transposed(B2) @ X, Ag.copy()
    for i in range(m):
        for j in range(N):
            F[i, j] = -(F[i, j] + d2 * C1[p + i, j]) / d2**2
    add(Ak, 0, 0, 1.0, B2 @ F)
    add(Ak, 0, 0, -1.0, B1 @ C2)
    return Ak, B1, F, True


@compiled
def _search_and_control(gp, H0, bound, backoff, guess, noise):
    """γ_opt, never below `bound`, and the central controller at backoff·γ_opt: the row, K."""
    row = np.full(_COUNT, np.nan)
    gamma_opt, limited, forms, converged, error = optimal_gamma(
        H0, gp.B1, gp.C1, gp.d1, bound, guess, GAMMA_TOLERANCE, noise
    )
    row[Column.GAMMA_OPT], row[Column.GAMMA_LOWER_BOUND] = gamma_opt, bound
    row[Column.LIMITED_BY_BOUND], row[Column.SCHUR_FORMS] = limited, forms
    row[Column.GAMMA_ERROR] = error
    Ak, Bk, Ck, ok = central_controller(gp, H0, backoff * gamma_opt)
    row[Column.CODE] = Code.CERTIFIED.value
    if not ok:
        row[Column.CODE] = Code.RICCATI_FAILED.value
    if not converged:
        row[Column.CODE] = Code.GAMMA_NOT_CONVERGED.value
    return row, Ak, Bk, Ck


@compiled
def _mixed(A, B, C, w, grid, sigma):
    """What the generalized plant of mixed sensitivity has, and γ_jω."""
    bound = gamma_lower_bound(prepare(A, B, C), w, grid, sigma)[0]
    return plant_matrices(A, B, C, w), bound


# What follows is plain NumPy around these.


def synthesise(A, B, C, w, grid, sigma, backoff, guess, balanced, delta=0.0):
    """γ_opt and the central controller at backoff·γ_opt. Returns the row, A_K, B_K, C_K.

    The row's code is CERTIFIED where the controller may go on to be assessed. `balanced` solves
    in balanced coordinates, with the noise of rounding measured; the controller is in the
    plant's own ones always. δ > 0 is the four-block problem of `disturbance`.
    """
    if delta == 0.0:
        matrices, bound = _mixed(A, B, C, w, grid, sigma)
        gp = MixedPlant(*matrices)
    else:
        Y, ok = filter_solution(A, B, C, delta)
        if not ok:
            row, none = np.full(_COUNT, np.nan), np.full((1, 1), np.nan)
            row[Column.CODE], row[Column.LIMITED_BY_BOUND] = float(Code.FILTER_FAILED), 0.0
            return row, none, none, none
        gp, bound = innovations_plant(A, B, C, w, Y), disturbance_bound(A, B, C, w, delta, grid)[0]
    if balanced:
        gp, H0, τ = _balanced(gp, bound)
        with np.errstate(all="ignore"):  # an undefined number is seen in the result
            row, *K = _search_and_control(gp, H0, bound, backoff, guess, rounding_noise(H0))
            return row, *_in_own_coordinates(*K, τ)
    row, *K = _search_and_control(gp, lqr_hamiltonian(gp), bound, backoff, guess, NOISE)
    closed = row[Column.CODE] != Code.GAMMA_NOT_CONVERGED
    if closed and ENOUGH < row[Column.GAMMA_ERROR] < np.inf:
        return _with_a_better_optimum(row, K, gp, bound, backoff)
    return row, *K


def _in_own_coordinates(Ak, Bk, Ck, τ):
    """The controller on states x̂ = x/τ on x; no rounding, as τ are powers of two."""
    back = τ.reshape(-1, 1)
    return Ak * (back / τ), Bk * back, Ck / τ


def _balanced(gp, bound):
    """The generalized plant and H0 in balanced coordinates, and τ."""
    t = max((1.3 * bound) ** 2 - gp.d1**2, 1e-12)  # where the search begins
    with np.errstate(all="ignore"):
        τ = balancing(level_hamiltonian(lqr_hamiltonian(gp), gp.B1, gp.C1, gp.d1, t))
        gp = in_coordinates(gp, τ)
    return gp, lqr_hamiltonian(gp), τ


def _with_a_better_optimum(row, K, gp, bound, backoff):
    """γ_opt and K from balanced coordinates where γ_opt agrees with what was found, or that."""
    gp, H0, τ = _balanced(gp, bound)
    gamma_opt, error = float(row[Column.GAMMA_OPT]), float(row[Column.GAMMA_ERROR])
    again, at_bound, more, closed, left = optimal_gamma(
        H0, gp.B1, gp.C1, gp.d1, bound, gamma_opt, GAMMA_TOLERANCE, NOISE
    )
    row[Column.SCHUR_FORMS] += more
    # only what both agree on within their errors is the same optimum
    if not (closed and left < error and abs(again - gamma_opt) <= error * again):
        return row, *K
    row[Column.GAMMA_OPT], row[Column.GAMMA_ERROR] = again, left
    row[Column.LIMITED_BY_BOUND] = at_bound
    *K, ok = central_controller(gp, H0, backoff * again)
    row[Column.CODE] = float(Code.CERTIFIED if ok else Code.RICCATI_FAILED)
    return row, *_in_own_coordinates(*K, τ)
