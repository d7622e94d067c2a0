"""The level f(t) = λ_min(X⁻¹) of the one-Riccati mixed-sensitivity problem, and its slope.

With D21 = I and a stable plant the filter Riccati equation is solved by Y = 0, so a level γ
is achievable iff the Hamiltonian, with t = γ² - d1²,

    H(t) = H0 + [B1; -S][Sᵀ B1ᵀ]/t,   S = C1ᵀ D11,

has no eigenvalue on the imaginary axis (γ > γ_jω) and its stabilising X is positive
semidefinite (γ > γ_X). f is concave and increasing in t.
"""

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.lapack import lyapunov_triangular, stable_subspace


@compiled
def lqr_hamiltonian(A, B2, C1, d2, p, m):
    """H0 = [[Ã, -B2 B2ᵀ/d2²], [-Q̃, -Ãᵀ]], the Hamiltonian at γ = ∞ (2N x 2N)."""
    N = A.shape[0]
    S2 = d2 * C1[p : p + m]
    B2t, S2t = np.ascontiguousarray(B2.T), np.ascontiguousarray(S2.T)
    At = A - B2 @ S2 / d2**2
    H = np.empty((2 * N, 2 * N))
    H[:N, :N] = At
    H[N:, N:] = -At.T
    H[:N, N:] = -(B2 @ B2t) / d2**2
    H[N:, :N] = S2t @ S2 / d2**2 - np.ascontiguousarray(C1.T) @ C1
    return H


@compiled
def level_hamiltonian(H0, B1, C1, d1, t):
    """H(t) = H0 + [B1; -S][Sᵀ B1ᵀ]/t."""
    N, p = B1.shape
    H = H0.copy()
    for k in range(p):
        for i in range(N):
            b, s = B1[i, k] / t, d1 * C1[k, i] / t
            if b != 0.0:
                for j in range(N):
                    H[i, j] += b * d1 * C1[k, j]
                    H[i, N + j] += b * B1[j, k]
            if s != 0.0:
                for j in range(N):
                    H[N + i, j] -= s * d1 * C1[k, j]
                    H[N + i, N + j] -= s * B1[j, k]
    return H


@compiled
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
    Q = np.ascontiguousarray(Qt.T)
    W = U2 @ Q
    f, s_best, index = np.inf, 1.0, N - 1
    for i in range(N):
        s = 0.0
        for j in range(N):
            s += P[j, i] * W[j, i]
        # |s| = |λ|/√(1+λ²): an (almost) unobservable state has λ(X) = 0 of either sign.
        if abs(s) > 1e-7 and c[i] / s < f:
            f, s_best, index = c[i] / s, s, i
    q, left = Q[:, index].copy(), P[:, index].copy()
    # V = [Sᵀ B1ᵀ][U1; U2]: then -[U2ᵀ -U1ᵀ] H' [U1; U2] = Vᵀ V/t².
    V = d1 * (C1[:p] @ U1) + np.ascontiguousarray(B1.T) @ U2
    Z = lyapunov_triangular(T11, V.T @ V / t**2, True)
    slope = -np.dot(q, Z @ q) / s_best**2
    return f, slope, T11, U1, U2, q, left, True
