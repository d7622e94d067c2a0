"""The frequency at which the bound γ_jω is attained, to rounding, and what rounding leaves in it.

The value of a maximum is insensitive to where it is taken, its gradient is not: next to a zero of
damping ζ an error δ of the frequency shows in dγ_jω/dθ as δ/ζ². So the slope's root is sought.
"""

import numpy as np

from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gamma import BACKWARD
from ccd_casadi.kernels.generalized_plant import squared_weights

EPS = 2.0**-52
DEVIATIONS = 4.0  # standard deviations of the rounding that `bound_error` admits


def _least_direction(A, B, C, ω):
    """M = jω - A, M⁻¹B, and σ_p of G = C M⁻¹ B with its singular vectors u, v.

    With fewer inputs than outputs σ_p is 0, and so is v.
    """
    p, m = C.shape[0], B.shape[1]
    M = 1j * ω * np.eye(A.shape[0]) - A
    right = np.linalg.solve(M, B)
    U, s, Vh = np.linalg.svd(C @ right)
    if m < p:
        return M, right, 0.0, U[:, p - 1], np.zeros(m, complex)
    return M, right, s[p - 1], U[:, p - 1], Vh[p - 1].conj()


def bound_error(A, B, C, w, ω):
    """δγ_jω/γ_jω that rounding leaves in the bound attained at ω, through σ_p(G(jω)).

    δσ = l δT r, l = u* C (jω - T)⁻¹, r = (jω - T)⁻¹ B v, in coordinates of the Schur form T of A.
    Its own backward error is |δT| = BACKWARD |T|, spread evenly over the entries; the solves at ω
    leave eps |T_ij| in each, which is more where eigenvalues stand in an unlucky order. Next to a
    transmission zero of small damping σ is small and its error is not.
    """
    T, B, C = prepare(A, B, C)
    n = T.shape[0]
    M, right, σ, u, v = _least_direction(T, B, C, ω)
    if σ == 0.0:
        return 0.0  # fewer inputs than outputs, or none that acts: the bound is |W1|
    left = np.linalg.solve(M.T, u.conj() @ C)
    form = BACKWARD * np.linalg.norm(T) / n * np.linalg.norm(left) * np.linalg.norm(right @ v)
    squares = [np.abs(part) ** 2 for part in (left, M, right, v)]
    dσ = np.hypot(form, EPS * np.sqrt(np.linalg.multi_dot(squares)))
    W1, W2, W3 = squared_weights(w, ω)
    force = W2 / σ**2
    return DEVIATIONS * W1 / (W1 + force + W3) * force / (force + W3) * dσ / σ


def _bound_slope(A, B, C, w, ω):
    """dγ_jω²(ω)/dω of γ_jω² = |W1|² R/(|W1|² + R), R = |W2|²/σ² + |W3|², dσ = Re(u* dG v)."""
    M, right, σ, u, v = _least_direction(A, B, C, ω)
    if σ == 0.0:  # the bound is |W1|
        return squared_weight_rates(w, ω)[0]
    dG = -1j * (C @ np.linalg.solve(M, right))
    dσ = np.vdot(u, dG @ v).real
    W1, W2, W3 = squared_weights(w, ω)
    d1, d2, d3 = squared_weight_rates(w, ω)
    R = W2 / σ**2 + W3
    dR = d2 / σ**2 - 2.0 * W2 * dσ / σ**3 + d3
    return (R / (W1 + R)) ** 2 * d1 + (W1 / (W1 + R)) ** 2 * dR


def squared_weight_rates(w, ω):
    """d|W|²/dω of W1, W2, W3: (a ω² + b)/(c ω² + d) has the slope 2ω (a - c|W|²)/(c ω² + d)."""
    M_S, A_S, ω_S, c_K, ω_K, _, A_u, ω_T = w
    W1, W2, W3 = squared_weights(w, ω)
    return (
        2.0 * ω * (1.0 / M_S**2 - W1) / (ω**2 + (ω_S * A_S) ** 2),
        2.0 * ω * (c_K**2 - W2) / (ω**2 + (c_K * ω_K) ** 2),
        2.0 * ω * (1.0 - A_u**2 * W3) / ((A_u * ω) ** 2 + ω_T**2),
    )


def bound_peak(A, B, C, w, start):
    """The maximiser next to `start`; `start` itself where the slope has no root within 1 %."""
    return slope_root(lambda ω: _bound_slope(A, B, C, w, ω), start)


def slope_root(slope, start):
    """The root of a maximum's slope next to `start`, `start` itself where there is none near."""
    a, fa = start, slope(start)
    step = 1e-7 if fa > 0.0 else -1e-7
    b, fb = a, fa
    for _ in range(12):
        b = start * (1.0 + step)
        fb = slope(b)
        if fa * fb <= 0.0:
            break
        a, fa = b, fb
        step *= 3.0
    if not fa * fb < 0.0:
        return b if fb == 0.0 else start
    x = a
    for _ in range(80):
        # Illinois false position
        x = (a * fb - b * fa) / (fb - fa)
        fx = slope(x)
        if fx == 0.0 or abs(b - a) <= 1e-15 * abs(b):
            break
        if fx * fb < 0.0:
            a, fa = b, fb
        else:
            fa *= 0.5
        moved = abs(x - b)
        b, fb = x, fx
        if moved <= 1e-16 * abs(x):
            break
    return x
