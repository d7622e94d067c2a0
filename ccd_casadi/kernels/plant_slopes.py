"""Slopes of x G(jω) y to the parameters of plants, G = C f(A) B in the eigenvectors of A.

    x (∂C f(A) B + C f(A) ∂B + C (f[p_i, p_j] ∘ ∂A) B) y     (Daleckii and Krein)

with f[p_i, p_j] = (f(p_i) - f(p_j))/(p_i - p_j), f' where these are one. f is 1/(s - p), or what a
pole answers to hold and delay (see `modes`).

A free body is a chain q̇ = s v, v̇ = b u, y = c q of two states with the pole 0. Only v̇ moves with
the parameters, so that its part is

    x ∂C f'(0) s b y + x c s f'(0) ∂B y + Σ_j (x c s) f[0, 0, p_j] ∂A_vj b_j y
      + Σ_i x c_i (∂A_iv f[p_i, 0] + ∂A_iq f[p_i, 0, 0] s) b y,

f[0, 0, p] = (f[0, p] - f'(0))/p. Free bodies do not move each other.
"""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.limits import warped
from ccd_casadi.kernels.modes import CANCELLING, _expm1, _free
from ccd_casadi.kernels.sections import inverse

SIMPLE, POSITION, VELOCITY = range(3)  # a pole of its own, or q and v of a free body


class PlantSlopes(NamedTuple):
    """`terms` (P, n, 6): p, late, early, e^{pT}, ∂late/∂p and ∂early/∂p; C (P, p, n), B (P, n, m);
    1/(p_i - p_j), 0 where these are one, (P, n, n); ∂A (P, n, n, 2, t), real and imaginary, ∂B
    (P, n, m, t) and ∂C (P, p, n, t) to t parameters; the period T (0: continuous) and d; `kinds`
    (P, n) of the states. Of a free body C has 0 at q and s c at v, B has s b at q.
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
    """Re ∂(x G y) (N, t) of the plants `which` at jv with rows x (N, p) and columns y (N, m).

    `free` of hold and delay: a disturbing force d e^{jωt} shows in the samples as G(jω) d so.
    """
    terms, C, B, gaps, dA, dB, dC, period, d, kinds = slopes
    n, (m, count) = terms.shape[1], dB.shape[2:]
    p, T = C.shape[1], 0.0 if free else period
    out = np.zeros((v.size, count))
    f, own, slope, c, b = np.empty((5, n), np.complex128)
    for k in range(v.size):
        i, ω = which[k], warped(period, v[k])[0]
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
                if gap.real * gap.real + gap.imag * gap.imag < CANCELLING * CANCELLING:
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
