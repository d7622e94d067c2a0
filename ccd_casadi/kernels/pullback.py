"""Gradients of the generalized plant, and of the bound γ_jω, pulled back to plant and weights."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.generalized_plant import weight_magnitudes


@compiled
def to_plant_and_weights(A_, B1_, B2_, C1_, C2_, d1_, d2_, f, C, m):
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


@compiled
def filter_jacobian(w):
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


@compiled
def bound_gradient(A, B, C, w, ω):
    """Gradient of γ_jω at its maximising ω (envelope of the closed form)."""
    n, p = A.shape[0], C.shape[0]
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
