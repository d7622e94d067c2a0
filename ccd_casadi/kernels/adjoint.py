"""Adjoints: gradients with respect to the matrices of the generalized plant, pulled back to plant
and weights."""

from typing import NamedTuple

import numpy as np
import scipy
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.kernels.generalized_plant import first_order_weights, squared_weights
from ccd_casadi.support.arrays import Array


class PlantGradients(NamedTuple):
    """Gradients (k, ...) to the generalized plant's matrices; `rate`: the sums with ẋ for x."""

    A: Array
    A_rate: Array
    B1: Array
    B2: Array
    C1: Array
    C1_rate: Array
    C2: Array


class MixedPullback:
    """The pull-back from [W1 S; W2 KS; W3 T] to A, B, C and the weight vector (8,)."""

    def __init__(self, A, B, C, w):
        self.n, self.m, self.p = A.shape[0], B.shape[1], C.shape[0]
        self.A, self.B, self.C, self.w, self.f = A, B, C, w, first_order_weights(w)

    def to_plant_and_weights(self, of):
        """Gradients to A, B, C and the weights, k in front of each."""
        n = self.n
        w_ = self._to_weights(of.A, of.A_rate, of.C1, of.C1_rate)
        return of.A[:, :n, :n], of.B2[:, :n], self._of_y(of) + self._of_e(of), w_

    def _of_y(self, of):
        """The gradient to C through W3 y."""
        n, first, f = self.n, self.p + self.m, self.f
        return f[2, 3] * of.C1[:, first:, :n] + f[2, 1] * of.A[:, n + first :, :n]

    def _of_e(self, of):
        """The gradient to C through e = r - y."""
        n, p, f = self.n, self.p, self.f
        return -f[0, 3] * of.C1[:, :p, :n] - f[0, 1] * of.A[:, n : n + p, :n] - of.C2[:, :, :n]

    def _to_weights(self, A_, A_rate, C1_, C1_rate):
        """Pull gradients p xᵀ, p ẋᵀ, z xᵀ, z ẋᵀ of costate and output back to the weight vector.

        Each (k, ...), the result (k, 8). In ẋ = -a x + b v, z = c x + d v a filter with W(0) = 1
        and W(∞) = d = 10⁴ has gradients to a, b, c and d of up to 10⁸ times their sum, which
        rounding then leaves nothing of. In units of x where b = a the same is ẋ = a (v - x),
        z = W(0) x + W(∞)(v - x), and v - x is ẋ/a, which the stable subspace gives without a
        difference.
        """
        n, w, f = self.n, self.w, self.f
        rate_S, rate_K, rate_T = self._traces(A_rate, n)
        direct_S, direct_K, direct_T = f[:, 3:] / f[:, 1:2] * self._traces(C1_rate, 0)
        static_S, _, static_T = self._traces(C1_, 0)
        # A_S moves the pole and W1(0) at once, and far above the pole these two would cancel
        leak = -f[0, 0] * (self._traces(A_, n)[0] + f[0, 3] / f[0, 1] * static_S)
        static_T = f[2, 0] / (w[5] * f[2, 1]) * static_T
        logarithmic = np.array(
            [
                -direct_S, leak, rate_S, rate_K + direct_K,
                rate_K, -static_T, -rate_T - direct_T, rate_T,
            ]
        )  # fmt: skip
        return logarithmic.T / w

    def _traces(self, M, first):
        """Traces of the blocks of W1, W2 and W3, which begin at (first, n), along the last axis."""
        diagonal = M[..., first:, self.n :].diagonal(0, -2, -1)
        return np.add.reduceat(diagonal, (0, self.p, self.p + self.m), axis=-1).T

    def gain_to_weights(self, h, x, costate, rate):
        """Gradient (k, 8) of -Re(hᵀ dF x) to the weights through d2² F = -B2ᵀX - D12ᵀC1, X held.

        Columns (k, N, 1) of the controller's whole state: x, `costate` X times it, `rate` ẋ. As in
        `_to_weights`, c x + d F stands as W(0) x + W(∞) ẋ/a.
        """
        (a, b, _, d), of_W2 = self.f[1], slice(self.n + self.p, self.n + self.p + self.m)
        through_pole = (h * costate[:, of_W2]).sum((1, 2)).real * b / d**2
        through_direct = (h * (2.0 * rate[:, of_W2] + a / d * x[:, of_W2])).sum((1, 2)).real / b
        w_ = np.zeros((len(h), 8))
        w_[:, 3] = (through_pole + through_direct) / self.w[3]
        w_[:, 4] = through_pole / self.w[4]
        return w_


class UnstablePullback(MixedPullback):
    """The pull-back from `unstable_plant` to A, B, C and the weight vector (8,).

    To the weights the plant is that of the states [x; ξ]. dY is that of `FourBlockPullback`, and
    dV = (I - VVᵀ) dY V (VᵀYV)⁻¹, as V stays a basis of the range of Y and turns in no other way.
    """

    def __init__(self, A, B, C, w, modes):
        super().__init__(A, B, C, w)
        self.V, self.Y = modes
        self.own, self.n = self.n, self.n + self.V.shape[1]
        self.filter = A - self.Y @ C.T @ C

    def to_plant_and_weights(self, of):
        """Gradients to A, B, C and the weights, k in front of each."""
        n, C, V, Y = self.own, self.C, self.V, self.Y
        copy = slice(n, self.n)
        of_y, of_e, into = self._of_y(of), self._of_e(of), V.T @ Y @ C.T
        B1_, to_copy, CV_ = of.B1[:, :n], of.A[:, copy, :n], of_y[:, :, copy]
        inner_, into_ = of.A[:, copy, copy], of.B1[:, copy] - to_copy @ C.T
        filter_ = V @ inner_ @ V.T
        V_ = self.filter.T @ V @ inner_ + C.T @ CV_
        V_ = (V_ - V @ (V.T @ V_)) @ np.linalg.inv(V.T @ Y @ V)
        Y_ = (V @ into_ - B1_ - filter_ @ C.T) @ C + V_ @ V.T
        Y_ = 0.5 * (Y_ + Y_.swapaxes(1, 2))
        L = np.array([solve_continuous_lyapunov(self.filter.T, -part) for part in Y_])
        C_ = (of_y + of_e)[:, :, :n] - into.T @ to_copy + CV_ @ V.T
        C_ += (V @ into_ - B1_ - filter_ @ C.T).swapaxes(1, 2) @ Y
        C_ -= C @ Y @ (filter_ + 2.0 * L @ Y)
        w_ = self._to_weights(of.A, of.A_rate, of.C1, of.C1_rate)
        return of.A[:, :n, :n] + filter_ + 2.0 * L @ Y, of.B2[:, :n], C_, w_


class FourBlockPullback(MixedPullback):
    """The pull-back from `innovations_plant` to A, B, C and (weights, δ) (9,)."""

    def __init__(self, A, B, C, w, Y, delta):
        super().__init__(A, B, C, w)
        self.Y, self.delta, self.filter = Y, delta, A - Y @ C.T @ C

    def to_plant_and_weights(self, of):
        """Gradients to A, B, C and (weights, δ), k in front of each."""
        n, B, C, Y, delta = self.n, self.B, self.C, self.Y, self.delta
        B1_ = of.B1[:, :n]
        Y_ = -0.5 * (B1_ @ C + (B1_ @ C).swapaxes(1, 2))
        L = np.array([solve_continuous_lyapunov(self.filter.T, -part) for part in Y_])
        A_ = of.A[:, :n, :n] + 2.0 * L @ Y
        B_ = of.B2[:, :n] + 2.0 * delta**2 * L @ B
        C_ = self._of_e(of) - B1_.swapaxes(1, 2) @ Y - 2.0 * C @ Y @ L @ Y
        C1_, C1_rate = self._turn_back(of.C1), self._turn_back(of.C1_rate)
        w_ = self._to_weights(of.A, of.A_rate, C1_, C1_rate)
        to_delta = 2.0 * delta * (B * (L @ B)).sum((1, 2))
        return A_, B_, C_, np.column_stack([w_, to_delta])

    def _turn_back(self, C1_):
        """Rows to [z1; z2; z3] from the turned outputs."""
        m, p, d2, d3 = self.m, self.p, self.f[1, 3], self.f[2, 3]
        d, along, across = np.hypot(d2, d3), C1_[:, p : p + m], C1_[:, p + m :]
        z2, z3 = (d2 * along - d3 * across) / d, (d3 * along + d2 * across) / d
        return np.concatenate([C1_[:, :p], z2, z3], axis=1)

    def gain_to_weights(self, h, x, costate, rate):
        """Gradient (k, 9) of -Re(hᵀ dF x) to (weights, δ) through d²F = -B2ᵀX - D12ᵀC1, X held.

        W3 as W2 of the mixed problem, but W3(0) = 1/A_l, W3(∞) = 1/A_u, pole ω_T/A_u.
        """
        n, m, p, f = self.n, self.m, self.p, self.f
        of_W3 = slice(n + p + m, n + p + 2 * m)
        d2, (a, b, _, d3) = f[1, 3], f[2]
        size = d2**2 + d3**2
        w_ = np.zeros((len(h), 9))
        w_[:, :8] = d2**2 / size * super().gain_to_weights(h, x, costate, rate)
        pole = (h * costate[:, of_W3]).sum((1, 2)).real * b / size
        at_rest = d3 / self.w[5] * a / b * (h * x[:, of_W3]).sum((1, 2)).real / size
        direct = at_rest + 2.0 * d3**2 / b * (h * rate[:, of_W3]).sum((1, 2)).real / size
        w_[:, 5] -= at_rest / self.w[5]
        w_[:, 6] -= (pole + direct) / self.w[6]
        w_[:, 7] += pole / self.w[7]
        return w_


def squared_weight_slopes(w, ω):
    """d|W|²/dw_k (8,): each entry of w belongs to one of W1, W2 and W3.

    Differences of nearly equal numbers are multiplied out: 1 - A_S²|W1|² and the like are ω²
    times something that does not cancel.
    """
    M_S, A_S, ω_S, c_K, ω_K, A_l, A_u, ω_T = w
    W1, W2, W3 = squared_weights(w, ω)
    b1, b2, b3 = ω**2 + (ω_S * A_S) ** 2, ω**2 + (c_K * ω_K) ** 2, (A_u * ω) ** 2 + ω_T**2
    return np.array(
        [
            -2.0 * ω**2 / (M_S**3 * b1),
            -2.0 * W1 * ω_S**2 * A_S / b1,
            2.0 * ω_S * (1.0 - (A_S / M_S) ** 2) * (ω / b1) ** 2,
            2.0 * W2 * ω**2 / (c_K * b2),
            2.0 * c_K**2 * (1.0 - c_K**2) * ω_K * (ω / b2) ** 2,
            -2.0 * ω_T**2 / (A_l**3 * b3),
            -2.0 * W3 * A_u * ω**2 / b3,
            2.0 * ω_T * ((A_u / A_l) ** 2 - 1.0) * (ω / b3) ** 2,
        ]
    )


ROUNDING = 4.0 * np.finfo(float).eps


class BoundTerms(NamedTuple):
    """γ_jω² at one frequency, and its partial derivatives to σ, |W1|², |W2|², |W3|² and δ."""

    value: float
    to_sigma: float
    to_W1: float
    to_W2: float
    to_W3: float
    to_delta: float


def bound_terms(W1, W2, W3, sigma, delta):
    """Compute the terms of the bound from squared weights; monotone in σ, so that the largest and
    the least count."""
    share = 1.0 if delta else sigma**2
    effort = W2 + share * W3
    size, total = 1.0 + (delta * sigma) ** 2, W1 * sigma**2 + effort
    to_effort = size * W1**2 * (sigma / total) * (sigma / total)
    to_sigma = -2.0 * sigma * W2 * (W1 / total) ** 2
    if delta:
        to_sigma = 2.0 * sigma * W1 * effort * (delta**2 * effort - W1) / total**2
    return BoundTerms(
        size * W1 * effort / total,
        to_sigma,
        size * (effort / total) ** 2,
        to_effort,
        share * to_effort,
        2.0 * delta * sigma**2 * W1 * effort / total,
    )


def direction(A, B, C, ω, least=True):
    """M = jω - A, M⁻¹B, and the least (largest) σ of G = C M⁻¹ B with its singular vectors u, v.

    With fewer inputs than outputs the least is 0, and so is v.
    """
    p, m = C.shape[0], B.shape[1]
    i = p - 1 if least else 0
    M = 1j * ω * np.eye(A.shape[0]) - A
    right = np.linalg.solve(M, B)
    U, s, Vh = np.linalg.svd(C @ right)
    if i >= m:
        return M, right, 0.0, U[:, i], np.zeros(m, complex)
    return M, right, s[i], U[:, i], Vh[i].conj()


def bound_slope(A, B, C, w, delta, ω, least=True):
    """dγ_jω²(ω)/dω, dσ = Re(u* dG v)."""
    M, right, σ, u, v = direction(A, B, C, ω, least)
    dσ = np.vdot(u, -1j * (C @ np.linalg.solve(M, right)) @ v).real
    terms = bound_terms(*squared_weights(w, ω), σ, delta)
    return terms.to_sigma * dσ + np.dot(terms[2:5], squared_weight_rates(w, ω))


def bound_gradient(A, B, C, w, delta, ω, least=True):
    """Gradients of γ_jω at its maximising ω (envelope) to A, B, C, the weight vector (8,) and δ."""
    M, right, σ, u, v = direction(A, B, C, ω, least)
    terms = bound_terms(*squared_weights(w, ω), σ, delta)
    scale = 0.5 / np.sqrt(terms.value)
    left, through = np.linalg.solve(M.T, u.conj() @ C), right @ v
    factor = scale * terms.to_sigma
    to_squares = scale * np.repeat(terms[2:5], [3, 2, 3])
    return (
        factor * np.outer(left, through).real,
        factor * np.outer(left, v).real,
        factor * np.outer(u.conj(), through).real,
        to_squares * squared_weight_slopes(w, ω),
        scale * terms.to_delta,
    )


def squared_weight_rates(w, ω):
    """d|W|²/dω of W1, W2, W3: (a ω² + b)/(c ω² + d) has the slope 2ω (a - c|W|²)/(c ω² + d)."""
    M_S, A_S, ω_S, c_K, ω_K, _, A_u, ω_T = w
    W1, W2, W3 = squared_weights(w, ω)
    return (
        2.0 * ω * (1.0 / M_S**2 - W1) / (ω**2 + (ω_S * A_S) ** 2),
        2.0 * ω * (c_K**2 - W2) / (ω**2 + (c_K * ω_K) ** 2),
        2.0 * ω * (1.0 - A_u**2 * W3) / ((A_u * ω) ** 2 + ω_T**2),
    )


def bound_peak(A, B, C, w, delta, start, least=True):
    """The maximiser next to `start`; `start` itself where the slope has no root within 1 %."""
    return slope_root(lambda ω: bound_slope(A, B, C, w, delta, ω, least), start)


def slope_root(slope, start):
    """The root of a maximum's slope next to `start`, `start` itself where there is none near."""
    a, fa = start, slope(start)
    if fa == 0.0:  # at rest
        return start
    step = 1e-7 if fa > 0.0 else -1e-7
    for _ in range(12):
        b = start * (1.0 + step)
        fb = slope(b)
        if fa * fb <= 0.0:
            return scipy.optimize.brentq(slope, a, b, xtol=1e-16 * start, rtol=ROUNDING)
        a, fa = b, fb
        step *= 3.0
    return start
