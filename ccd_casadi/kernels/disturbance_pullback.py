"""Gradients of the four-block problem pulled back to A, B, C, the weight vector and δ.

The filter's solution Y stands in B1 = -YCᵀ. With Ȳ the gradient to it, one adjoint equation

    A_fᵀΛ + ΛA_f + Ȳ = 0,   A_f = A - YCᵀC,

gives ⟨Ȳ, dY⟩ = ⟨Λ, dA Y + Y dAᵀ + d(δ²BBᵀ) - Y d(CᵀC) Y⟩ for every parameter at once.
"""

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.kernels.generalized_plant import first_order_weights
from ccd_casadi.kernels.pullback import gain_to_weights, to_weights


class FourBlockPullback:
    """From `innovations_plant` back to A, B, C and (weights, δ) (9,); as `MixedPullback`."""

    def __init__(self, A, B, C, w, Y, delta):
        self.n, self.m, self.p = A.shape[0], B.shape[1], C.shape[0]
        self.A, self.B, self.C, self.w, self.Y, self.delta = A, B, C, w, Y, delta
        self.f = first_order_weights(w)
        self.filter = A - Y @ C.T @ C

    def to_plant_and_weights(self, of):
        """Gradients to A, B, C and (weights, δ), k in front of each."""
        n, m, p, f = self.n, self.m, self.p, self.f
        B, C, Y, delta = self.B, self.C, self.Y, self.delta
        B1_ = of.B1[:, :n]
        Y_ = -0.5 * (B1_ @ C + (B1_ @ C).swapaxes(1, 2))
        L = np.array([solve_continuous_lyapunov(self.filter.T, -part) for part in Y_])
        A_ = of.A[:, :n, :n] + 2.0 * L @ Y
        B_ = of.B2[:, :n] + 2.0 * delta**2 * L @ B
        C_ = (
            -f[0, 3] * of.C1[:, :p, :n] - f[0, 1] * of.A[:, n : n + p, :n] - of.C2[:, :, :n]
            - B1_.swapaxes(1, 2) @ Y - 2.0 * C @ Y @ L @ Y
        )  # fmt: skip
        C1_, C1_rate = self._turned_back(of.C1), self._turned_back(of.C1_rate)
        w_ = to_weights(of.A, of.A_rate, C1_, C1_rate, f, self.w, n, p, m)
        to_delta = 2.0 * delta * (B * (L @ B)).sum((1, 2))
        return A_, B_, C_, np.column_stack([w_, to_delta])

    def _turned_back(self, C1_):
        """Rows to [z1; z2; z3] from the turned outputs."""
        m, p, d2, d3 = self.m, self.p, self.f[1, 3], self.f[2, 3]
        d, along, across = np.hypot(d2, d3), C1_[:, p : p + m], C1_[:, p + m :]
        z2, z3 = (d2 * along - d3 * across) / d, (d3 * along + d2 * across) / d
        return np.concatenate([C1_[:, :p], z2, z3], axis=1)

    def gain_to_weights(self, h, x, costate, rate):
        """Gradient (k, 9) of -Re(hᵀ dF x) to (weights, δ) through d²F = -B2ᵀX - D12ᵀC1, X held.

        x, costate and ẋ of the controller's whole state. W3 as W2 in `pullback.gain_to_weights`,
        but W3(0) = 1/A_l, W3(∞) = 1/A_u, pole ω_T/A_u.
        """
        n, m, p, f = self.n, self.m, self.p, self.f
        of_W2, of_W3 = slice(n + p, n + p + m), slice(n + p + m, n + p + 2 * m)
        d2, (a, b, _, d3) = f[1, 3], f[2]
        size = d2**2 + d3**2
        w_ = np.zeros((len(h), 9))
        first = gain_to_weights(h, x[:, of_W2], costate[:, of_W2], rate[:, of_W2], f, self.w)
        w_[:, :8] = d2**2 / size * first
        pole = (h * costate[:, of_W3]).sum((1, 2)).real * b / size
        at_rest = d3 / self.w[5] * a / b * (h * x[:, of_W3]).sum((1, 2)).real / size
        direct = at_rest + 2.0 * d3**2 / b * (h * rate[:, of_W3]).sum((1, 2)).real / size
        w_[:, 5] -= at_rest / self.w[5]
        w_[:, 6] -= (pole + direct) / self.w[6]
        w_[:, 7] += pole / self.w[7]
        return w_
