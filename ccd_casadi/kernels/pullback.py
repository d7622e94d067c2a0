"""Gradients of the generalized plant, and of the bound γ_jω, pulled back to plant and weights."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.generalized_plant import weight_magnitudes


@compiled
def to_plant(A_, B2_, C1_, C2_, f, C, m):
    """Pull gradients of the generalized plant back to A, B and C."""
    p, n = C.shape
    i1, i2, i3 = n, n + p, n + p + m
    C_ = -C2_[:, :n].copy()
    C_ -= f[0, 3] * C1_[:p, :n]
    C_ += f[2, 3] * C1_[p + m :, :n]
    C_ -= f[0, 1] * A_[i1:i2, :n]
    C_ += f[2, 1] * A_[i3:, :n]
    return A_[:n, :n].copy(), B2_[:n, :].copy(), C_


@compiled
def _trace(M, row, column, count):
    """The trace of a block of M."""
    total = 0.0
    for i in range(count):
        total += M[row + i, column + i]
    return total


@compiled
def to_weights(A_, A_rate, C1_, C1_rate, f, w, n, p, m):
    """Pull gradients p xᵀ, p ẋᵀ, z xᵀ, z ẋᵀ of costate and output back to the weight vector.

    In ẋ = -a x + b v, z = c x + d v a filter with W(0) = 1 and W(∞) = d = 10⁴ has gradients to
    a, b, c and d of up to 10⁸ times their sum, which rounding then leaves nothing of. In units of
    x where b = a the same is ẋ = a (v - x), z = W(0) x + W(∞)(v - x), and v - x is ẋ/a, which
    the stable subspace gives without a difference.
    """
    i1, i2, i3 = n, n + p, n + p + m
    rate_S, rate_K = _trace(A_rate, i1, i1, p), _trace(A_rate, i2, i2, m)
    rate_T = _trace(A_rate, i3, i3, p)
    direct_S = f[0, 3] / f[0, 1] * _trace(C1_rate, 0, i1, p)
    direct_K = f[1, 3] / f[1, 1] * _trace(C1_rate, p, i2, m)
    direct_T = f[2, 3] / f[2, 1] * _trace(C1_rate, p + m, i3, p)
    # A_S moves the pole and W1(0) at once, and far above the pole these two would cancel
    leak = -f[0, 0] * (_trace(A_, i1, i1, p) + f[0, 3] / f[0, 1] * _trace(C1_, 0, i1, p))
    static_T = f[2, 0] / (w[5] * f[2, 1]) * _trace(C1_, p + m, i3, p)
    logarithmic = np.array(
        [
            -direct_S, leak, rate_S, rate_K + direct_K,
            rate_K, -static_T, -rate_T - direct_T, rate_T,
        ]
    )  # fmt: skip
    return logarithmic / w


@compiled
def gain_to_weights(h, x, costate, rate, f, w):
    """Gradient of -Re(h dF x) to the weight vector through d2² F = -B2ᵀX - D12ᵀC1, X held.

    h is a row, x the states of W2, `costate` their entries of X times the whole state, `rate`
    ẋ. As in `to_weights`, c x + d F stands as W(0) x + W(∞) ẋ/a.
    """
    a, b, d = f[1, 0], f[1, 1], f[1, 3]
    through_pole = np.sum(h * costate).real * b / d**2
    through_direct = np.sum(h * (2.0 * rate + a / d * x)).real / b
    w_ = np.zeros(8)
    w_[3] = (through_pole + through_direct) / w[3]
    w_[4] = through_pole / w[4]
    return w_


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
