"""Total derivatives of a design's figures, the controller moving with the plant.

Each figure is a scalar of S = (I + GK)⁻¹ with K = C_K(s - A_K)⁻¹B_K, A_K = A + B2 F - B1 C2,
F = -(B2ᵀX + D12ᵀC1)/d2² and X the stabilising solution of

    AᵀX + XA + C1ᵀC1 + t VᵀV - d2² FᵀF = 0,   V = (B1ᵀX + Sᵀ)/t,   t = γ² - d1².

With X̄ the gradient to X, one adjoint Lyapunov equation A_c L + L A_cᵀ + X̄ = 0 with
A_c = A + B1 V + B2 F gives the gradient to every matrix at once, however many parameters there
are. γ_opt, where X is infinite, has the same equation in the basis [U1; U2] of the stable
subspace: only f = λ_min(X⁻¹) and its null vector q appear, T11 Λ + Λ T11ᵀ + qqᵀ = 0.
"""

import numpy as np
from numba import njit

from ccd_casadi.kernels.design import Code, Figure, design
from ccd_casadi.kernels.gamma import (
    gamma_lower_bound,
    level_hamiltonian,
    lqr_hamiltonian,
    riccati_level,
)
from ccd_casadi.kernels.generalized_plant import (
    first_order_weights,
    generalized_plant,
    weight_magnitudes,
)
from ccd_casadi.kernels.lapack import lyapunov_triangular, stable_subspace


@njit(cache=True)
def _row(v, M):
    """v M for a complex row and a real matrix."""
    return np.ascontiguousarray(v.real) @ M + 1j * (np.ascontiguousarray(v.imag) @ M)


@njit(cache=True)
def _column(M, v):
    """M v for a real matrix and a complex column."""
    return M @ np.ascontiguousarray(v.real) + 1j * (M @ np.ascontiguousarray(v.imag))


@njit(cache=True)
def _riccati_terms(XL, L, V, F, C1, d1, d2, p, m):
    """Gradients of tr(L E) to A, B1, B2, C1, d1, d2, and to t, E the Riccati's differential."""
    A_ = 2.0 * XL
    B1_ = 2.0 * XL @ V.T
    B2_ = 2.0 * XL @ F.T
    C1_ = 2.0 * C1 @ L
    LV, LF = L @ V.T, L @ F.T
    C1_[:p, :] += 2.0 * d1 * LV.T
    C1_[p : p + m, :] += 2.0 * d2 * LF.T
    d1_ = 2.0 * np.sum(C1[:p, :] * LV.T)
    d2_ = 2.0 * np.sum(C1[p : p + m, :] * LF.T) + 2.0 * d2 * np.sum(F * LF.T)
    t_ = -np.sum(V * LV.T)
    return A_, B1_, B2_, C1_, d1_, d2_, t_


@njit(cache=True)
def _to_plant_and_weights(A_, B1_, B2_, C1_, C2_, d1_, d2_, f, C, m):
    """Pull gradients of the generalized plant back to A, B, C and the 3 x 4 filter table."""
    p, n = C.shape
    i1, i2, i3 = n, n + p, n + p + m
    A = A_[:n, :n].copy()
    B = B2_[:n, :].copy()
    C_ = -C2_[:, :n].copy()
    C_ -= f[0, 3] * C1_[:p, :n]
    C_ += f[2, 3] * C1_[p + m :, :n]
    C_ -= f[0, 1] * A_[i1:i2, :n]
    C_ += f[2, 1] * A_[i3:, :n]
    F_ = np.zeros((3, 4))
    F_[0, 3] = d1_ - np.sum(C1_[:p, :n] * C)
    F_[2, 3] = np.sum(C1_[p + m :, :n] * C)
    F_[0, 1] = -np.sum(A_[i1:i2, :n] * C)
    F_[2, 1] = np.sum(A_[i3:, :n] * C)
    F_[1, 3] = d2_
    for i in range(p):
        F_[0, 0] -= A_[i1 + i, i1 + i]
        F_[0, 1] += B1_[i1 + i, i]
        F_[0, 2] += C1_[i, i1 + i]
        F_[2, 0] -= A_[i3 + i, i3 + i]
        F_[2, 2] += C1_[p + m + i, i3 + i]
    for i in range(m):
        F_[1, 0] -= A_[i2 + i, i2 + i]
        F_[1, 1] += B2_[i2 + i, i]
        F_[1, 2] += C1_[p + i, i2 + i]
    return A, B, C_, F_


@njit(cache=True)
def _filter_jacobian(w):
    """d(filter table)/dw, (3, 4, 8), by the complex step: exact to rounding."""
    J = np.zeros((3, 4, 8))
    h = 1e-30
    for k in range(8):
        z = w.astype(np.complex128)
        z[k] += 1j * h * w[k]
        M_S, A_S, ω_S, c_K, ω_K, A_l, A_u, ω_T = z
        a = np.array([ω_S * A_S, c_K * ω_K, ω_T / A_u])
        d = np.array([1.0 / M_S, c_K, 1.0 / A_u])
        r1, r2 = ω_S * (1.0 - A_S / M_S), c_K * ω_K * (1.0 - c_K)
        r = np.array([r1, r2, ω_T * (1 / A_l - 1 / A_u) / A_u])
        for i in range(3):
            sign = np.sign(r[i].real)
            root = np.sqrt(r[i] * sign)
            J[i, 0, k] = a[i].imag / (h * w[k])
            J[i, 1, k] = root.imag / (h * w[k])
            J[i, 2, k] = sign * root.imag / (h * w[k])
            J[i, 3, k] = d[i].imag / (h * w[k])
    return J


@njit(cache=True)
def gamma_gradient(A, B, C, w, gp, H0, f, gamma_opt, limited, bound_frequency):
    """Gradients of γ_opt to A, B, C, the filter table and directly to w; and ok."""
    Ag, B1, B2, C1, C2, d1, d2 = gp
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    if limited:
        A_, B_, C_, w_ = _bound_gradient(A, B, C, w, bound_frequency)
        return A_, B_, C_, np.zeros((3, 4)), w_, True
    t = gamma_opt**2 - d1**2
    _, _, T11, U1, U2, q, _, ok = riccati_level(H0, B1, C1, d1, t)
    Lq = lyapunov_triangular(T11, -np.outer(q, q), False)
    V = (B1.T @ U2 + d1 * (C1[:p, :] @ U1)) / t
    F = -(B2.T @ U2 + d2 * (C1[p : p + m, :] @ U1)) / d2**2
    # in the basis of U: X L -> U2 Λ U1ᵀ, L -> U1 Λ U1ᵀ, V -> V_u U1⁻¹
    UL = U1 @ Lq
    A_ = 2.0 * (U2 @ Lq) @ U1.T
    B1_ = 2.0 * (U2 @ Lq) @ V.T
    B2_ = 2.0 * (U2 @ Lq) @ F.T
    C1_ = 2.0 * C1 @ (UL @ U1.T)
    C1_[:p, :] += 2.0 * d1 * (UL @ V.T).T
    C1_[p : p + m, :] += 2.0 * d2 * (UL @ F.T).T
    d1_ = 2.0 * np.sum(C1[:p, :] * (UL @ V.T).T)
    d2_ = 2.0 * np.sum(C1[p : p + m, :] * (UL @ F.T).T) + 2.0 * d2 * np.sum(F * (F @ Lq))
    # t moves so that f stays zero: dt = <…>/tr(V Λ Vᵀ), and dt = 2 γ dγ - 2 d1 dd1
    scale = 1.0 / (np.sum(V * (V @ Lq)) * 2.0 * gamma_opt)
    d1_ = d1_ * scale + d1 / gamma_opt
    a, b, c, F_ = _to_plant_and_weights(
        A_ * scale, B1_ * scale, B2_ * scale, C1_ * scale, np.zeros_like(C2), d1_, d2_ * scale,
        f, C, m,
    )  # fmt: skip
    return a, b, c, F_, np.zeros(8), ok


@njit(cache=True)
def _bound_gradient(A, B, C, w, ω):
    """Gradient of γ_jω at its maximising ω (envelope of the closed form)."""
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    M = (1j * ω) * np.eye(n) - A
    right = np.linalg.solve(M, B.astype(np.complex128))
    left = np.linalg.solve(np.ascontiguousarray(M.T), C.T.astype(np.complex128)).T
    U, s, Vh = np.linalg.svd(C.astype(np.complex128) @ right)
    u = np.ascontiguousarray(U[:, p - 1].conj())
    v = np.ascontiguousarray(Vh[p - 1, :].conj())
    σ = s[p - 1]
    W1, W2, W3 = weight_magnitudes(w, ω)
    R = (W2 / σ) ** 2 + W3**2
    total = W1**2 + R
    gamma = np.sqrt(W1**2 * R / total)
    to_W1 = (R / total) ** 2 / (2.0 * gamma)  # dγ/d|W1|²
    to_R = (W1**2 / total) ** 2 / (2.0 * gamma)
    factor = to_R * (-2.0 * W2**2 / σ**3)
    ul, rv = u @ left, right @ v
    A_ = factor * np.outer(ul, rv).real
    B_ = factor * np.outer(ul, v).real
    C_ = factor * np.outer(u, rv).real
    w_ = np.empty(8)
    for k in range(8):
        h = 1e-6 * w[k]
        up, down = w.copy(), w.copy()
        up[k] += h
        down[k] -= h
        a, b = weight_magnitudes(up, ω), weight_magnitudes(down, ω)
        w_[k] = (
            to_W1 * (a[0] ** 2 - b[0] ** 2)
            + to_R * ((a[1] ** 2 - b[1] ** 2) / σ**2 + a[2] ** 2 - b[2] ** 2)
        ) / (2.0 * h)
    return A_, B_, C_, w_


@njit(cache=True)
def _gain_cotangents(A, B, C, Ak, Bk, Ck, ω):
    """Vectors of dσ = -Re(a(dG K + G dK)b) at ω, and dσ/dω, σ, the relative gap to σ_2."""
    n, N, p, m = A.shape[0], Ak.shape[0], C.shape[0], B.shape[1]
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
    return a, b, Kb, aG, lG, rG, lK, rK, slope, s[0], gap


@njit(cache=True)
def figure_gradients(A, B, C, w, gp, H0, f, backoff, gamma_opt, limited, bound_frequency, points):
    """Gradients of σ_max(S(jω)) at each ω of `points`, then of γ_opt, to A, B, C and w.

    Returns A_ (k+1, n, n), B_, C_, w_ (k+1, 8), the slopes dσ/dω (k), σ (k), the relative
    gaps (σ1 - σ2)/σ1 (k), the same gradients with K held fixed (the paper's, to A, B, C only),
    and ok. Fixed-K gradients do not depend on w.
    """
    Ag, B1, B2, C1, C2, d1, d2 = gp
    n, m, p, N = A.shape[0], B.shape[1], C.shape[0], Ag.shape[0]
    k = points.size
    A_, B_, C_ = np.zeros((k + 1, n, n)), np.zeros((k + 1, n, m)), np.zeros((k + 1, p, n))
    w_ = np.zeros((k + 1, 8))
    fixed_A, fixed_B, fixed_C = np.zeros((k, n, n)), np.zeros((k, n, m)), np.zeros((k, p, n))
    slopes, gains, gaps = np.zeros(k), np.zeros(k), np.zeros(k)
    J = _filter_jacobian(w)
    ga, gb, gc, gF, gw, ok = gamma_gradient(
        A, B, C, w, gp, H0, f, gamma_opt, limited, bound_frequency
    )
    for j in range(8):
        gw[j] += np.sum(gF * J[:, :, j])
    A_[k], B_[k], C_[k], w_[k] = ga, gb, gc, gw
    gamma = backoff * gamma_opt
    t = gamma**2 - d1**2
    T11, U1, U2, _, split = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    ok = ok and split
    inverse = np.linalg.inv(U1)
    X = U2 @ inverse
    X = 0.5 * (X + X.T)
    F = -(B2.T @ X + d2 * C1[p : p + m, :]) / d2**2
    V = (B1.T @ X + d1 * C1[:p, :]) / t
    Ak = Ag + B2 @ F - B1 @ C2
    for i in range(k):
        a, b, Kb, aG, lG, rG, lK, rK, slopes[i], gains[i], gaps[i] = _gain_cotangents(
            A, B, C, Ak, B1, F, points[i]
        )
        fixed_A[i] = -np.outer(lG, rG).real
        fixed_B[i] = -np.outer(lG, Kb).real
        fixed_C[i] = -np.outer(a, rG).real
        F_ = -np.outer(aG + _row(lK, B2), rK).real
        X_ = -(B2 @ F_) / d2**2
        X_ = 0.5 * (X_ + X_.T)
        Lh = lyapunov_triangular(T11, -(inverse @ X_) @ inverse.T, False)
        L = U1 @ Lh @ U1.T
        Ar, B1r, B2r, C1r, d1r, d2r, tr = _riccati_terms(X @ L, L, V, F, C1, d1, d2, p, m)
        Ar -= np.outer(lK, rK).real
        B1r -= np.outer(lK, b - _column(C2, rK)).real
        B2r -= np.outer(lK, _column(F, rK)).real + X @ F_.T / d2**2
        C2r = np.outer(_row(lK, B1), rK).real
        C1r[p : p + m, :] -= F_ / d2
        # d(d2) through F: -C12/d2² - 2F/d2
        d2r -= np.sum(F_ * (C1[p : p + m, :] / d2**2 + 2.0 * F / d2))
        d1r -= 2.0 * d1 * tr
        pa, pb, pc, F3 = _to_plant_and_weights(Ar, B1r, B2r, C1r, C2r, d1r, d2r, f, C, m)
        through = 2.0 * gamma * backoff * tr
        A_[i] = fixed_A[i] + pa + through * ga
        B_[i] = fixed_B[i] + pb + through * gb
        C_[i] = fixed_C[i] + pc + through * gc
        for j in range(8):
            w_[i, j] = np.sum(F3 * J[:, :, j]) + through * gw[j]
    return A_, B_, C_, w_, slopes, gains, gaps, fixed_A, fixed_B, fixed_C, ok


@njit(cache=True)
def design_with_gradients(
    A, B, C, w, grid, sigma, backoff, omega_low, guess, dA, dB, dC
):  # fmt: skip
    """A design, and the gradients of (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt).

    Returns the row, A_K, B_K, C_K, G (4, n_θ + 8): derivatives to θ then to the scaled weight
    vector; fixed (n_θ): the paper's dω_b/dθ with K held; gaps (3) of σ_max at the frequencies.
    The gradients are NaN where the design is not certified.
    """
    row, Ak, Bk, Ck = design(A, B, C, w, grid, sigma, backoff, omega_low, guess)
    count = dA.shape[0]
    out, fixed, gaps = np.full((4, count + 8), np.nan), np.full(count, np.nan), np.full(3, np.nan)
    if row[Figure.CODE] != Code.CERTIFIED.value:
        return row, Ak, Bk, Ck, out, fixed, gaps
    gp = generalized_plant(A, B, C, w)
    p, m = C.shape[0], B.shape[1]
    H0 = lqr_hamiltonian(gp[0], gp[2], gp[3], gp[6], p, m)
    limited = row[Figure.LIMITED_BY_BOUND] > 0.5
    at = gamma_lower_bound(A, B, C, w, grid, sigma)[1] if limited else 0.0
    points = np.array([row[Figure.BANDWIDTH], row[Figure.PEAK_FREQUENCY], omega_low])
    A_, B_, C_, w_, slopes, gains, gaps, fA, fB, fC, ok = figure_gradients(
        A, B, C, w, gp, H0, first_order_weights(w), backoff, row[Figure.GAMMA_OPT], limited, at,
        points,
    )  # fmt: skip
    if not ok:
        return row, Ak, Bk, Ck, out, fixed, gaps
    for i in range(4):
        for k in range(count):
            out[i, k] = np.sum(A_[i] * dA[k]) + np.sum(B_[i] * dB[k]) + np.sum(C_[i] * dC[k])
        out[i, count:] = w_[i]
    for k in range(count):
        total = np.sum(fA[0] * dA[k]) + np.sum(fB[0] * dB[k]) + np.sum(fC[0] * dC[k])
        fixed[k] = -total / slopes[0]
    # ω_b by the implicit function theorem; the peak's own frequency drops out (envelope)
    out[0] /= -slopes[0]
    out[1] /= gains[1]
    out[2] /= gains[2]
    return row, Ak, Bk, Ck, out, fixed, gaps
