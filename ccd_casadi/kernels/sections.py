"""A controller of sections in each of its channels: K = V diag(K_i) Uᵀ, and the slopes of K_i.

    K_i(s) = k Π factor^±1,   factors 1 + ω/s (an integrator), 1 + s/ω, 1 + 2ζ s/ω + s²/ω²

The parameters of all channels stand one after the other in κ = ln(values), g = ∂ln K_i/∂κ.
"""

from ccd_casadi.kernels.compiled import compiled, inlined

GAIN, INTEGRATOR, REAL, PAIR = 0, 1, 2, 3


@inlined
def gains(factors, values, s, k):
    """Fills k (c,) = K_i(s); `factors` (f, 4): channel, kind, +1 above or -1 below, parameter."""
    for j in range(factors.shape[0]):
        i, kind, at = factors[j, 0], factors[j, 1], factors[j, 3]
        if kind == GAIN:
            k[i] = values[at]
            continue
        x = values[at] * inverse(s) if kind == INTEGRATOR else s * (1.0 / values[at])
        factor = 1.0 + x
        if kind == PAIR:
            factor += (2.0 * values[at + 1] - 1.0) * x + x * x
        k[i] = k[i] * factor if factors[j, 2] > 0 else k[i] * inverse(factor)


@compiled
def gains_and_slopes(factors, values, s, k, slope, g):
    """Fills k, slope (c,) = ∂ln K_i/∂ln s and g (n,) = ∂ln K_i/∂κ."""
    for j in range(factors.shape[0]):
        i, kind, sign, at = factors[j, 0], factors[j, 1], factors[j, 2], factors[j, 3]
        if kind == GAIN:
            k[i], slope[i], g[at] = values[at], 0.0, 1.0
            continue
        x = values[at] * inverse(s) if kind == INTEGRATOR else s * (1.0 / values[at])
        factor, first = 1.0 + x, x if kind == INTEGRATOR else -x
        if kind == PAIR:
            middle = 2.0 * values[at + 1] * x
            factor = 1.0 + middle + x * x
            first = -(middle + 2.0 * x * x)
        under = inverse(factor)
        if kind == PAIR:
            g[at + 1] = sign * middle * under
        k[i] = k[i] * factor if sign > 0 else k[i] * under
        g[at] = sign * first * under
        slope[i] -= g[at]


@inlined
def second_slopes(factors, g, out):
    """Fills out (n, n) = ∂²ln K_i/∂κ²; zero between parameters of different factors.

    ω and ζ enter a polynomial by ζ/ω and 1/ω²: its second derivatives are its first again.
    """
    for i in range(g.size):
        for j in range(g.size):
            out[i, j] = 0.0
    for j in range(factors.shape[0]):
        kind, sign, at = factors[j, 1], factors[j, 2], factors[j, 3]
        a = g[at]
        if kind == PAIR:
            b = g[at + 1]
            out[at, at] = -2.0 * a - b - sign * a * a
            out[at, at + 1] = out[at + 1, at] = -b - sign * a * b
            out[at + 1, at + 1] = b - sign * b * b
        elif kind != GAIN:
            out[at, at] = (a if kind == INTEGRATOR else -a) - sign * a * a


@compiled
def inverse(x):
    """1/x of a complex number, not finite where it is 0 (Numba's own division raises there)."""
    size = x.real * x.real + x.imag * x.imag
    return complex(x.real / size, -x.imag / size)
