"""Sections of a controller of fixed structure: parameters, their limits, and responses."""

from enum import IntEnum

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined

HALF_POWER = 0.5 * np.log(2.0)


class LoopCurve(IntEnum):
    """The bounded curve of a loop, and the row of its limit.

    Attributes
    ----------
    S_MAX, S_LOW, GS
        ‖S‖∞, |S| at ω_low and ‖GS‖∞.
    SHAPE
        |S| <= shape/√2 on the line through ω_i.
    KS, T
        Weighted: limits are the level over scale, of KS over the unit of force too.
    CROSSING, LEVEL
        |S| <= 1/√2 at ω_b, the end of the level; below ω_b, or below the line that ends there.
    """

    S_MAX = 0
    SHAPE = 1
    S_LOW = 2
    KS = 3
    T = 4
    GS = 5
    CROSSING = 6
    LEVEL = 7


class Limit(IntEnum):
    """The other rows of the limits.

    Attributes
    ----------
    LEAST, BANDWIDTH
        ω that the shape counts at least, and ω_i, over ω₀.
    KS_ZERO, KS_POLE, T_ZERO, T_POLE
        Roots of the weights over ω₀.
    OPENS
        1 where the room of the shape opens from ω_b on, else 0.
    COUNT
        The number of rows.
    """

    LEAST = 8
    KS_ZERO = 9
    KS_POLE = 10
    T_ZERO = 11
    T_POLE = 12
    BANDWIDTH = 13
    OPENS = 14
    COUNT = 15


@compiled
def warped(T, v):
    """ω of v and ∂ln ω/∂ln v, of a loop with period T (0: continuous)."""
    if T == 0.0:
        return v, 1.0
    ω = 2.0 / T * np.arctan(0.5 * T * v)
    return ω, v / ω / (1.0 + (0.5 * T * v) ** 2)


@compiled
def offset(curve, number, ω, chain, limits):
    """What is added to the logarithm of a gain, and its slope to ln v."""
    level = -limits[curve, number]
    opens = limits[Limit.OPENS, number] > 0.0
    if curve == LoopCurve.SHAPE or (opens and curve == LoopCurve.LEVEL):
        least = limits[Limit.LEAST, number]
        x = max(ω, least) / limits[Limit.BANDWIDTH, number]
        slope = 1.0 if ω >= least else 0.0
        if opens and curve == LoopCurve.SHAPE:
            shape = np.exp(limits[curve, number] + HALF_POWER)
            closed = (1.0 - 1.0 / shape) / max(x, 1.0) ** 2  # share of shape x that is not open yet
            level -= np.log(1.0 - closed)
            slope += 2.0 * closed / (1.0 - closed) if x >= 1.0 else 0.0
        return level - np.log(x), -slope * chain
    if curve == LoopCurve.KS or curve == LoopCurve.T:
        at = Limit.KS_ZERO if curve == LoopCurve.KS else Limit.T_ZERO
        a = ω * ω + limits[at, number] ** 2
        b = ω * ω + limits[at + 1, number] ** 2
        return level + 0.5 * np.log(a / b), (ω * ω / a - ω * ω / b) * chain
    return level, 0.0


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
