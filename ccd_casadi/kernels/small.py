"""Complex matrices of a few rows, one a frequency, where a LAPACK call costs more than the work."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined

ALIGNED = 1e-28  # square of the cosine between two columns below which they count as orthogonal


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
def singular(M, rows, columns, V, sigma, vectors):
    """M ← M V with orthogonal columns of the lengths σ, the longest first; V is unitary.

    M is the upper left of an array. One-sided Jacobi rotations (Hestenes): small σ come out as
    exactly as large ones. Without `vectors` V is left alone.
    """
    if vectors:
        for i in range(columns):
            for j in range(columns):
                V[i, j] = 1.0 if i == j else 0.0
    turned = columns > 1
    for _ in range(30):
        if not turned:
            break
        turned = False
        for i in range(columns - 1):
            for j in range(i + 1, columns):
                a, b, h = 0.0, 0.0, 0.0j
                for k in range(rows):
                    x, y = M[k, i], M[k, j]
                    a += x.real * x.real + x.imag * x.imag
                    b += y.real * y.real + y.imag * y.imag
                    h += x.conjugate() * y
                square = h.real * h.real + h.imag * h.imag
                if not square > ALIGNED * a * b:
                    continue
                turned = True
                size = np.sqrt(square)
                ratio = (b - a) / (2.0 * size)
                t = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c / size * h
                back = s.conjugate()
                for k in range(rows):
                    x, y = M[k, i], M[k, j]
                    M[k, i], M[k, j] = c * x - back * y, s * x + c * y
                if vectors:
                    for k in range(columns):
                        x, y = V[k, i], V[k, j]
                        V[k, i], V[k, j] = c * x - back * y, s * x + c * y
    for i in range(columns):
        length = 0.0
        for k in range(rows):
            length += M[k, i].real ** 2 + M[k, i].imag ** 2
        sigma[i] = np.sqrt(length)
    for i in range(columns - 1):
        best = i
        for j in range(i + 1, columns):
            if sigma[j] > sigma[best]:
                best = j
        if best != i:
            sigma[i], sigma[best] = sigma[best], sigma[i]
            for k in range(rows):
                M[k, i], M[k, best] = M[k, best], M[k, i]
            if vectors:
                for k in range(columns):
                    V[k, i], V[k, best] = V[k, best], V[k, i]


@compiled
def largest_singular(M):
    """σ_max of a matrix, which is overwritten."""
    sigma = np.empty(M.shape[1])
    singular(M, M.shape[0], M.shape[1], M, sigma, False)
    return sigma[0]


@inlined
def largest_gain(M, rows, columns):
    """Not below any singular value: the root of the largest row sum of |MᴴM|."""
    sums = np.zeros(columns)
    for i in range(columns):
        for j in range(i + 1):
            h = 0.0j
            for k in range(rows):
                h += M[k, i].conjugate() * M[k, j]
            size = np.sqrt(h.real * h.real + h.imag * h.imag)
            sums[i] += size
            if j < i:
                sums[j] += size
    return np.sqrt(sums.max())
