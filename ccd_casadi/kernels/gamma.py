"""γ_opt of the one-Riccati mixed-sensitivity problem, γ_opt = max(γ_X, γ_jω).

With D21 = I and a stable plant the filter Riccati equation is solved by Y = 0, so a level γ
is achievable iff the Hamiltonian, with t = γ² - d1²,

    H(t) = H0 + [B1; -S][Sᵀ B1ᵀ]/t,   S = C1ᵀ D11,

has no eigenvalue on the imaginary axis (γ > γ_jω) and its stabilising X is positive
semidefinite (γ > γ_X). f(t) = λ_min(X⁻¹) is concave and increasing in t: Newton's method
lands at most once on the far side of the root and then converges monotonically.
"""

import numpy as np
from numba import njit

from ccd_casadi.kernels.generalized_plant import weight_magnitudes
from ccd_casadi.kernels.lapack import lyapunov_triangular, stable_subspace


@njit(cache=True)
def lqr_hamiltonian(A, B2, C1, d2, p, m):
    """H0 = [[Ã, -B2 B2ᵀ/d2²], [-Q̃, -Ãᵀ]], the Hamiltonian at γ = ∞ (2N x 2N)."""
    N = A.shape[0]
    S2 = d2 * C1[p : p + m, :]
    At = A - B2 @ S2 / d2**2
    H = np.empty((2 * N, 2 * N))
    H[:N, :N] = At
    H[N:, N:] = -At.T
    H[:N, N:] = -(B2 @ B2.T) / d2**2
    H[N:, :N] = S2.T @ S2 / d2**2 - C1.T @ C1
    return H


@njit(cache=True)
def level_hamiltonian(H0, B1, C1, d1, t):
    """H(t) = H0 + [B1; -S][Sᵀ B1ᵀ]/t."""
    N, p = B1.shape
    S = d1 * C1[:p, :]
    H = H0.copy()
    H[:N, :N] += B1 @ S / t
    H[:N, N:] += B1 @ B1.T / t
    H[N:, :N] -= S.T @ S / t
    H[N:, N:] -= S.T @ B1.T / t
    return H


@njit(cache=True)
def riccati_level(H0, B1, C1, d1, t):
    """f = λ_min(X⁻¹) and f' = df/dt from one ordered Schur form; ok False on the jω axis.

    With U1 = P c Qᵀ, q and p the singular vectors of one singular value, λ(X) = s/c,
    s = pᵀ U2 q, and f' = -qᵀ Z q/s² where T11ᵀ Z + Z T11 = -[U2ᵀ -U1ᵀ] H'(t) [U1; U2].
    No inverse of U1, so the formula holds at γ_opt itself, where X is infinite.
    """
    N, p = B1.shape
    T11, U1, U2, _, ok = stable_subspace(level_hamiltonian(H0, B1, C1, d1, t))
    if not ok:
        return -np.inf, 0.0, T11, U1, U2, np.zeros(N), np.zeros(N), False
    P, c, Qt = np.linalg.svd(U1)
    f, s_best, index = np.inf, 1.0, N - 1
    for i in range(N):
        s = np.dot(np.ascontiguousarray(P[:, i]), U2 @ np.ascontiguousarray(Qt[i, :]))
        # |s| = |λ|/√(1+λ²): an (almost) unobservable state has λ(X) = 0 of either sign.
        if abs(s) > 1e-7 and c[i] / s < f:
            f, s_best, index = c[i] / s, s, i
    q = np.ascontiguousarray(Qt[index, :])
    left = np.ascontiguousarray(P[:, index])
    # V = [Sᵀ B1ᵀ][U1; U2]: then -[U2ᵀ -U1ᵀ] H' [U1; U2] = Vᵀ V/t².
    V = d1 * (C1[:p, :] @ U1) + B1.T @ U2
    Z = lyapunov_triangular(T11, V.T @ V / t**2, True)
    slope = -np.dot(q, Z @ q) / s_best**2
    return f, slope, T11, U1, U2, q, left, True


@njit(cache=True)
def lower_bound_squared(w, sigma, ω):
    """γ_jω²(ω) = |W1|² R/(|W1|² + R), R = |W2|²/σ² + |W3|²: no controller does better at ω."""
    W1, W2, W3 = weight_magnitudes(w, ω)
    if sigma == 0.0:
        return W1**2
    R = (W2 / sigma) ** 2 + W3**2
    return W1**2 * R / (W1**2 + R)


@njit(cache=True)
def plant_gain(A, B, C, ω):
    """σ_p(G(jω)), the least gain over output directions (0 where m < p)."""
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    if m < p:
        return 0.0
    M = (1j * ω) * np.eye(n) - A
    G = C.astype(np.complex128) @ np.linalg.solve(M, B.astype(np.complex128))
    if m == 1:
        return abs(G[0, 0])
    return np.linalg.svd(G)[1][p - 1]


@njit(cache=True)
def gamma_lower_bound(A, B, C, w, grid, sigma):
    """γ_jω = max over ω, from σ_p(G) on a grid and a golden-section search at its best peaks."""
    n = grid.size
    values = np.empty(n)
    for i in range(n):
        values[i] = lower_bound_squared(w, sigma[i], grid[i])
    best, at = values[0], grid[0]
    for i in range(n):
        if values[i] > best:
            best, at = values[i], grid[i]
    top = best
    for i in range(1, n - 1):
        # A peak within 5 % may still overtake the best grid value when it is refined.
        if values[i] >= values[i - 1] and values[i] > values[i + 1] and values[i] > 0.95 * top:
            x, value = _golden(A, B, C, w, np.log(grid[i - 1]), np.log(grid[i + 1]))
            if value > best:
                best, at = value, np.exp(x)
    return np.sqrt(best), at


@njit(cache=True)
def _golden(A, B, C, w, low, high):
    r = 0.5 * (np.sqrt(5.0) - 1.0)
    x1, x2 = high - r * (high - low), low + r * (high - low)
    f1 = lower_bound_squared(w, plant_gain(A, B, C, np.exp(x1)), np.exp(x1))
    f2 = lower_bound_squared(w, plant_gain(A, B, C, np.exp(x2)), np.exp(x2))
    for _ in range(40):
        if f1 > f2:
            high, x2, f2 = x2, x1, f1
            x1 = high - r * (high - low)
            f1 = lower_bound_squared(w, plant_gain(A, B, C, np.exp(x1)), np.exp(x1))
        else:
            low, x1, f1 = x1, x2, f2
            x2 = low + r * (high - low)
            f2 = lower_bound_squared(w, plant_gain(A, B, C, np.exp(x2)), np.exp(x2))
        if high - low < 1e-9:
            break
    return (x1, f1) if f1 > f2 else (x2, f2)


@njit(cache=True)
def optimal_gamma(H0, B1, C1, d1, gamma_jw, guess, tolerance):
    """γ_opt = max(γ_X, γ_jω) by safeguarded Newton steps on f; at most 60 Schur forms.

    `guess` starts the iteration (0: none). Returns γ_opt, whether γ_jω limits, the number of
    Schur forms, and whether the bracket closed to the relative `tolerance` in γ.
    """
    # γ_jω itself puts eigenvalues on the axis: the test is made a hair above it.
    t_jw = max(gamma_jw**2 * (1 + 1e-7) - d1**2, 1e-12 * d1**2)
    t_low, t_high = t_jw, np.inf
    start = guess if guess > gamma_jw else 1.3 * gamma_jw
    t = max(start**2 - d1**2, 1.0001 * t_jw)
    tested = False
    evaluations = 0
    for _ in range(60):
        f, slope, _, _, _, _, _, ok = riccati_level(H0, B1, C1, d1, t)
        evaluations += 1
        newton = ok and slope > 0.0
        new = t - f / slope if newton else t
        if ok and f > 0.0:
            if t <= t_jw:
                return gamma_jw, True, evaluations, True
            t_high = min(t_high, t)
        else:
            t_low = max(t_low, t)
            tested = tested or t <= t_jw
        # relative in γ: dγ/γ = dt/(2 γ²)
        if newton and new > t_jw and abs(new - t) <= 2.0 * tolerance * (t + d1**2):
            return np.sqrt(new + d1**2), False, evaluations, True
        if t_high - t_low <= 2.0 * tolerance * (t_low + d1**2):
            return np.sqrt(t_high + d1**2), False, evaluations, True
        if newton and new <= t_jw and not tested:
            new = t_jw
        elif not (newton and t_low < new < t_high):
            new = 2.0 * t if t_high == np.inf else 0.5 * (t_low + t_high)
        t = new
    return np.sqrt(max(t, 0.0) + d1**2), False, evaluations, False
