"""Frequency responses of state-space systems through their Hessenberg form, and their slopes."""

import numpy as np
from numba import njit

from ccd_casadi.kernels.lapack import hessenberg


@njit(cache=True)
def prepare(A, B, C):
    """(H, QᵀB, CQ) with A = Q H Qᵀ: each frequency then costs O(n²)."""
    H, Q = hessenberg(A)
    return H, np.ascontiguousarray(Q.T) @ B, C @ Q


@njit(cache=True)
def _eliminate(H, X, ω):
    """X ← (jωI - H)⁻¹ X by Gaussian elimination with row exchanges on a Hessenberg matrix."""
    n, m = X.shape
    M = np.empty((n, n), np.complex128)
    for i in range(n):
        for j in range(max(0, i - 1), n):
            M[i, j] = -H[i, j]
        M[i, i] += 1j * ω
    for k in range(n - 1):
        if abs(M[k + 1, k].real) + abs(M[k + 1, k].imag) > abs(M[k, k].real) + abs(M[k, k].imag):
            for j in range(k, n):
                M[k, j], M[k + 1, j] = M[k + 1, j], M[k, j]
            for j in range(m):
                X[k, j], X[k + 1, j] = X[k + 1, j], X[k, j]
        factor = M[k + 1, k] / M[k, k]
        if factor != 0.0:
            for j in range(k + 1, n):
                M[k + 1, j] -= factor * M[k, j]
            for j in range(m):
                X[k + 1, j] -= factor * X[k, j]
    for j in range(m):
        for i in range(n - 1, -1, -1):
            total = X[i, j]
            for k in range(i + 1, n):
                total -= M[i, k] * X[k, j]
            X[i, j] = total / M[i, i]


@njit(cache=True)
def response(system, ω):
    """C (jωI - A)⁻¹ B, complex (p, m), of a prepared system."""
    H, B, C = system
    X = B.astype(np.complex128)
    _eliminate(H, X, ω)
    return _apply(C, X)


@njit(cache=True)
def response_and_slope(system, ω):
    """The response and its derivative with respect to ω, -j C (jωI - A)⁻² B."""
    H, B, C = system
    X = B.astype(np.complex128)
    _eliminate(H, X, ω)
    value = _apply(C, X)
    _eliminate(H, X, ω)
    return value, -1j * _apply(C, X)


@njit(cache=True)
def _apply(C, X):
    p, n = C.shape
    m = X.shape[1]
    Y = np.zeros((p, m), np.complex128)
    for i in range(p):
        for j in range(m):
            for k in range(n):
                Y[i, j] += C[i, k] * X[k, j]
    return Y
