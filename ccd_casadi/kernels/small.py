"""Complex matrices of a few rows, one a frequency, where a LAPACK call costs more than the work."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled


@compiled
def multiply(A, B):
    """A B."""
    n, m, count = A.shape[0], B.shape[1], A.shape[1]
    out = np.zeros((n, m), np.complex128)
    for i in range(n):
        for k in range(count):
            factor = A[i, k]
            for j in range(m):
                out[i, j] += factor * B[k, j]
    return out


@compiled
def add_real(Z, D):
    """Z + D of a complex and a real matrix."""
    out = Z.copy()
    for i in range(Z.shape[0]):
        for j in range(Z.shape[1]):
            out[i, j] += D[i, j]
    return out


@compiled
def add_gram(Z, A, factor):
    """Z ← Z + factor AᴴA."""
    rows, n = A.shape
    for k in range(rows):
        for i in range(n):
            a = factor * A[k, i].conjugate()
            for j in range(n):
                Z[i, j] += a * A[k, j]


@compiled
def invert(A):
    """A⁻¹ by Gauss-Jordan elimination with row exchanges; infinite where A is singular."""
    n = A.shape[0]
    M, X = A.copy(), np.zeros((n, n), np.complex128)
    for i in range(n):
        X[i, i] = 1.0
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(M[i, k]) > abs(M[best, k]):
                best = i
        if M[best, k] == 0.0:
            for i in range(n):
                for j in range(n):
                    X[i, j] = np.inf
            return X
        if best != k:
            for j in range(n):
                M[k, j], M[best, j] = M[best, j], M[k, j]
                X[k, j], X[best, j] = X[best, j], X[k, j]
        pivot = 1.0 / M[k, k]
        for j in range(n):
            M[k, j] *= pivot
            X[k, j] *= pivot
        for i in range(n):
            factor = M[i, k]
            if i != k and factor != 0.0:
                for j in range(n):
                    M[i, j] -= factor * M[k, j]
                    X[i, j] -= factor * X[k, j]
    return X


@compiled
def largest_eigenvalue(Z):
    """The largest eigenvalue of a Hermitian matrix, by Jacobi rotations; Z is overwritten."""
    n = Z.shape[0]
    for _ in range(30):
        off, size = 0.0, 0.0
        for i in range(n):
            size += Z[i, i].real ** 2
            for j in range(i):
                off += Z[i, j].real ** 2 + Z[i, j].imag ** 2
        # the diagonal's error is second order in what is left beside it
        if not off > 1e-18 * size:
            break
        for i in range(n - 1):
            for j in range(i + 1, n):
                h = abs(Z[i, j])
                if h == 0.0:
                    continue
                phase = Z[i, j] / h
                ratio = (Z[j, j].real - Z[i, i].real) / (2.0 * h)
                t = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c * phase
                for k in range(n):
                    a, b = Z[k, i], Z[k, j]
                    Z[k, i], Z[k, j] = c * a - s.conjugate() * b, s * a + c * b
                for k in range(n):
                    a, b = Z[i, k], Z[j, k]
                    Z[i, k], Z[j, k] = c * a - s * b, s.conjugate() * a + c * b
    best = Z[0, 0].real
    for i in range(1, n):
        best = max(best, Z[i, i].real)
    return best
