"""A controller of fixed structure as a product of sections, and the bounds on its loop.

    K_i(s) = k Π F_j(s)^{±1},   F: 1 + ω/s,   1 + s/ω,   1 + 2ζ s/ω + (s/ω)²

with κ = (ln k, ln ω, ln ζ, ...). Frequencies are in units of ω₀. A constraint is c = ln(gain/bound)
<= 0 at a frequency: ln of the gain plus `offset`, whose rows of `limits` are below.
"""

from enum import IntEnum

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined

HALF_POWER = 0.5 * np.log(2.0)  # ln √2


class LoopCurve(IntEnum):
    """A bounded curve of a loop, and the row of `limits` with ln of its bound.

    Attributes
    ----------
    S_MAX, S_LOW, GS
        Peak of |S|, |S| at ω_low, and peak of |GS|.
    SHAPE
        |S| <= shape x/√2, x = ω/ω_i; the row is ln(shape/√2).
    KS, T
        |W_KS KS| and |W_T T| <= level; the row is ln of the level over the gain of the weight, of
        KS also over the unit of force.
    CROSSING, LEVEL
        |S| <= 1/√2 at ω_b, and at all ω below it; where the shape opens, LEVEL is |S| <= x/√2.
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
    """The other rows of `limits`: frequencies over ω₀, and how the shape begins.

    Attributes
    ----------
    LEAST
        The shape is constant below this frequency.
    BANDWIDTH
        ω_i, the bandwidth of this channel.
    KS_ZERO, KS_POLE, T_ZERO, T_POLE
        Of the weights (s + zero)/(s + pole).
    OPENS
        1 where the factor of x grows from 1 at ω_i to `shape`, 0 where it is `shape` throughout.
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


class GainOf(IntEnum):
    """The part of S that a channel's own gain is of, and where the loop is broken at one place
    alone.

    Attributes
    ----------
    ROW
        ‖uᵀS‖.
    SENSOR, ACTUATOR
        |uᵀS r|, and |wᵀ(I + KG)⁻¹w|.
    """

    ROW = 0
    SENSOR = 1
    ACTUATOR = 2


@compiled
def warp(T, v):
    """ω = (2/T) arctan(T v/2) and ∂ln ω/∂ln v of a loop with period T (0: continuous, ω = v).

    By Tustin's rule K at e^{jωT} is the continuous K at jv.
    """
    if T == 0.0:
        return v, 1.0
    ω = 2.0 / T * np.arctan(0.5 * T * v)
    return ω, v / ω / (1.0 + (0.5 * T * v) ** 2)


@compiled
def offset(curve, number, ω, chain, limits):
    """-ln of the bound on a curve at ω, and its slope to ln v; `chain`: ∂ln ω/∂ln v.

    The shape that opens: shape x (1 - closed)/√2, closed = (1 - 1/shape)/x² for x >= 1, which is
    1/√2 at ω_b and tends to shape x/√2. Weights: |W| = √((ω² + zero²)/(ω² + pole²)).
    """
    level = -limits[curve, number]
    opens = limits[Limit.OPENS, number] > 0.0
    if curve == LoopCurve.SHAPE or (opens and curve == LoopCurve.LEVEL):
        least = limits[Limit.LEAST, number]
        x = max(ω, least) / limits[Limit.BANDWIDTH, number]
        slope = 1.0 if ω >= least else 0.0
        if opens and curve == LoopCurve.SHAPE:
            shape = np.exp(limits[curve, number] + HALF_POWER)
            closed = (1.0 - 1.0 / shape) / max(x, 1.0) ** 2
            level -= np.log(1.0 - closed)
            slope += 2.0 * closed / (1.0 - closed) if x >= 1.0 else 0.0
        return level - np.log(x), -slope * chain
    if curve == LoopCurve.KS or curve == LoopCurve.T:
        row = Limit.KS_ZERO if curve == LoopCurve.KS else Limit.T_ZERO
        zero = ω * ω + limits[row, number] ** 2
        pole = ω * ω + limits[row + 1, number] ** 2
        return level + 0.5 * np.log(zero / pole), (ω * ω / zero - ω * ω / pole) * chain
    return level, 0.0


GAIN, INTEGRATOR, REAL, PAIR = 0, 1, 2, 3  # kinds of factors: k, 1 + ω/s, 1 + s/ω, the quadratic


@inlined
def gains(factors, values, s, k):
    """Fills k (c,) = K_i(s).

    `factors` (f, 4): channel i, kind, +1 in the numerator or -1 in the denominator, index of the
    parameter (of a PAIR that of ω, ζ follows). `values` (n,) = exp κ. A channel's gain is first.
    """
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
    """Fills k (c,) = K_i(s), slope (c,) = ∂ln K_i/∂ln s and g (n,) = ∂ln K_i/∂κ.

    ∂ln F^{±1}/∂κ = ±F'/F; as F depends on s/ω only, its slope to ln s is minus that to ln ω.
    """
    for j in range(factors.shape[0]):
        i, kind, sign, at = factors[j, 0], factors[j, 1], factors[j, 2], factors[j, 3]
        if kind == GAIN:
            k[i], slope[i], g[at] = values[at], 0.0, 1.0
            continue
        x = values[at] * inverse(s) if kind == INTEGRATOR else s * (1.0 / values[at])
        factor, to_ω = 1.0 + x, x if kind == INTEGRATOR else -x  # F and ∂F/∂ln ω
        if kind == PAIR:
            to_ζ = 2.0 * values[at + 1] * x  # ∂F/∂ln ζ
            factor = 1.0 + to_ζ + x * x
            to_ω = -(to_ζ + 2.0 * x * x)
        reciprocal = inverse(factor)
        if kind == PAIR:
            g[at + 1] = sign * to_ζ * reciprocal
        k[i] = k[i] * factor if sign > 0 else k[i] * reciprocal
        g[at] = sign * to_ω * reciprocal
        slope[i] -= g[at]


@inlined
def second_slopes(factors, g, out):
    """Fills out (n, n) = ∂²ln K_i/∂κ² from g = ∂ln K_i/∂κ; zero between different factors.

    ∂²ln F^{±1} = ±(F''/F - F'F'ᵀ/F²), and F'' are combinations of F' in ln ω and ln ζ:
    F_ωω = F_ω of 1 + ω/s, -F_ω of 1 + s/ω; of a PAIR F_ωω = -2F_ω - F_ζ, F_ωζ = -F_ζ, F_ζζ = F_ζ.
    """
    for i in range(g.size):
        for j in range(g.size):
            out[i, j] = 0.0
    for j in range(factors.shape[0]):
        kind, sign, at = factors[j, 1], factors[j, 2], factors[j, 3]
        to_ω = g[at]
        if kind == PAIR:
            to_ζ = g[at + 1]
            out[at, at] = -2.0 * to_ω - to_ζ - sign * to_ω * to_ω
            out[at, at + 1] = out[at + 1, at] = -to_ζ - sign * to_ω * to_ζ
            out[at + 1, at + 1] = to_ζ - sign * to_ζ * to_ζ
        elif kind != GAIN:
            out[at, at] = (to_ω if kind == INTEGRATOR else -to_ω) - sign * to_ω * to_ω


@compiled
def inverse(x):
    """1/x = x̄/|x|² of a complex number; not finite for x = 0, where Numba's division raises."""
    squared = x.real * x.real + x.imag * x.imag
    return complex(x.real / squared, -x.imag / squared)
