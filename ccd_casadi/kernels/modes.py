"""Plants as sums of modes, G = Σ R f(p; jω), continuous or behind hold and delay, on jv.

    f = 1/(s - p), or what a mode answers to hold and delay (z = e^{sT}):

    f = z⁻ᵈ (late + early/z)/(z - e^{pT}),   ω = (2/T) arctan(vT/2)

Conjugate poles go together: with f̃ of the conjugate of p

    R f + R̄ f̃ = Re R (f + f̃) + Im R j(f - f̃)

A pole at p = 0 is exact: f = 1/s, and a free body adds Im R f₂ with f₂ = 1/s². Behind hold and
delay, with late = h and early = T - h of f,

    f₂ = z⁻ᵈ ((h² + (T² - h²)/z)/2/(z - 1) + T (h + (T - h)/z)/(z - 1)²)
"""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.limits import warped
from ccd_casadi.kernels.sections import inverse

CANCELLING = 1e-4  # |z - e^{pT}| below which the difference loses digits, and expm1 does not


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
    if gap.real * gap.real + gap.imag * gap.imag < CANCELLING * CANCELLING:
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
    if gap.real * gap.real + gap.imag * gap.imag < CANCELLING * CANCELLING:
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
    """G (N, p, m) of the plants `which` at jv and ∂G/∂ln v."""
    out = np.empty((v.size, 2, plants.residues.shape[3], plants.residues.shape[4]), np.complex128)
    for j in range(v.size):
        ω, chain = warped(plants.period, v[j])
        response(
            plants.terms, plants.residues, plants.period, plants.delay, which[j], ω, chain, True,
            out[j], 0,
        )  # fmt: skip
    return out
