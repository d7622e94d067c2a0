"""What the loop's matrices are held against, as what is added to the logarithm of a gain.

    c = ln σ + offset(ω),   a constraint c <= 0

    S_max   -ln S_max,   S_low   -ln S_low,   GS   -ln compliance_max
    level   ½ ln 2 - ln x for x < 1,  shape   ½ ln 2 - ln(shape x - (shape - 1)/x) for x > 1,
            with x = ω/ω_i,  ω_i = lead ω_b; where the shape ends at ω_b
            ½ ln 2  and  ½ ln 2 - ln(shape x),  both for x < 1
    KS, T   ln|W| - ln weighted_level

The gains of a matrix are numbered: its p singular values first, then the rows that single channels
keep within bounds of their own, uᵀS or wᵀKS, of which the only singular value is the length. A
table (Limit.COUNT, numbers) has ln of every curve's bound in its first rows, infinite where nothing
bounds it.
"""

from enum import IntEnum

import numpy as np

from ccd_casadi.kernels.compiled import compiled

HALF_POWER = 0.5 * np.log(2.0)


class LoopCurve(IntEnum):
    """What is bounded; the row of its limit."""

    S_MAX = 0
    SHAPE = 1  # of shape/√2, on the line through ω_i
    S_LOW = 2
    KS = 3  # of the level over scale and unit of force
    T = 4  # of the level over scale
    GS = 5
    CROSSING = 6  # |S(jω_b)| <= 1/√2, the end of the level
    LEVEL = 7  # |S| <= 1/√2 below ω_b, or below the line that ends there


class Limit(IntEnum):
    """The other rows: roots of the weights over ω₀."""

    LEAST = 8  # ω that the shape counts at least
    KS_ZERO = 9
    KS_POLE = 10
    T_ZERO = 11
    T_POLE = 12
    BANDWIDTH = 13  # ω_i
    OPENS = 14  # 1 where the room of the shape opens from ω_b on, else 0
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
