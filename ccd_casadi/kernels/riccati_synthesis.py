"""One synthesis of a controller, with or without a disturbance at the plant's input."""

from typing import NamedTuple

import numpy as np

from ccd_casadi.kernels.adjoint import bound_terms
from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.frequency import prepare, responses
from ccd_casadi.kernels.gamma import gamma_lower_bound, optimal_gamma
from ccd_casadi.kernels.generalized_plant import (
    MixedPlant,
    add,
    first_order_weights,
    plant_matrices,
    squared_weights,
    symmetric_part,
    transpose,
    unstable_modes,
    unstable_plant,
    without_copies,
)
from ccd_casadi.kernels.linear_algebra import solve, stable_subspace
from ccd_casadi.kernels.riccati import (
    RiccatiOptions,
    balancing,
    in_coordinates,
    level_hamiltonian,
    lqr_hamiltonian,
    rounding_noise,
)
from ccd_casadi.kernels.sensitivity import Code, Column


class RiccatiSynthesisOptions(NamedTuple):
    """Numbers of a synthesis.

    Attributes
    ----------
    gamma_tolerance : float
        Relative, of γ_opt.
    error_accepted : float
        Relative error of γ_opt above which it is searched for in balanced coordinates, too.
    refined_from : float
        Share of the highest peak of the bound, squared, from which a peak is refined.
    zooms, zoom_points : int
        Refinements of a peak, each of which narrows its bracket to an eighth by this many points.
    """

    gamma_tolerance: float = 1e-11
    error_accepted: float = 1e-8
    refined_from: float = 0.95
    zooms: int = 4
    zoom_points: int = 17


OPTIONS = RiccatiSynthesisOptions()


def filter_solution(A, B, C, delta):
    """Y (n, n), and whether the filter's Hamiltonian splits: A - YCᵀC is then stable."""
    H = np.block([[A.T, -C.T @ C], [-(delta**2) * (B @ B.T), -A]])
    _, U1, U2, _, ok = stable_subspace(np.ascontiguousarray(H))
    if not ok:
        return np.full_like(A, np.nan), False
    Y = np.linalg.solve(U1.T, U2.T)
    return 0.5 * (Y + Y.T), True


def four_block_plant(A, B, C, w, delta):
    """Make the standard plant of (r, d) to [W1 e; W2 u; W3 u].

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        Scaled plant.
    w : array (8,)
        Scaled weights.
    delta : float
        Size of the disturbance at the plant's input.

    Returns
    -------
    A, B1, B2, C1, C2, D11, D12 : arrays
        States [plant; W1; W2; W3].
    """
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    f, channels = first_order_weights(w), [p, m, m]
    N = n + p + 2 * m
    pole, into, out, direct = (np.repeat(f[:, k], channels) for k in range(4))
    twice = np.vstack([np.eye(m), np.eye(m)])
    Ag, B1, B2 = np.zeros((N, N)), np.zeros((N, p + m)), np.zeros((N, m))
    Ag[:n, :n], Ag[n:, n:], Ag[n : n + p, :n] = A, -np.diag(pole), -f[0, 1] * C
    B1[:n, p:], B1[n : n + p, :p] = delta * B, f[0, 1] * np.eye(p)
    B2[:n], B2[n + p :] = B, into[p:, None] * twice
    C1, D11, D12 = np.zeros((p + 2 * m, N)), np.zeros((p + 2 * m, p + m)), np.zeros((p + 2 * m, m))
    C1[:, n:], C1[:p, :n] = np.diag(out), -f[0, 3] * C
    D11[:p, :p], D12[p:] = f[0, 3] * np.eye(p), direct[p:, None] * twice
    return Ag, B1, B2, C1, np.hstack([-C, np.zeros((p, N - n))]), D11, D12


def innovations_plant(A, B, C, w, Y):
    """The plant of the equivalent problem; states as in `four_block_plant`.

    z = [W1 e; (d2 z2 + d3 z3)/d; (d2 z3 - d3 z2)/d] with d² = d2² + d3²: turned so that the
    feedthrough of u is [0; d I; 0], as the kernels of the first kind take it.
    """
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    Ag, B1, B2, C1, C2, D11, D12 = four_block_plant(A, B, C, w, 0.0)
    B1 = np.ascontiguousarray(B1[:, :p])
    B1[:n] = -Y @ C.T
    d2, d3 = D12[p, 0], D12[p + m, 0]
    d = np.hypot(d2, d3)
    C1[p:] = np.kron(np.array([[d2, d3], [-d3, d2]]) / d, np.eye(m)) @ C1[p:]
    return MixedPlant(Ag, B1, B2, C1, C2, float(D11[0, 0]), float(d))


# ---- what no controller passes ------------------------------------------------------------------


def _bounds(G, w, delta, omega):
    """γ_jω² (2, k) along the directions of the largest and least gain of G."""
    g = responses(G, omega)
    sigma = np.abs(g[:, 0]) if g.shape[1:] == (1, 1) else np.linalg.svd(g, compute_uv=False)
    p, m = G[2].shape[0], G[1].shape[1]
    ends = np.array([sigma[:, 0], sigma[:, -1] if m >= p else np.zeros(omega.size)])
    W1, W2, W3 = squared_weights(w, omega)
    return bound_terms(W1, W2, W3, ends, delta).value


def disturbance_bound(A, B, C, w, delta, grid):
    """γ_jω, the ω over ω₀ where it is attained, and whether along the least gain (else largest)."""
    G = prepare(A, B, C)
    # from rest on, where W1 is largest
    grid = np.concatenate([[0.0], np.geomspace(1e-9, 5e-6, 8), grid])
    values = np.nan_to_num(_bounds(G, w, delta, grid), nan=0.0)  # a pole at 0
    top, at = values.max(), np.unravel_index(int(values.argmax()), values.shape)
    best = float(top), float(grid[at[1]]), bool(at[0])
    inner = values[:, 1:-1]
    peaks = (
        (inner >= values[:, :-2]) & (inner > values[:, 2:]) & (inner > OPTIONS.refined_from * top)
    )
    for branch, i in zip(*np.nonzero(peaks), strict=True):
        low, high = grid[i], grid[i + 2]
        for _ in range(OPTIONS.zooms):
            trial = np.linspace(low, high, OPTIONS.zoom_points)
            found = _bounds(G, w, delta, trial)[branch]
            k = int(np.clip(found.argmax(), 1, OPTIONS.zoom_points - 2))
            low, high = trial[k - 1], trial[k + 1]
            if found[k] > best[0]:
                best = float(found[k]), float(trial[k]), bool(branch)
    return float(np.sqrt(best[0])), *best[1:]


_COUNT = int(Column.COUNT)


@compiled
def central_controller(gp, H0, gamma):
    """A_K = A + B2 F - B1 C2, B_K = B1, C_K = F, F = -(B2ᵀX + D12ᵀC1)/d2², X at γ; and ok."""
    Ag, B1, B2, C1, C2, d1, d2 = gp
    p, m = C2.shape[0], B2.shape[1]
    t = gamma**2 - d1**2
    _, U1, U2, _, ok = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    N = Ag.shape[0]
    X, regular = solve(transpose(U1), transpose(U2))
    if not (ok and regular):
        return np.zeros((N, N)), B1, np.zeros((m, N)), False
    X = symmetric_part(X, 0.5)
    F, Ak = transpose(B2) @ X, Ag.copy()
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
        H0, gp.B1, gp.C1, gp.d1, bound, guess, OPTIONS.gamma_tolerance, noise
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
def _prepare(A, B, C, w, grid, sigma):
    """Prepare the data of the generalized plant of mixed sensitivity, γ_jω, and the largest Re of a
    pole."""
    G = prepare(A, B, C)
    bound, rate = gamma_lower_bound(G, w, grid, sigma)[0], -np.inf
    for i in range(G[0].shape[0]):
        rate = max(rate, G[0][i, i])
    return plant_matrices(A, B, C, w), bound, rate


# What follows is plain NumPy around these.


def synthesise(A, B, C, w, grid, sigma, backoff, guess, balanced, delta=0.0):
    """Compute γ_opt and the central controller at backoff·γ_opt.

    Parameters
    ----------
    A, B, C, w, grid, sigma, backoff, guess
        As in `design.design`.
    balanced : bool
        Solve in balanced coordinates, with the noise of rounding measured; the controller is in the
        plant's coordinates in any case.
    delta : float
        Above 0 it is the four-block problem with a disturbance.

    Returns
    -------
    row : array (Column.COUNT,)
        Its code is CERTIFIED where the controller may go on to be certified.
    A_K, B_K, C_K : arrays
    """
    modes = None
    if delta == 0.0:
        matrices, bound, rate = _prepare(A, B, C, w, grid, sigma)
        modes = unstable_modes(A, C) if rate > 0.0 else None
        gp = unstable_plant(A, B, C, w, modes) if modes else MixedPlant(*matrices)
    else:
        Y, ok = filter_solution(A, B, C, delta)
        if not ok:
            row, none = np.full(_COUNT, np.nan), np.full((1, 1), np.nan)
            row[Column.CODE], row[Column.LIMITED_BY_BOUND] = float(Code.FILTER_FAILED), 0.0
            return row, none, none, none
        gp, bound = innovations_plant(A, B, C, w, Y), disturbance_bound(A, B, C, w, delta, grid)[0]
    row, *K = _solve(gp, bound, backoff, guess, balanced)
    if modes and row[Column.CODE] == Code.CERTIFIED:
        K = without_copies(*K, modes)
    return row, *K


def _solve(gp, bound, backoff, guess, balanced):
    """`synthesise` on a generalized plant."""
    if balanced:
        gp, H0, τ = _balance(gp, bound)
        with np.errstate(all="ignore"):  # an undefined number is seen in the result
            row, *K = _search_and_control(gp, H0, bound, backoff, guess, rounding_noise(H0))
            return row, *_in_own_coordinates(*K, τ)
    noise = RiccatiOptions.noise
    row, *K = _search_and_control(gp, lqr_hamiltonian(gp), bound, backoff, guess, noise)
    closed = row[Column.CODE] != Code.GAMMA_NOT_CONVERGED
    if closed and OPTIONS.error_accepted < row[Column.GAMMA_ERROR]:
        return _with_a_better_optimum(row, K, gp, bound, backoff)
    return row, *K


def _in_own_coordinates(Ak, Bk, Ck, τ):
    """The controller on states x̂ = x/τ on x; no rounding, as τ are powers of two."""
    back = τ.reshape(-1, 1)
    return Ak * (back / τ), Bk * back, Ck / τ


def _balance(gp, bound):
    """The generalized plant and H0 in balanced coordinates, and τ."""
    t = max((1.3 * bound) ** 2 - gp.d1**2, 1e-12)  # where the search begins
    with np.errstate(all="ignore"):
        τ = balancing(level_hamiltonian(lqr_hamiltonian(gp), gp.B1, gp.C1, gp.d1, t))
        gp = in_coordinates(gp, τ)
    return gp, lqr_hamiltonian(gp), τ


def _with_a_better_optimum(row, K, gp, bound, backoff):
    """γ_opt and K from balanced coordinates where γ_opt agrees with what was found, or that."""
    gp, H0, τ = _balance(gp, bound)
    gamma_opt, error = float(row[Column.GAMMA_OPT]), float(row[Column.GAMMA_ERROR])
    again, at_bound, more, closed, left = optimal_gamma(
        H0, gp.B1, gp.C1, gp.d1, bound, gamma_opt, OPTIONS.gamma_tolerance, RiccatiOptions.noise
    )
    row[Column.SCHUR_FORMS] += more
    # only what both agree on within their errors is the same optimum; one whose error is not known
    # gives way instead to one that is found to within the back-off
    sure = closed and left < min(error, backoff - 1.0)
    if not (sure and abs(again - gamma_opt) <= error * again):
        return row, *K
    row[Column.GAMMA_OPT], row[Column.GAMMA_ERROR] = again, left
    row[Column.LIMITED_BY_BOUND] = at_bound
    *K, ok = central_controller(gp, H0, backoff * again)
    row[Column.CODE] = float(Code.CERTIFIED if ok else Code.RICCATI_FAILED)
    return row, *_in_own_coordinates(*K, τ)
