"""The generalized plant of mixed sensitivity, put together from blocks; of an unstable plant, too.

A plant with poles in the open right half plane becomes one without them. With Y of
A Y + Y Aᵀ - Y CᵀC Y = 0 and A_f = A - Y CᵀC stable, N = I + C(s - A)⁻¹Y Cᵀ is all-pass,

    ‖[W1 S; W2 KS; W3 T]‖ = ‖[W1 S N; W2 KS N; W3 N⁻¹ T N]‖,   N⁻¹ = I - C(s - A_f)⁻¹Y Cᵀ

for weights that are scalars times I. On the right r becomes r' with r = N r': -Y Cᵀ in B1. On the
left N⁻¹ T N r' = (N⁻¹G) u, and N⁻¹G = C(s - A_f)⁻¹B is stable. It is y' = C x + C V ξ with

    ξ̇ = VᵀA_fV ξ + VᵀY Cᵀ e,   V (n, k) an orthonormal basis of the range of Y,

the invariant subspace of the k unstable poles. All outputs are then stable functions of e and u, so
that the filter equation of this plant is void: it has one Riccati equation, as a stable one.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import schur, solve_sylvester
from scipy.linalg.lapack import dtrsen

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.linear_algebra import lyapunov_triangular


@compiled
def place(M, row, column, factor, block):
    """M[row:, column:] ← factor · block, as far as the block goes."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + i, column + j] = factor * block[i, j]


@compiled
def place_transposed(M, row, column, factor, block):
    """M[row:, column:] ← factor · blockᵀ."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + j, column + i] = factor * block[i, j]


@compiled
def add(M, row, column, factor, block):
    """M[row:, column:] ← itself + factor · block."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + i, column + j] += factor * block[i, j]


@compiled
def transpose(M):
    """A copy of Mᵀ."""
    out = np.empty((M.shape[1], M.shape[0]))
    place_transposed(out, 0, 0, 1.0, M)
    return out


@inlined
def scale(factor, M):
    """Compute factor · M."""
    out = np.empty(M.shape)
    place(out, 0, 0, factor, M)
    return out


@compiled
def symmetric_part(M, factor):
    """factor · (M + Mᵀ)."""
    n = M.shape[0]
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = factor * (M[i, j] + M[j, i])
    return out


@compiled
def frobenius(M):
    """‖M‖, the root of the sum of squares."""
    total = 0.0
    for i in range(M.shape[0]):
        for j in range(M.shape[1]):
            total += M[i, j] ** 2
    return np.sqrt(total)


class MixedPlant(NamedTuple):
    """ẋ = A x + B1 w + B2 u, z = C1 x + [d1 w; 0; 0] + [0; d2 u; 0], e = C2 x + w."""

    A: Any
    B1: Any
    B2: Any
    C1: Any
    C2: Any
    d1: Any
    d2: Any


@compiled
def first_order_weights(w):
    """(a, b, c, d) of W1, W2 and W3 as ẋ = -a x + b v, z = c x + d v, rows of a 3 x 4 array.

    |b| = |c| so that neither the gain nor its inverse piles up on one side.
    """
    M_S, A_S, ω_S, c_K, ω_K, A_l, A_u, ω_T = w
    out = np.empty((3, 4))
    # W1 = 1/M_S + ω_S (1 - A_S/M_S)/(s + ω_S A_S)
    out[0, 0], out[0, 1], out[0, 3] = ω_S * A_S, ω_S * (1.0 - A_S / M_S), 1.0 / M_S
    # W2 = c_K + c_K ω_K (1 - c_K)/(s + c_K ω_K)
    out[1, 0], out[1, 1], out[1, 3] = c_K * ω_K, c_K * ω_K * (1.0 - c_K), c_K
    # W3 = 1/A_u + ω_T (1/A_l - 1/A_u)/A_u/(s + ω_T/A_u)
    out[2, 0], out[2, 1], out[2, 3] = ω_T / A_u, ω_T * (1 / A_l - 1 / A_u) / A_u, 1.0 / A_u
    for i in range(3):
        residue = out[i, 1]
        out[i, 1] = np.sqrt(abs(residue))
        out[i, 2] = np.copysign(np.sqrt(abs(residue)), residue)
    return out


def generalized_plant(A, B, C, w):
    """Make the generalized plant of mixed sensitivity, of order N = n + 2p + m.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        Scaled plant.
    w : array (8,)
        Scaled weights.

    Returns
    -------
    MixedPlant
    """
    return MixedPlant(*plant_matrices(A, B, C, w))


@compiled
def plant_matrices(A, B, C, w):
    """The entries of `generalized_plant`, a plain tuple: no kernel returns a named one to Python.

    Numba looks up its class in Python code, and where Ctrl-C raises there calls a null pointer.
    """
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    f = first_order_weights(w)
    N = n + 2 * p + m
    i1, i2, i3 = n, n + p, n + p + m
    Ag, B1, B2 = np.zeros((N, N)), np.zeros((N, p)), np.zeros((N, m))
    C1, C2 = np.zeros((2 * p + m, N)), np.zeros((p, N))
    place(Ag, 0, 0, 1.0, A)
    place(B2, 0, 0, 1.0, B)
    place(C2, 0, 0, -1.0, C)
    place(C1, 0, 0, -f[0, 3], C)
    place(C1, p + m, 0, f[2, 3], C)
    place(Ag, i1, 0, -f[0, 1], C)
    place(Ag, i3, 0, f[2, 1], C)
    for i in range(p):
        Ag[i1 + i, i1 + i] = -f[0, 0]
        B1[i1 + i, i] = f[0, 1]
        C1[i, i1 + i] = f[0, 2]
        Ag[i3 + i, i3 + i] = -f[2, 0]
        C1[p + m + i, i3 + i] = f[2, 2]
    for i in range(m):
        Ag[i2 + i, i2 + i] = -f[1, 0]
        B2[i2 + i, i] = f[1, 1]
        C1[p + i, i2 + i] = f[1, 2]
    return Ag, B1, B2, C1, C2, f[0, 3], f[1, 3]


@compiled
def squared_weights(w, ω):
    """|W1(jω)|², |W2(jω)|², |W3(jω)|² from their transfer functions, ω scaled."""
    M_S, A_S, ω_S, c_K, ω_K, A_l, A_u, ω_T = w
    return (
        ((ω / M_S) ** 2 + ω_S**2) / (ω**2 + (ω_S * A_S) ** 2),
        c_K**2 * (ω**2 + ω_K**2) / (ω**2 + (c_K * ω_K) ** 2),
        (ω**2 + (ω_T / A_l) ** 2) / ((A_u * ω) ** 2 + ω_T**2),
    )


class UnstableModes(NamedTuple):
    """V (n, k), and the stabilising solution Y (n, n) of the Bernoulli equation, of rank k."""

    V: np.ndarray
    Y: np.ndarray


def unstable_part(A, C):
    """Find the unstable part of a plant: A V = V A_u, and P of A_uᵀP + P A_u = (C V)ᵀC V.

    Y = V P⁻¹ Vᵀ; P is singular where C does not see one of the modes.

    Parameters
    ----------
    A, C : arrays (n, n), (p, n)
        Scaled plant.

    Returns
    -------
    V, P : arrays (n, k), (k, k)
    """
    T, V = schur(A)
    grow = np.diag(T) > 0.0  # of a pair both: LAPACK's blocks have equal diagonals
    k = int(grow.sum())
    if not k:
        return V[:, :0], np.zeros((0, 0))
    # Not by `schur(sort=...)`: its call-back into Python writes on stderr where Ctrl-C meets it.
    T, V = dtrsen(grow, T, V, job=b"N")[:2]
    V = V[:, :k]
    return V, lyapunov_triangular(np.ascontiguousarray(T[:k, :k]), (C @ V).T @ (C @ V), True)


def unstable_modes(A, C):
    """Find the modes of a plant that grow.

    Parameters
    ----------
    A, C : arrays (n, n), (p, n)
        Scaled plant.

    Returns
    -------
    UnstableModes or None
        None where there are none.
    """
    V, P = unstable_part(A, C)
    return UnstableModes(V, V @ np.linalg.inv(P) @ V.T) if len(P) else None


def unstable_plant(A, B, C, w, modes):
    """Make the generalized plant of the equivalent problem.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        Scaled plant.
    w : array (8,)
        Scaled weights.
    modes : UnstableModes

    Returns
    -------
    MixedPlant
        States [plant; ξ; W1; W2; W3], of order n + k + 2p + m.
    """
    V, Y = modes
    (n, k), p, m = V.shape, C.shape[0], B.shape[1]
    into, f = V.T @ Y @ C.T, first_order_weights(w)
    inner = V.T @ (A - Y @ C.T @ C) @ V
    gp = generalized_plant(
        np.block([[A, np.zeros((n, k))], [-into @ C, inner]]),
        np.vstack([B, np.zeros((k, m))]),
        np.hstack([C, np.zeros((p, k))]),
        w,
    )
    gp.B1[:n], gp.B1[n : n + k] = -Y @ C.T, into
    gp.A[n + k + p + m :, n : n + k] = f[2, 1] * C @ V
    gp.C1[p + m :, n : n + k] = f[2, 3] * C @ V
    return gp


def without_copies(Ak, Bk, Ck, modes):
    """The controller in n + 2p + m states: u does not show k of the poles, those of ξ.

    The central controller of the problem as it is stated has that order, and is the only one of
    least entropy, which all-pass factors do not change. In x - Z ξ, with A_K [Z; I] = [Z; I] A_ξ,
    the states ξ are not seen by u.
    """
    n, k = modes.V.shape
    copy = slice(n, n + k)
    rest = np.delete(np.arange(len(Ak)), copy)
    own = Ak[np.ix_(rest, rest)]
    Z = solve_sylvester(own, -Ak[copy, copy], -Ak[rest, copy])
    return own, Bk[rest] - Z @ Bk[copy], np.ascontiguousarray(Ck[:, rest])
