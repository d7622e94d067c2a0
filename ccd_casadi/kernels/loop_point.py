"""Gains of a loop's matrices over their bounds, on every plant, with exact derivatives.

With S = (I + GK)⁻¹, K = V diag(K_i) Uᵀ and G₀ the plant without hold and delay, each matrix M
depends on every K_i by rank one, and on the plant by one product. With u, v singular vectors,

    ∂ ln σ = Re(ũᵀ ∂M v),   ũ = ū/σ
           = Re Σ_i left_i K_i right_i ∂ln K_i + Re(x ∂G y)   [- Re(x ∂G₀ v) of S G₀]

    M            x          right       left            y
    S          -ũᵀS         UᵀS v       x G V           V diag(K_i) right
    T = GKS     ũᵀS         UᵀS v       x G V           "
    KS         -ũᵀKS        UᵀS v       x G V + ũᵀV     "
    S G₀       -ũᵀS         UᵀS G₀ v    x G V           "

Several singular values are constraints of their own: where the largest two meet both bind, and no
derivative is lost. One channel is the case of 1 x 1 matrices.
"""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.limits import LoopCurve
from ccd_casadi.kernels.sections import inverse
from ccd_casadi.kernels.small import invert, singular

# What a point, one plant's loop at one frequency, has of matrices (10, w, w) and of vectors (9, w)
G, DG, FREE, DFREE, GV, GK, S, US, M, V = range(10)  # GV = G V, US = Uᵀ S
K, RATE, U, W, LEFT, RIGHT, SHARE, X, Y = range(9)  # K_i, ∂ln K_i/∂ln v; U = ũ, W = v or G₀ v


class LoopArrays(NamedTuple):
    """`factors` and `values` of the controller (`sections`), `channel` (n,) of each value; V (m, c)
    and Uᵀ (c, p); the plants (`modes`); the limits (`limits`), and the rows that channels bound for
    themselves, u and w in the plants' coordinates, `rows` (2, channels, m).
    """

    factors: Any
    values: Any
    channel: Any
    into: Any
    out: Any
    terms: Any
    residues: Any
    period: Any
    delay: Any
    limits: Any
    rows: Any


@compiled
def room(loop):
    """Matrices, vectors, g (n,) and σ of a point, to be filled."""
    w = max(loop.into.shape[0], loop.into.shape[1])
    z = np.complex128
    return np.zeros((10, w, w), z), np.zeros((9, w), z), np.zeros(loop.values.size, z), np.zeros(w)


@compiled
def closed(into, out, k, at):
    """Fills G V, G K, S and Uᵀ S from G and K_i (c,)."""
    (m, c), p = into.shape, out.shape[1]
    for a in range(p):
        for i in range(c):
            total = 0.0j
            for b in range(m):
                total += at[G, a, b] * into[b, i]
            at[GV, a, i] = total
        for b in range(p):
            total = 0.0j
            for i in range(c):
                total += at[GV, a, i] * k[i] * out[i, b]
            at[GK, a, b] = total
    if p == 1:
        at[S, 0, 0] = inverse(1.0 + at[GK, 0, 0])
    else:
        inverted = np.empty((p, p), np.complex128)
        for a in range(p):
            for b in range(p):
                inverted[a, b] = at[GK, a, b]
            inverted[a, a] += 1.0
        inverted = invert(inverted)
        for a in range(p):
            for b in range(p):
                at[S, a, b] = inverted[a, b]
    for i in range(c):
        for b in range(p):
            total = 0.0j
            for a in range(p):
                total += out[i, a] * at[S, a, b]
            at[US, i, b] = total


@compiled
def matrix(curve, into, out, k, at):
    """Fills M of a curve; its rows and columns."""
    (m, c), p = into.shape, out.shape[1]
    if curve == LoopCurve.KS:
        for b in range(p):
            for a in range(m):
                total = 0.0j
                for i in range(c):
                    total += into[a, i] * (k[i] * at[US, i, b])
                at[M, a, b] = total
        return m, p
    columns = m if curve == LoopCurve.GS else p
    for a in range(p):
        for b in range(columns):
            total = 0.0j
            if curve == LoopCurve.GS:
                for d in range(p):
                    total += at[S, a, d] * at[FREE, d, b]
            elif curve == LoopCurve.T:
                for d in range(p):
                    total += at[GK, a, d] * at[S, d, b]
            else:
                total = at[S, a, b]
            at[M, a, b] = total
    return p, columns


@compiled
def row_of(row, M, rows, columns):
    """Puts a real row times M in M's first row; its length."""
    total = 0.0
    for b in range(columns):
        entry = 0.0j
        for a in range(rows):
            entry += row[a] * M[a, b]
        M[0, b] = entry
        total += entry.real * entry.real + entry.imag * entry.imag
    return np.sqrt(total)


@compiled
def gain_of(curve, number, into, out, own, at, of, sigma):
    """σ of one gain and the column of its v in V; fills V, σ, ũ, x, right, left, share and y."""
    (m, c), p = into.shape, out.shape[1]
    rows, columns = matrix(curve, into, out, of[K], at)
    place = number
    if number >= p:
        row, place = own[int(curve == LoopCurve.KS), number - p], 0
        row_of(row, at[M], rows, columns)
    singular(at[M], rows if number < p else 1, columns, at[V], sigma, True)
    scale = 1.0 / (sigma[place] * sigma[place])
    for a in range(rows):
        if number < p:
            of[U, a] = at[M, a, place].conjugate() * scale
        else:
            of[U, a] = (
                own[int(curve == LoopCurve.KS), number - p, a] * at[M, 0, 0].conjugate() * scale
            )
    for a in range(p):
        total = at[V, a, place]
        if curve == LoopCurve.GS:
            total = 0.0j
            for b in range(m):
                total += at[FREE, a, b] * at[V, b, place]
        of[W, a] = total
    for i in range(c):
        total = 0.0j
        for b in range(p):
            total += at[US, i, b] * of[W, b]
        of[RIGHT, i], total = total, 0.0j
        if curve == LoopCurve.KS:
            for a in range(m):
                total += of[U, a] * into[a, i]
        of[LEFT, i] = total  # so far ũᵀV
    sign = 1.0 if curve == LoopCurve.T else -1.0
    for b in range(p):
        total = 0.0j
        if curve == LoopCurve.KS:
            for i in range(c):
                total -= of[LEFT, i] * of[K, i] * at[US, i, b]
        else:
            for a in range(p):
                total += sign * of[U, a] * at[S, a, b]
        of[X, b] = total
    for i in range(c):
        total = of[LEFT, i]
        for a in range(p):
            total += of[X, a] * at[GV, a, i]
        of[LEFT, i], of[SHARE, i] = total, total * of[K, i] * of[RIGHT, i]
    for a in range(m):
        total = 0.0j
        for i in range(c):
            total += into[a, i] * of[K, i] * of[RIGHT, i]
        of[Y, a] = total
    return sigma[place], place
