"""Second derivatives of the gains of a loop's matrices to κ, at fixed frequencies.

With ∂_a M = P_i ∂_a K_i Q_i (see `loop_point`) and R = Uᵀ S G V, a of channel i, b of channel j,

    ∂²_ab M = -P_i ∂_a K_i R_ij ∂_b K_j Q_j - P_j ∂_b K_j R_ji ∂_a K_i Q_i + δ_ij P_i ∂²_ab K_i Q_i,

and of λ = σ² as an eigenvalue of MᴴM, with z_m = v_mᴴ ∂(MᴴM) v = σ conj(uᴴ∂M v_m) + (M v_m)ᴴ∂M v,

    ½ ∂²λ/λ = Re(ũᵀ ∂²M v) + Re((∂M v)ᴴ ∂M v)/λ + Re Σ_{m≠} z̄_m z_m/(λ (λ - λ_m)),
    ∂² ln σ = ½ ∂²λ/λ - 2 ∂ln σ ∂ln σ.

Where σ_m comes close to σ the gap is kept from zero: both are constraints, and the trust region
holds where the model does.
"""

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.limits import LoopCurve, warped
from ccd_casadi.kernels.loop_point import (
    FREE,
    GV,
    LEFT,
    RATE,
    RIGHT,
    SHARE,
    US,
    G,
    K,
    M,
    S,
    V,
    closed,
    gain_of,
    room,
    row_of,
)
from ccd_casadi.kernels.modes import response
from ccd_casadi.kernels.sections import gains_and_slopes, second_slopes

LEAST_GAP = 1e-2  # of two singular values, relative, that the model counts with


@compiled
def second(curve, number, which, v, loop):
    """∂²ln σ/∂κ² (M, n, n) of M rows at their v."""
    at, of, g, sigma = room(loop)
    factors, values, channel, into, out, terms, residues, T, delay, _, own = loop
    (m, c), p, n = into.shape, out.shape[1], g.size
    z = np.complex128
    bends, bend = np.empty((v.size, n, n)), np.empty((n, n), z)
    crossed, moved = np.empty((c, c), z), np.empty((c, c), z)
    back, ahead = np.empty((m, c), z), np.empty((m, c), z)
    for j in range(v.size):
        gains_and_slopes(factors, values, complex(0.0, v[j]), of[K], of[RATE], g)
        ω, chain = warped(T, v[j])
        response(terms, residues, T, delay, which[j], ω, chain, False, at, G)
        if curve[j] == LoopCurve.GS:
            response(terms, residues, 0.0, 0.0, which[j], ω, 1.0, False, at, FREE)
        closed(into, out, of[K], at)
        σ, place = gain_of(curve[j], number[j], into, out, own, at, of, sigma)
        columns = m if curve[j] == LoopCurve.GS else p
        _by_channel(curve[j], number[j], place, into, p, own, at, of, crossed, moved, back, ahead)
        second_slopes(factors, g, bend)
        for a in range(n):
            i = channel[a]
            for b in range(a + 1):
                h = channel[b]
                both = g[a] * g[b]
                total = g[a].conjugate() * g[b] * moved[i, h] / (σ * σ)
                total -= both * (crossed[i, h] + crossed[h, i])
                if i == h:
                    total += of[SHARE, i] * (bend[a, b] + both)
                for q in range(columns):
                    if q != place:
                        za = ahead[q, i] * g[a] + (back[q, i] * g[a]).conjugate()
                        zb = ahead[q, h] * g[b] + (back[q, h] * g[b]).conjugate()
                        total += za.conjugate() * zb * _over_gap(σ, sigma[q])
                first = (of[SHARE, i] * g[a]).real * (of[SHARE, h] * g[b]).real
                bends[j, a, b] = bends[j, b, a] = total.real - 2.0 * first
    return bends


@inlined
def _over_gap(σ, other):
    """1/(λ (λ - λ_m)), σ's gap to σ_m kept from zero."""
    gap, least = σ - other, LEAST_GAP * σ
    if abs(gap) < least:
        gap = -least if gap < 0.0 else least
    return 1.0 / (σ * σ * gap * (σ + other))


@inlined
def _by_channel(curve, number, place, into, p, own, at, of, crossed, moved, back, ahead):
    """For ∂ln K_i = 1 fills left_i K_i R_ij K_j right_j (c, c), (∂M v)ᴴ∂M v (c, c), and both parts
    of z_m (m, c).
    """
    m, c = into.shape
    rows, columns = m if curve == LoopCurve.KS else p, m if curve == LoopCurve.GS else p
    z = np.complex128
    R, P, Q = np.zeros((c, c), z), np.zeros((m, c), z), np.zeros((m, c), z)
    for i in range(c):
        for h in range(c):
            for a in range(p):
                R[i, h] += at[US, i, a] * at[GV, a, h]
            crossed[i, h] = of[LEFT, i] * of[K, i] * R[i, h] * of[K, h] * of[RIGHT, h]
    sign = 1.0 if curve == LoopCurve.T else -1.0
    for i in range(c):
        for a in range(rows):
            if curve == LoopCurve.KS:
                P[a, i] = into[a, i]
                for h in range(c):
                    P[a, i] -= into[a, h] * of[K, h] * R[h, i]
            else:
                for b in range(p):
                    P[a, i] += sign * at[S, a, b] * at[GV, b, i]
        for q in range(columns):
            for b in range(p):
                entry = at[V, b, q]
                if curve == LoopCurve.GS:
                    entry = 0.0j
                    for d in range(m):
                        entry += at[FREE, b, d] * at[V, d, q]
                Q[q, i] += at[US, i, b] * entry
    if number >= p:
        row_of(own[int(curve == LoopCurve.KS), number - p], P, rows, c)
        rows = 1
    for i in range(c):
        for h in range(c):
            moved[i, h] = 0.0
            for a in range(rows):
                one, other = P[a, i] * of[K, i] * of[RIGHT, i], P[a, h] * of[K, h] * of[RIGHT, h]
                moved[i, h] += one.conjugate() * other
        for q in range(columns):
            back[q, i], ahead[q, i] = 0.0, 0.0
            for a in range(rows):
                change = P[a, i] * of[K, i]
                back[q, i] += at[M, a, place].conjugate() * change * Q[q, i]
                ahead[q, i] += at[M, a, q].conjugate() * change * of[RIGHT, i]
