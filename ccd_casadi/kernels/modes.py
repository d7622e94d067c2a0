"""Responses of modes behind hold and delay, and their slopes to θ by divided differences."""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.sections import inverse, warp


class CancellationOptions(NamedTuple):
    """The threshold below which a difference is computed by expm1.

    Attributes
    ----------
    gap : float
        |z - e^{pT}| below which the difference loses digits, and expm1 does not.
    """

    gap: float = 1e-4


OPTIONS = CancellationOptions()


class Plants(NamedTuple):
    """`terms` (P, n, 4): poles with Im p >= 0, late, early and e^{pT}; `residues` (P, n, 2, p, m),
    real and imaginary, of a real pole half of it, at p = 0 half of that of 1/s and all of that of
    1/s²; the period T (0: continuous) and d.
    """

    terms: Any
    residues: Any
    period: Any
    delay: Any


@compiled
def response(terms, residues, T, d, i, ω, chain, sloped, at, place):
    """Fills G (p, m) of plant i at ω, and with `sloped` ∂G/∂ln v: at[place], at[place + 1]; `chain`
    is ∂ln ω/∂ln v.

    With T = 0 free of hold and delay: a disturbing force d e^{jωt} shows in the samples as G(jω) d
    so.
    """
    s, z = complex(0.0, ω), 1.0 + 0.0j
    if T > 0.0:
        z = complex(np.cos(ω * T), np.sin(ω * T))
    _, count, _, rows, columns = residues.shape
    for a in range(rows):
        for b in range(columns):
            at[place, a, b] = at[place + 1, a, b] = 0.0
    for k in range(count):
        p = terms[i, k, 0]
        if p == 0.0:
            f, df, g, dg = _free(s, z, terms[i, k, 1].real, T, d)
            for a in range(rows):
                for b in range(columns):
                    at[place, a, b] += residues[i, k, 0, a, b] * (f + f)
                    at[place, a, b] += residues[i, k, 1, a, b] * g
                    if sloped:
                        at[place + 1, a, b] += (
                            residues[i, k, 0, a, b] * (df + df) + residues[i, k, 1, a, b] * dg
                        )
            continue
        if T > 0.0:
            late, early, grown = terms[i, k, 1], terms[i, k, 2], terms[i, k, 3]
            f, df = _held(s, z, p, late, early, grown, T, d)
            h, dh = _held(
                s, z, p.conjugate(), late.conjugate(), early.conjugate(), grown.conjugate(), T, d
            )
        else:
            f, h = inverse(s - p), inverse(s - p.conjugate())
            df, dh = f * f, h * h
        both, apart = f + h, complex(h.imag - f.imag, f.real - h.real)
        for a in range(rows):
            for b in range(columns):
                at[place, a, b] += residues[i, k, 0, a, b] * both + residues[i, k, 1, a, b] * apart
        if sloped:
            both, apart = df + dh, complex(dh.imag - df.imag, df.real - dh.real)
            for a in range(rows):
                for b in range(columns):
                    at[place + 1, a, b] += (
                        residues[i, k, 0, a, b] * both + residues[i, k, 1, a, b] * apart
                    )
    turn, rate = 1.0 + 0.0j, -s * chain
    if T > 0.0:
        turn = complex(np.cos(ω * T * d), -np.sin(ω * T * d))
        rate = -s * T * chain * turn
    for a in range(rows):
        for b in range(columns):
            at[place, a, b] *= turn
            at[place + 1, a, b] *= rate


@compiled
def _held(s, z, p, late, early, grown, T, d):
    """z^d f, and what -sT∂ln ω/∂ln v times it is its slope."""
    gap = z - grown
    if gap.real * gap.real + gap.imag * gap.imag < OPTIONS.gap * OPTIONS.gap:
        gap = grown * _expm1((s - p) * T)
    under, back = inverse(gap), z.conjugate()
    value = (late + early * back) * under
    return value, early * back * under + value * z * under + d * value


@compiled
def _free(s, z, h, T, d):
    """z^d f and its slope as `_held` has it, both of 1/s, then of 1/s²."""
    if T == 0.0:
        f = inverse(s)
        return f, f * f, f * f, 2.0 * f * f * f
    f, df = _held(s, z, complex(0.0, 0.0), complex(h, 0.0), complex(T - h, 0.0), 1.0 + 0.0j, T, d)
    gap, back = z - 1.0, z.conjugate()
    if gap.real * gap.real + gap.imag * gap.imag < OPTIONS.gap * OPTIONS.gap:
        gap = _expm1(s * T)
    under = inverse(gap)
    first, rest = 0.5 * h * h + 0.5 * (T * T - h * h) * back, 0.5 * (T * T - h * h) * back
    ahead = T * under
    value = (first + ahead * (h + (T - h) * back)) * under
    slope = (rest + ahead * (T - h) * back) * under
    slope += (first + 2.0 * ahead * (h + (T - h) * back)) * z * under * under
    return f, df, value, slope + d * value


@compiled
def _expm1(x):
    """e^x - 1 without loss of digits."""
    half = np.sin(0.5 * x.imag)
    real = np.expm1(x.real) * np.cos(x.imag) - 2.0 * half * half
    return complex(real, np.exp(x.real) * np.sin(x.imag))


@compiled
def responses(plants, which, v):
    """Evaluate the responses of plants and their slopes.

    Parameters
    ----------
    plants : Plants
    which : int array (N,)
    v : array (N,)

    Returns
    -------
    complex array (N, 2, p, m)
        G at jv and ∂G/∂ln v.
    """
    out = np.empty((v.size, 2, plants.residues.shape[3], plants.residues.shape[4]), np.complex128)
    for j in range(v.size):
        ω, chain = warp(plants.period, v[j])
        response(
            plants.terms, plants.residues, plants.period, plants.delay, which[j], ω, chain, True,
            out[j], 0,
        )  # fmt: skip
    return out


SIMPLE, POSITION, VELOCITY = range(3)  # a pole of its own, or q and v of a free body


class PlantSlopes(NamedTuple):
    """Plants with their derivatives to t parameters.

    Of a free body C has 0 at q and s c at v, B has s b at q.

    Attributes
    ----------
    terms : array (P, n, 6)
        p, late, early, e^{pT}, ∂late/∂p and ∂early/∂p.
    C, B : arrays (P, p, n), (P, n, m)
    gaps : array (P, n, n)
        1/(p_i - p_j), 0 where these are one.
    dA, dB, dC : arrays (P, n, n, 2, t), (P, n, m, t), (P, p, n, t)
        ∂A real and imaginary, ∂B, ∂C.
    period, delay : float
        T in s (0: continuous), and d.
    kinds : int array (P, n)
        Of the states.
    """

    terms: Any
    C: Any
    B: Any
    gaps: Any
    dA: Any
    dB: Any
    dC: Any
    period: Any
    delay: Any
    kinds: Any


@compiled
def form_slopes(slopes, which, v, x, y, free):
    """Evaluate Re ∂(x G y) to the parameters.

    Parameters
    ----------
    slopes : PlantSlopes
    which : int array (N,)
        Plants.
    v : array (N,)
    x, y : complex arrays (N, p), (N, m)
    free : bool
        Free of hold and delay: the response to a disturbing force is G(jω) itself.

    Returns
    -------
    array (N, t)
    """
    terms, C, B, gaps, dA, dB, dC, period, d, kinds = slopes
    n, (m, count) = terms.shape[1], dB.shape[2:]
    p, T = C.shape[1], 0.0 if free else period
    out = np.zeros((v.size, count))
    f, own, slope, c, b = np.empty((5, n), np.complex128)
    for k in range(v.size):
        i, ω = which[k], warp(period, v[k])[0]
        s, z = complex(0.0, ω), complex(np.cos(ω * T), np.sin(ω * T))
        turn = complex(np.cos(ω * T * d), -np.sin(ω * T * d))
        for a in range(n):
            pole = terms[i, a, 0]
            if kinds[i, a] != SIMPLE:
                f[a], _, own[a], _ = _free(s, z, terms[i, a, 1].real, T, d)
                f[a] *= turn
                own[a] *= turn
                slope[a] = own[a]
            elif T > 0.0:
                gap, grown, back = z - terms[i, a, 3], terms[i, a, 3], z.conjugate()
                if gap.real * gap.real + gap.imag * gap.imag < OPTIONS.gap * OPTIONS.gap:
                    gap = grown * _expm1((s - pole) * T)
                under = inverse(gap)
                f[a] = (terms[i, a, 1] + terms[i, a, 2] * back) * under
                slope[a] = terms[i, a, 4] + terms[i, a, 5] * back + f[a] * T * grown
                slope[a] *= under * turn
                f[a] *= turn
                own[a] = f[a]
            else:
                f[a] = inverse(s - pole)
                slope[a] = f[a] * f[a]
                own[a] = f[a]
            c[a] = b[a] = 0.0
            for row in range(p):
                c[a] += x[k, row] * C[i, row, a]
            for column in range(m):
                b[a] += B[i, a, column] * y[k, column]
        for a in range(n):
            for row in range(p):
                weight = x[k, row] * own[a] * b[a]
                for t in range(count):
                    out[k, t] += (weight * dC[i, row, a, t]).real
            for column in range(m):
                weight = c[a] * own[a] * y[k, column]
                for t in range(count):
                    out[k, t] += (weight * dB[i, a, column, t]).real
            for j in range(n):
                if kinds[i, a] == POSITION or (kinds[i, a] == VELOCITY and kinds[i, j] != SIMPLE):
                    continue
                if kinds[i, a] == VELOCITY:
                    weight = ((f[a] - f[j]) * gaps[i, a, j] - slope[a]) * gaps[i, j, a]
                elif kinds[i, j] == POSITION:
                    weight = ((f[a] - f[j]) * gaps[i, a, j] - slope[j]) * gaps[i, a, j]
                elif gaps[i, a, j] == 0.0:
                    weight = 0.5 * (slope[a] + slope[j])
                else:
                    weight = (f[a] - f[j]) * gaps[i, a, j]
                weight *= c[a] * b[j]
                for t in range(count):
                    out[k, t] += weight.real * dA[i, a, j, 0, t]
                for t in range(count):
                    out[k, t] -= weight.imag * dA[i, a, j, 1, t]
    return out
