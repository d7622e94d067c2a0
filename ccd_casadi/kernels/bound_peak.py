"""The bound γ_jω along one direction, and its gradient where it is attained.

    γ_jω² = (1 + δ²σ²)|W1|²E/(|W1|²σ² + E),   E = |W2|² + |W3|²σ²,  or |W2|² + |W3|² where δ > 0,

with the least singular value σ of G(jω), or with δ > 0 the largest too. The answer of u to a
reference in that direction, of the size that disturbance and reference have there together, costs
at least that.

The value of a maximum is insensitive to where it is taken, its gradient is not: next to a zero of
damping ζ an error δ of the frequency shows in dγ_jω/dθ as δ/ζ². So the slope's root is sought.
"""

from typing import NamedTuple

import numpy as np
import scipy

from ccd_casadi.kernels.generalized_plant import squared_weights
from ccd_casadi.kernels.pullback import squared_weight_slopes

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
    """Of squared weights; monotone in σ, so that the largest and the least count."""
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
    step = 1e-7 if fa > 0.0 else -1e-7
    for _ in range(12):
        b = start * (1.0 + step)
        fb = slope(b)
        if fa * fb <= 0.0:
            return scipy.optimize.brentq(slope, a, b, xtol=1e-16 * start, rtol=ROUNDING)
        a, fa = b, fb
        step *= 3.0
    return start
