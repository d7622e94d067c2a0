"""Total derivatives of a design's figures, the controller moving with the plant.

Each figure is a scalar of S = (I + GK)⁻¹ with K = C_K(s - A_K)⁻¹B_K, A_K = A + B2 F - B1 C2,
F = -(B2ᵀX + D12ᵀC1)/d2² and X the stabilising solution of

    AᵀX + XA + C1ᵀC1 + t VᵀV - d2² FᵀF = 0,   V = (B1ᵀX + Sᵀ)/t,   t = γ² - d1².

With X̄ the gradient to X, one adjoint Lyapunov equation A_c L + L A_cᵀ + X̄ = 0 with
A_c = A + B1 V + B2 F gives the gradient to every matrix at once, however many parameters there
are. γ_opt, where X is infinite, has the same equation in the basis [U1; U2] of the stable
subspace: only f = λ_min(X⁻¹) and its null vector q appear, T11 Λ + Λ T11ᵀ + qqᵀ = 0.
"""

from math import nan

import numpy as np

from ccd_casadi.kernels.bound_peak import bound_peak
from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.design import design
from ccd_casadi.kernels.figures import Code, Figure
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import gamma_lower_bound
from ccd_casadi.kernels.generalized_plant import first_order_weights, generalized_plant
from ccd_casadi.kernels.lapack import lyapunov_triangular, stable_subspace
from ccd_casadi.kernels.pullback import bound_gradient, gain_to_weights, to_plant, to_weights
from ccd_casadi.kernels.riccati import NOISE, level_hamiltonian, lqr_hamiltonian, riccati_level


@compiled
def _row(v, M):
    """v M for a complex row and a real matrix."""
    return np.ascontiguousarray(v.real) @ M + 1j * (np.ascontiguousarray(v.imag) @ M)


@compiled
def _column(M, v):
    """M v for a real matrix and a complex column."""
    return M @ np.ascontiguousarray(v.real) + 1j * (M @ np.ascontiguousarray(v.imag))


@compiled
def _riccati_terms(T11, U1, U2, L, gp, t):
    """Gradients of tr(Λ E) to A, B2, C1 and γ², E the Riccati's differential in the basis of U.

    E is the stationary value of 2 pᵀẋ + zᵀz - γ² wᵀw over u and the disturbance w, so that only
    what stands in ẋ and z counts. The gradients to A and C1 are p xᵀ and z xᵀ summed over Λ; with
    each comes the sum with ẋ for x.
    """
    _, B1, B2, C1, _, d1, d2 = gp
    p, m = B1.shape[1], B2.shape[1]
    V = (np.ascontiguousarray(B1.T) @ U2 + d1 * (C1[:p] @ U1)) / t
    F = -(np.ascontiguousarray(B2.T) @ U2 + d2 * (C1[p : p + m] @ U1)) / d2**2
    Z = C1 @ U1
    Z[:p] += d1 * V
    Z[p : p + m] += d2 * F
    states, rates = np.ascontiguousarray(U1.T), np.ascontiguousarray((U1 @ T11).T)
    costate, output = 2.0 * (U2 @ L), 2.0 * (Z @ L)
    A_, A_rate, B2_ = costate @ states, costate @ rates, costate @ np.ascontiguousarray(F.T)
    return A_, A_rate, B2_, output @ states, output @ rates, -np.sum(V * (V @ L))


@compiled
def gamma_gradient(A, B, C, w, gp, H0, f, gamma_opt, limited, bound_frequency):
    """Gradients of γ_opt to A, B, C and w; and ok."""
    _, B1, _, C1, _, d1, _ = gp
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    if limited:
        A_, B_, C_, w_ = bound_gradient(A, B, C, w, bound_frequency)
        return A_, B_, C_, w_, True
    t = gamma_opt**2 - d1**2
    _, _, ok, (_, T11, U1, U2, _, _, q, _, _) = riccati_level(H0, B1, C1, d1, t, NOISE)
    Lq = lyapunov_triangular(T11, -np.outer(q, q), False)
    Ar, Ar_rate, B2r, C1r, C1r_rate, level = _riccati_terms(T11, U1, U2, Lq, gp, t)
    A_, B_, C_ = to_plant(Ar, B2r, C1r, np.zeros((p, B1.shape[0])), f, C, m)
    w_ = to_weights(Ar, Ar_rate, C1r, C1r_rate, f, w, n, p, m)
    # γ moves so that f stays zero
    scale = -1.0 / (level * 2.0 * gamma_opt)
    return scale * A_, scale * B_, scale * C_, scale * w_, ok


@compiled
def _gain_cotangents(A, B, C, Ak, Bk, Ck, ω):
    """Vectors of dσ = -Re(a(dG K + G dK)b) at ω, and dσ/dω, σ, the relative gap to σ_2."""
    n, N, p = A.shape[0], Ak.shape[0], C.shape[0]
    M = (1j * ω) * np.eye(n) - A
    Mk = (1j * ω) * np.eye(N) - Ak
    GB = np.linalg.solve(M, B.astype(np.complex128))
    CG = np.ascontiguousarray(
        np.linalg.solve(np.ascontiguousarray(M.T), C.T.astype(np.complex128)).T
    )
    KB = np.linalg.solve(Mk, Bk.astype(np.complex128))
    CK = np.ascontiguousarray(
        np.linalg.solve(np.ascontiguousarray(Mk.T), Ck.T.astype(np.complex128)).T
    )
    G = C.astype(np.complex128) @ GB
    K = Ck.astype(np.complex128) @ KB
    S = np.linalg.inv(np.eye(p) + G @ K)
    U, s, Vh = np.linalg.svd(S)
    u = np.ascontiguousarray(U[:, 0].conj())
    v = np.ascontiguousarray(Vh[0, :].conj())
    gap = 1.0 if p == 1 else (s[0] - s[1]) / s[0]
    a, b = u @ S, S @ v
    Kb, aG = K @ b, a @ G
    lG, rG = a @ CG, GB @ Kb
    lK, rK = aG @ CK, KB @ b
    # dG/dω = -j C M⁻² B, dK/dω likewise
    slope = -(-1j * (np.sum(lG * rG) + np.sum(lK * rK))).real
    return a, Kb, aG, lG, rG, lK, rK, slope, s[0], gap


@compiled
def figure_gradients(A, B, C, w, gp, H0, f, backoff, gamma_opt, limited, bound_frequency, points):
    """Gradients of σ_max(S(jω)) at each ω of `points`, then of γ_opt, to A, B, C and w.

    Returns A_ (k+1, n, n), B_, C_, w_ (k+1, 8), the slopes dσ/dω (k), σ (k), the relative
    gaps (σ1 - σ2)/σ1 (k), the same gradients with K held fixed (the paper's, to A, B, C only),
    and ok. Fixed-K gradients do not depend on w.
    """
    Ag, B1, B2, C1, C2, d1, d2 = gp
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    k = points.size
    A_, B_, C_ = np.zeros((k + 1, n, n)), np.zeros((k + 1, n, m)), np.zeros((k + 1, p, n))
    w_ = np.zeros((k + 1, 8))
    fixed_A, fixed_B, fixed_C = np.zeros((k, n, n)), np.zeros((k, n, m)), np.zeros((k, p, n))
    slopes, gains, gaps = np.zeros(k), np.zeros(k), np.zeros(k)
    ga, gb, gc, gw, ok = gamma_gradient(A, B, C, w, gp, H0, f, gamma_opt, limited, bound_frequency)
    A_[k], B_[k], C_[k], w_[k] = ga, gb, gc, gw
    gamma = backoff * gamma_opt
    t = gamma**2 - d1**2
    T11, U1, U2, _, split = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    ok = ok and split
    inverse = np.linalg.inv(U1)
    X = U2 @ inverse
    X = 0.5 * (X + X.T)
    F = -(B2.T @ X + d2 * C1[p : p + m]) / d2**2
    Ak = Ag + B2 @ F - B1 @ C2
    K_states = slice(n + p, n + p + m)  # of W2
    for i in range(k):
        a, Kb, aG, lG, rG, lK, rK, slopes[i], gains[i], gaps[i] = _gain_cotangents(
            A, B, C, Ak, B1, F, points[i]
        )
        fixed_A[i] = -np.outer(lG, rG).real
        fixed_B[i] = -np.outer(lG, Kb).real
        fixed_C[i] = -np.outer(a, rG).real
        h = aG + _row(lK, B2)
        XrK = _column(X, rK)
        F_ = -np.outer(h, rK).real
        X_ = -(B2 @ F_) / d2**2
        X_ = 0.5 * (X_ + X_.T)
        Lh = lyapunov_triangular(T11, -(inverse @ X_) @ inverse.T, False)
        Ar, Ar_rate, B2r, C1r, C1r_rate, level = _riccati_terms(T11, U1, U2, Lh, gp, t)
        rate = 1j * points[i] * rK
        Ar -= np.outer(lK, rK).real
        Ar_rate -= np.outer(lK, rate).real
        B2r += (np.outer(XrK, h) / d2**2 - np.outer(lK, _column(F, rK))).real
        C2r = np.outer(_row(lK, B1), rK).real
        pa, pb, pc = to_plant(Ar, B2r, C1r, C2r, f, C, m)
        pw = to_weights(Ar, Ar_rate, C1r, C1r_rate, f, w, n, p, m)
        pw += gain_to_weights(h, rK[K_states], XrK[K_states], rate[K_states], f, w)
        through = 2.0 * gamma * backoff * level
        A_[i] = fixed_A[i] + pa + through * ga
        B_[i] = fixed_B[i] + pb + through * gb
        C_[i] = fixed_C[i] + pc + through * gc
        w_[i] = pw + through * gw
    return A_, B_, C_, w_, slopes, gains, gaps, fixed_A, fixed_B, fixed_C, ok


def design_with_gradients(
    A, B, C, w, grid, sigma, backoff, omega_low, guess, dA, dB, dC, channels=()
):
    """A design, and the gradients of (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt).

    Returns the row, A_K, B_K, C_K, G (4, n_θ + 8): derivatives to θ then to the scaled weight
    vector; fixed (n_θ): the paper's dω_b/dθ with K held; gaps (3) of σ_max at the frequencies.
    The gradients are NaN where the design is not certified, and where it needed balanced
    coordinates: they are taken in the plant's own.
    """
    row, Ak, Bk, Ck = design(A, B, C, w, grid, sigma, backoff, omega_low, guess, channels)
    count = dA.shape[0]
    out, fixed, gaps = np.full((4, count + 8), nan), np.full(count, nan), np.full(3, nan)
    if row[Figure.CODE] != Code.CERTIFIED or row[Figure.BALANCED]:
        return row, Ak, Bk, Ck, out, fixed, gaps
    gp = generalized_plant(A, B, C, w)
    H0 = lqr_hamiltonian(gp[0], gp[2], gp[3], gp[6], C.shape[0], B.shape[1])
    limited = bool(row[Figure.LIMITED_BY_BOUND] > 0.5)
    at = 0.0
    if limited:
        at = bound_peak(A, B, C, w, gamma_lower_bound(prepare(A, B, C), w, grid, sigma)[1])
    points = np.array([row[Figure.BANDWIDTH], row[Figure.PEAK_FREQUENCY], omega_low])
    A_, B_, C_, w_, slopes, gains, gaps, fA, fB, fC, ok = figure_gradients(
        A, B, C, w, gp, H0, first_order_weights(w), backoff, row[Figure.GAMMA_OPT], limited, at,
        points,
    )  # fmt: skip
    if not ok:
        if channels:  # rounding put the blocks' γ_opt below the whole plant's: begin from that
            return design_with_gradients(
                A, B, C, w, grid, sigma, backoff, omega_low, guess, dA, dB, dC
            )
        return row, Ak, Bk, Ck, out, fixed, gaps
    out[:, :count] = _contract(A_, dA) + _contract(B_, dB) + _contract(C_, dC)
    out[:, count:] = w_
    held = _contract(fA[:1], dA) + _contract(fB[:1], dB) + _contract(fC[:1], dC)
    # ω_b by the implicit function theorem; the peak's own frequency drops out (envelope)
    fixed[:] = -held[0] / slopes[0]
    out[0] /= -slopes[0]
    out[1] /= gains[1]
    out[2] /= gains[2]
    return row, Ak, Bk, Ck, out, fixed, gaps


def _contract(cotangent, change):
    """Σ_ij cotangent[k, i, j] change[θ, i, j], an array (k, θ)."""
    return cotangent.reshape(len(cotangent), -1) @ change.reshape(len(change), -1).T
