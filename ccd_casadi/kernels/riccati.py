"""The Riccati equation of the synthesis, in balanced coordinates where its own lose digits."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.generalized_plant import (
    add,
    frobenius,
    place,
    place_transposed,
    scale,
    symmetric_part,
    transpose,
)
from ccd_casadi.kernels.linear_algebra import lyapunov_triangular, solve, stable_subspace


@dataclass(frozen=True)
class RiccatiOptions:
    """Numbers of the Riccati level.

    Attributes
    ----------
    noise : float
        |λ(X)| below which its sign may be rounding: see `riccati_level`.
    """

    noise: float = 1e-7


@compiled
def lqr_hamiltonian(gp):
    """H0 = [[Ã, -B2 B2ᵀ/d2²], [-Q̃, -Ãᵀ]], the Hamiltonian at γ = ∞ (2N x 2N)."""
    A, _, B2, C1, C2, _, d2 = gp
    N, p, m = A.shape[0], C2.shape[0], B2.shape[1]
    S2 = np.empty((m, N))
    place(S2, 0, 0, d2, C1[p : p + m])
    BS, BB, SS, CC = B2 @ S2, B2 @ transpose(B2), transpose(S2) @ S2, transpose(C1) @ C1
    H = np.empty((2 * N, 2 * N))
    for i in range(N):
        for j in range(N):
            H[i, j] = A[i, j] - BS[i, j] / d2**2
            H[N + j, N + i] = -H[i, j]
            H[i, N + j] = -BB[i, j] / d2**2
            H[N + i, j] = SS[i, j] / d2**2 - CC[i, j]
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
def project(U1, U2):
    """Singular vectors P, Q and values c of U1, and s_i = p_iᵀ U2 q_i: λ(X) = s/c at a root."""
    P, c, Qt = np.linalg.svd(U1)
    Q = transpose(Qt)
    M = U2 @ Q
    s = np.zeros(c.size)
    for i in range(c.size):
        for j in range(c.size):
            s[i] += P[j, i] * M[j, i]
    return P, c, Q, s


@compiled
def riccati_level(H0, B1, C1, d1, t, noise):
    """f = λ_min(X⁻¹) and f' = df/dt from one ordered Schur form; ok False on the jω axis.

    With U1 = P c Qᵀ, q and p the singular vectors of one singular value, λ(X) = s/c,
    s = pᵀ U2 q, and f' = qᵀ Z q/(s t)² where T11ᵀ Z + Z T11 = -VᵀV, V = [Sᵀ B1ᵀ][U1; U2].
    No inverse of U1, so the formula holds at γ_opt itself, where X is infinite. Directions with
    |s| up to `noise` do not count: an (almost) unobservable state has λ(X) = 0 of either sign.
    Returns f, f', ok and (H(t), T11, U1, U2, V, Z, q, p, c), the frame at t.
    """
    N, p = B1.shape
    H = level_hamiltonian(H0, B1, C1, d1, t)
    T11, U1, U2, _, ok = stable_subspace(H)
    if not ok:
        return -np.inf, 0.0, False, (H, T11, U1, U2, U1, U1, np.zeros(N), np.zeros(N), 0.0)
    P, c, Q, s = project(U1, U2)
    f, s_best, index = np.inf, 1.0, N - 1
    for i in range(N):
        # |s| = |λ|/√(1+λ²)
        if abs(s[i]) > noise and c[i] / s[i] < f:
            f, s_best, index = c[i] / s[i], s[i], i
    q, left = Q[:, index].copy(), P[:, index].copy()
    V = transpose(B1) @ U2
    add(V, 0, 0, d1, C1[:p] @ U1)
    Z = lyapunov_triangular(T11, scale(-1.0, transpose(V) @ V), True)
    slope = np.dot(q, Z @ q) / (s_best * t) ** 2
    return f, slope, True, (H, T11, U1, U2, V, Z, q, left, c[index])


@inlined
def _singularity(U1, U2, Z, q, p):
    """g of [[U1 - U2 Z, p], [qᵀ, 0]][v; g] = [0; 1]: zero where U1 - U2 Z is singular.

    NaN where it is singular in a second direction too, or not finite.
    """
    N = U1.shape[0]
    M, right = np.zeros((N + 1, N + 1)), np.zeros((N + 1, 1))
    place(M, 0, 0, 1.0, U1)
    add(M, 0, 0, -1.0, U2 @ Z)
    for i in range(N):
        M[i, N], M[N, i] = p[i], q[i]
    right[N, 0] = 1.0
    solution, regular = solve(M, right)
    return solution[N, 0] if regular else np.nan


@inlined
def root_nearby(B1, C1, d1, frame, δ, noise):
    """Find where X is infinite, as a change of 1/t from the frame's, and an estimate of its error.

    The estimate is infinite where X is negative there in another direction: its root is higher.

    In the coordinates of [[U1, -U2], [U2, U1]] the stable subspace at 1/t + δ is [I; Z(δ)] with

        T11ᵀ Z + Z T11 = -δ (V + W Z)ᵀ(V + W Z) - Z G Z,   W = [Sᵀ B1ᵀ][-U2; U1].

    Z is taken to δ³, one triangular Lyapunov equation a term, and the root of the smooth scalar
    that vanishes with det(U1 - U2 Z) found by the secant method, from the estimate δ; NaN where
    that scalar cannot be had.
    """
    H, T11, U1, U2, V, Z1, q, p, c = frame
    N, outputs = B1.shape
    W = transpose(B1) @ U1
    add(W, 0, 0, -d1, C1[:outputs] @ U2)
    # G = [U1; U2]ᵀ H [-U2; U1]
    left, right = np.empty((N, 2 * N)), np.empty((2 * N, N))
    place_transposed(left, 0, 0, 1.0, U1)
    place_transposed(left, 0, N, 1.0, U2)
    place(right, 0, 0, -1.0, U2)
    place(right, N, 0, 1.0, U1)
    G, VW = left @ (H @ right), transpose(V) @ W
    WZ, GZ = W @ Z1, G @ Z1
    M = VW @ Z1
    add(M, 0, 0, 0.5, Z1 @ GZ)
    Z2 = lyapunov_triangular(T11, symmetric_part(M, -1.0), True)
    M = VW @ Z2
    add(M, 0, 0, 0.5, transpose(WZ) @ WZ)
    add(M, 0, 0, 1.0, Z2 @ GZ)
    Z3 = lyapunov_triangular(T11, symmetric_part(M, -1.0), True)
    δ0, g0 = 0.0, -c
    for _ in range(8):
        Z = np.zeros((N, N))
        add(Z, 0, 0, δ, Z1)
        add(Z, 0, 0, δ**2, Z2)
        add(Z, 0, 0, δ**3, Z3)
        g = _singularity(U1, U2, Z, q, p)
        if g == g0 or δ == δ0:
            break
        δ0, g0, δ = δ, g, δ - g * (δ - δ0) / (g - g0)
        if abs(δ - δ0) <= 1e-8 * abs(δ):  # the step after it would be 1e-8 times as small
            break
    Z = np.zeros((N, N))
    add(Z, 0, 0, δ, Z1)
    add(Z, 0, 0, δ**2, Z2)
    add(Z, 0, 0, δ**3, Z3)
    # U1ᵀU2 = U1ᵀX U1 at the root: as many negative eigenvalues as X, one zero
    if not np.isfinite(Z).all():
        return δ, np.inf
    top, low = U1.copy(), U2.copy()
    add(top, 0, 0, -1.0, U2 @ Z)
    add(low, 0, 0, 1.0, U1 @ Z)
    if np.linalg.eigvalsh(symmetric_part(transpose(top) @ low, 0.5))[0] < -noise:
        return δ, np.inf
    n1, n2, n3 = frobenius(Z1), frobenius(Z2), frobenius(Z3)
    first = abs(np.dot(q, Z1 @ q))
    ratio = abs(δ) * max(n3 / n2, n2 / n1)
    return δ, abs(δ) ** 3 * n3 / first * ratio if ratio < 0.5 else np.inf


def balancing(H):
    """τ (N,), powers of two that make the sum of a 2N x 2N Hamiltonian's entries smallest.

    No other power of any one of them makes it smaller; each sweep lowers the sum.
    """
    N = H.shape[0] // 2
    M = np.abs(H)
    for i in range(2 * N):
        M[i, i] = 0.0
    τ = np.ones(N)
    for _ in range(40):  # it settles in three to six
        settled = True
        for i in range(N):
            k = N + i
            # τ_i divides row i and column k, once more where they meet, and multiplies the others
            d2, u2 = M[i, k], M[k, i]
            d1, u1 = M[i].sum() + M[:, k].sum() - 2.0 * d2, M[:, i].sum() + M[k].sum() - 2.0 * u2
            if d1 + d2 == 0.0 or u1 + u2 == 0.0:
                continue
            f = 1.0
            while 0.5 * d1 / f + 0.75 * d2 / f**2 > u1 * f + 3.0 * u2 * f**2:  # 2f is better
                f *= 2.0
            while d1 / f + 3.0 * d2 / f**2 < 0.5 * u1 * f + 0.75 * u2 * f**2:
                f *= 0.5
            if f != 1.0:
                settled = False
                τ[i] *= f
                M[i] /= f
                M[:, k] /= f
                M[:, i] *= f
                M[k] *= f
        if settled:
            break
    return τ


def in_coordinates(gp, τ):
    """The generalized plant with states x̂ = x/τ."""
    rows = τ.reshape(-1, 1)
    return gp._replace(
        A=gp.A * (τ / rows), B1=gp.B1 / rows, B2=gp.B2 / rows, C1=gp.C1 * τ, C2=gp.C2 * τ
    )


def rounding_noise(H0):
    """Estimate what rounding alone makes of a projection that is zero: X(γ = ∞) is positive
    semidefinite.

    Four times the most negative one there, at least `RiccatiOptions.noise`.
    """
    _, U1, U2, _, ok = stable_subspace(H0)
    least = RiccatiOptions.noise
    return max(least, -4.0 * project(U1, U2)[3].min()) if ok else least
