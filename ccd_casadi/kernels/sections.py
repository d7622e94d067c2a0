"""A controller of sections in a loop with one plant: K, G, their slopes, and every curve on jv.

    K(s) = k Π factor^±1,   factors 1 + ω/s (an integrator), 1 + s/ω, 1 + 2ζ s/ω + s²/ω²
    G    = Σ r f(p; jω),    f = 1/(s - p), or what a mode answers to hold and delay (z = e^{sT}):

    f = z⁻ᵈ (late + early/z)/(z - e^{pT}),   ω = (2/T) arctan(vT/2)

With S = 1/(1 + GK), T = 1 - S, g = ∂ln K/∂κ and x = ln v

    ∂ln|S| = -Re(T g),   ∂ln|KS| = ∂ln|T| = Re(S g)      (κ)
    ∂ln|S| = -Re(S ∂(GK))                                (x)

Plants are tuples (poles, residues, late, early, e^{pT}) of arrays (P, n), a period T (0:
continuous) and d. `limits` holds what is added to each curve, see `Limit`.
"""

from enum import IntEnum

import numpy as np

from ccd_casadi.kernels.compiled import compiled

INTEGRATOR, REAL, PAIR = 0, 1, 2
CANCELLING = 1e-4  # |z - e^{pT}| below which the difference loses digits, and expm1 does not
HALF_POWER = 0.5 * np.log(2.0)


class Curve(IntEnum):
    """What is bounded."""

    S_MAX = 0
    SHAPE = 1
    S_LOW = 2
    KS = 3
    T = 4
    GS = 5
    CROSSING = 6  # |S(jω_b)| <= 1/√2, the end of the level
    LEVEL = 7  # |S| <= 1/√2 below ω_b


S_MAX, SHAPE, S_LOW, KS, T_, GS = 0, 1, 2, 3, 4, 5
CROSSING = 6


class Limit(IntEnum):
    """Places in `limits`: logarithms of bounds, and roots of the weights over ω₀."""

    S_MAX = 0
    S_LOW = 1
    SHAPE = 2  # of shape/e^τ
    LEAST = 3  # ω that the shape counts at least
    KS = 4  # of the level over scale and unit of force
    T = 5
    GS = 6
    KS_ZERO = 7
    KS_POLE = 8
    T_ZERO = 9
    T_POLE = 10
    COUNT = 11


@compiled
def controller(factors, values, s, g):
    """K(s) and ∂ln K/∂ln s; fills g (n,) = ∂ln K/∂κ."""
    K, slope = complex(values[0], 0.0), 0.0j
    g[0] = 1.0
    for i in range(factors.shape[0]):
        kind, sign, at = factors[i, 0], factors[i, 1], factors[i, 2]
        if kind == INTEGRATOR:
            x = values[at] / s
            factor = 1.0 + x
            first = x / factor
        else:
            x = s / values[at]
            if kind == REAL:
                factor = 1.0 + x
                first = -x / factor
            else:
                middle = 2.0 * values[at + 1] * x
                factor = 1.0 + middle + x * x
                first = -(middle + 2.0 * x * x) / factor
                g[at + 1] = sign * middle / factor
        K = K * factor if sign > 0 else K / factor
        g[at] = sign * first
        slope -= sign * first
    return K, slope


@compiled
def gain(factors, values, s):
    """K(s) alone."""
    K = complex(values[0], 0.0)
    for i in range(factors.shape[0]):
        kind, at = factors[i, 0], factors[i, 2]
        if kind == INTEGRATOR:
            factor = 1.0 + values[at] / s
        else:
            x = s / values[at]
            factor = 1.0 + x
            if kind == PAIR:
                factor += (2.0 * values[at + 1] - 1.0) * x + x * x
        K = K * factor if factors[i, 1] > 0 else K / factor
    return K


@compiled
def plant(modes, T, d, i, v):
    """G and ∂G/∂ln v of plant i at jv, and both of the continuous plant without hold and delay."""
    poles, residues, late, early, grown = modes
    ω, chain = v, 1.0
    if T > 0.0:
        ω = 2.0 / T * np.arctan(0.5 * T * v)
        chain = v / ω / (1.0 + (0.5 * T * v) ** 2)
    s = complex(0.0, ω)
    free, free_slope = 0.0j, 0.0j
    G, slope = 0.0j, 0.0j
    z = np.exp(s * T)
    for k in range(poles.shape[1]):
        p, r = poles[i, k], residues[i, k]
        if r == 0.0:
            continue
        f = 1.0 / (s - p)
        free += r * f
        free_slope -= r * f * f * s * chain
        if T > 0.0:
            gap = z - grown[i, k]
            if abs(gap) < CANCELLING:
                gap = grown[i, k] * _expm1((s - p) * T)
            value = (late[i, k] + early[i, k] / z) / gap
            turned = early[i, k] / (z * gap) + value * z / gap + d * value
            G += r * value
            slope += r * turned
    if T == 0.0:
        return free, free_slope, free, free_slope
    shift = np.exp(-s * T * d)
    return G * shift, -slope * shift * s * T * chain, free, free_slope


@compiled
def _expm1(x):
    """e^x - 1 without loss of digits."""
    half = np.sin(0.5 * x.imag)
    real = np.expm1(x.real) * np.cos(x.imag) - 2.0 * half * half
    return complex(real, np.exp(x.real) * np.sin(x.imag))


@compiled
def _over(a, b):
    """a/b, not finite where b is 0 (Numba's own division raises there)."""
    size = b.real * b.real + b.imag * b.imag
    c = a * b.conjugate()
    return complex(c.real / size, c.imag / size)


@compiled
def _offset(curve, ω, chain, limits):
    """What is added to the logarithm of a curve, and its slope to ln v."""
    if curve == S_MAX:
        return -limits[Limit.S_MAX], 0.0
    if curve == S_LOW:
        return -limits[Limit.S_LOW], 0.0
    if curve == SHAPE:
        if ω < limits[Limit.LEAST]:
            return HALF_POWER - limits[Limit.SHAPE] - np.log(limits[Limit.LEAST]), 0.0
        return HALF_POWER - limits[Limit.SHAPE] - np.log(ω), -chain
    if curve in (KS, T_):
        if curve == KS:
            zero, pole, level = limits[Limit.KS_ZERO], limits[Limit.KS_POLE], limits[Limit.KS]
        else:
            zero, pole, level = limits[Limit.T_ZERO], limits[Limit.T_POLE], limits[Limit.T]
        a, b = ω * ω + zero * zero, ω * ω + pole * pole
        return 0.5 * np.log(a / b) - level, (ω * ω / a - ω * ω / b) * chain
    if curve == GS:
        return -limits[Limit.GS], 0.0
    return HALF_POWER, 0.0


@compiled
def _warped(T, v):
    """ω of v and ∂ln ω/∂ln v."""
    if T == 0.0:
        return v, 1.0
    ω = 2.0 / T * np.arctan(0.5 * T * v)
    return ω, v / ω / (1.0 + (0.5 * T * v) ** 2)


@compiled
def _curve(curve, factors, values, modes, T, d, i, v, limits, g):
    """Value and slope to ln v of one curve; S; fills g."""
    K, K_slope = controller(factors, values, complex(0.0, v), g)
    G, dG, free, dfree = plant(modes, T, d, i, v)
    S = _over(1.0 + 0.0j, 1.0 + G * K)
    ω, chain = _warped(T, v)
    offset, offset_slope = _offset(curve, ω, chain, limits)
    value = np.log(abs(S)) + offset
    slope = -(S * K * (dG + G * K_slope)).real + offset_slope
    if curve == KS:
        value += np.log(abs(K))
        slope += K_slope.real
    elif curve == T_:
        value += np.log(abs(G * K))
        slope += (K_slope + _over(dG, G)).real
    elif curve == GS:
        value += np.log(abs(free))
        slope += _over(dfree, free).real
    return value, slope, S


@compiled
def rows(curve, factors, values, modes, T, d, which, v, limits):
    """M rows: value, slope to ln v, S, and ∂ln K/∂κ (M, n)."""
    count, n = v.size, values.size
    value, slope = np.empty(count), np.empty(count)
    S = np.empty(count, np.complex128)
    g = np.empty((count, n), np.complex128)
    for m in range(count):
        found = _curve(curve[m], factors, values, modes, T, d, which[m], v[m], limits, g[m])
        value[m], slope[m], S[m] = found
    return value, slope, S, g


@compiled
def levels(curves, factors, values, modes, T, d, v, limits):
    """The values of several curves on all plants, (curves, P, k) at v (P, k)."""
    P, count = v.shape
    out = np.empty((curves.size, P, count))
    for i in range(P):
        for k in range(count):
            K = gain(factors, values, complex(0.0, v[i, k]))
            G, _, free, _ = plant(modes, T, d, i, v[i, k])
            S = -np.log(abs(1.0 + G * K))
            ω, chain = _warped(T, v[i, k])
            for c in range(curves.size):
                value = S + _offset(curves[c], ω, chain, limits)[0]
                if curves[c] == KS:
                    value += np.log(abs(K))
                elif curves[c] == T_:
                    value += np.log(abs(G * K))
                elif curves[c] == GS:
                    value += np.log(abs(free))
                out[c, i, k] = value
    return out


@compiled
def close(curve, factors, values, modes, T, d, which, start, low, high, limits, tolerances):
    """Local maxima by Illinois false position on the slope, in brackets [low, high] around start.

    A bracket that two steps do not halve is cut in the middle: where the slope is tiny at one end
    and large at the other, as with two maxima about to part, false position alone creeps. Where a
    bracket's slopes do not change sign (an end) the start stays; second: where they do.
    """
    flat, narrowest, most = tolerances
    top, closed = start.copy(), np.zeros(start.size, np.bool_)
    g = np.empty(values.size, np.complex128)
    for m in range(start.size):
        code, i = curve[m], which[m]
        a = np.log(start[m])
        fa = _curve(code, factors, values, modes, T, d, i, start[m], limits, g)[1]
        end = high[m] if fa > 0.0 else low[m]
        b = np.log(end)
        fb = _curve(code, factors, values, modes, T, d, i, end, limits, g)[1]
        if not (fa * fb < 0.0 and np.isfinite(fa) and np.isfinite(fb)):
            continue
        closed[m] = True
        narrow = narrowest * abs(b - a)
        before, wider = np.inf, np.inf  # widths one and two steps ago
        for _ in range(int(most)):
            width = abs(b - a)
            x = 0.5 * (a + b) if width > 0.5 * wider else b - fb * (b - a) / (fb - fa)
            wider, before = before, width
            fx = _curve(code, factors, values, modes, T, d, i, np.exp(x), limits, g)[1]
            if fx * fb < 0.0:
                a, fa = b, fb
            else:
                fa *= 0.5
            b, fb = x, fx
            if abs(fx) < flat or abs(b - a) <= narrow:
                break
        top[m] = np.exp(b)
    return top, closed
