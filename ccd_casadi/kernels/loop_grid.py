"""Loops over a grid, their maxima, and the curvature of a peak in the controller's parameters."""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
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
    fill_loop,
    gain_kind,
    gain_of,
    over_one_plus_L,
    room,
    row_of,
)
from ccd_casadi.kernels.modes import response
from ccd_casadi.kernels.sections import GainOf, LoopCurve, gains_and_slopes, second_slopes, warp


class Answers(NamedTuple):
    """Responses of plants at fixed frequencies: during a search only the controller changes.

    Attributes
    ----------
    place : int array (P, k)
        Of each frequency among them, -1 where it is not one; (0, 0): nothing is known.
    held, free : complex arrays (P, F, p, m)
        G with hold and delay, and as a disturbing force moves it.
    """

    place: Any
    held: Any
    free: Any


NONE = Answers(np.zeros((0, 0), np.int64), *np.zeros((2, 0, 0, 1, 1), complex))


@compiled
def merge(fixed, roots, poles, flanks, ends, apart, far):
    """Merge frequencies: fixed ones, and those around roots of controller and loops.

    Points nearer than `apart` (relative) would hide a peak between them, and count once. Below the
    first are spares: one, or more where a plant has fewer points than another.

    Parameters
    ----------
    fixed : array (P, F)
        v of each plant.
    roots, poles : complex arrays (R,), (P, n)
        Of the controller, and of the loops.
    flanks : array
        In half widths of a root.
    ends : tuple of float
        First and last v.
    apart : float
        Least relative distance.
    far : float
        One point is this factor past the last root and the other end.

    Returns
    -------
    v : array (P, k)
        Ascending.
    place : int array (P, k)
        Of each in `fixed`, or -1.
    """
    (count, F), (bottom, top), each = fixed.shape, ends, 1 + flanks.size
    size = F + (roots.size + poles.shape[1]) * each + 1
    v, place = np.empty((count, size + 1)), np.full((count, size + 1), -1)
    first = size
    for i in range(count):
        x, at, last = np.full(size, np.nan), F, top
        for j in range(F):  # an array put into a slice compiles for 1.5 s
            x[j] = fixed[i, j]
        for own in (roots, poles[i]):
            for root in own:
                if root.imag >= 0.0:
                    x[at] = abs(root)
                    last = max(last, x[at])
                    for j in range(flanks.size):
                        x[at + 1 + j] = root.imag + abs(root.real) * flanks[j]
                    at += each
        x[at] = far * last
        order, left = np.argsort(x, kind="mergesort"), size
        for j in range(size - 1, -1, -1):
            new = order[j]
            alone = j == 0 or not x[new] - x[order[j - 1]] < apart * x[new]
            if x[new] >= bottom and alone:
                v[i, left], place[i, left] = x[new], new if new < F else -1
                left -= 1
        for j in range(left + 1):
            v[i, j] = bottom * (0.5 + 0.49 * j / size)
        first = min(first, left)
    return v[:, first:].copy(), place[:, first:].copy()


@compiled
def maxima(value, v, end, depth):
    """Find local maxima of levels over the grid.

    Parameters
    ----------
    value : array (P, k, C, numbers)
        ln of gains over bounds.
    v : array (P, k)
    end : array (C, numbers)
        Last v of each curve.
    depth : float
        Only maxima above it.

    Returns
    -------
    found : int array (N, 4)
        Indices in `value`.
    beside : array (N, 2)
        v at their neighbours.
    """
    P, count, C, numbers = value.shape
    most = P * C * numbers * (count // 2 + 1)
    found, beside, size = np.empty((most, 4), np.int64), np.empty((most, 2)), 0
    for i in range(P):
        for j in range(count):
            for c in range(C):
                for k in range(numbers):
                    x, low, high = value[i, j, c, k], max(j - 1, 0), min(j + 1, count - 1)
                    risen = low == j or x >= value[i, low, c, k]
                    falls = high == j or x > value[i, high, c, k]
                    if x > depth and risen and falls:
                        found[size, 0], found[size, 1] = i, j
                        found[size, 2], found[size, 3] = c, k
                        beside[size, 0], beside[size, 1] = v[i, low], min(v[i, high], end[c, k])
                        size += 1
    return found[:size], beside[:size]


@compiled
def find_unseen(value, v, least):
    """Find steps of the grid in which a flat maximum near a bound may lie that no point shows.

    A parabola through a step and the point before it ends with a slope of the other sign.

    Parameters
    ----------
    value : array (P, k, C, numbers)
        ln of gains over bounds.
    v : array (P, k)
    least : float
        Only steps with a level above it.

    Returns
    -------
    found : int array (N, 3)
        Plant, curve and number.
    ends : array (N, 2)
        v.
    """
    P, count, C, numbers = value.shape
    found, ends, size = np.empty((value.size, 3), np.int64), np.empty((value.size, 2)), 0
    for i in range(P):
        for j in range(count - 3):
            for c in range(C):
                for k in range(numbers):
                    a, b = value[i, j + 1, c, k], value[i, j + 2, c, k]
                    if max(a, b) > least:
                        before = (a - value[i, j, c, k]) / np.log(v[i, j + 1] / v[i, j])
                        step = (b - a) / np.log(v[i, j + 2] / v[i, j + 1])
                        after = (value[i, j + 3, c, k] - b) / np.log(v[i, j + 3] / v[i, j + 2])
                        rises = before > 0.0 and step > 0.0 and 2.0 * step < before
                        falls = after < 0.0 and step < 0.0 and 2.0 * step > after
                        if (rises and after > 0.0) or (falls and before < 0.0):
                            found[size, 0], found[size, 1], found[size, 2] = i, c, k
                            ends[size, 0], ends[size, 1] = v[i, j + 1], v[i, j + 2]
                            size += 1
    return found[:size], ends[:size]


@compiled
def second(curve, number, which, v, loop):
    """Compute ∂²ln σ/∂κ² of M rows.

    Parameters
    ----------
    curve, number, which : int arrays (M,)
        Curve, its number, plant.
    v : array (M,)
    loop : LoopArrays

    Returns
    -------
    array (M, n, n)
    """
    at, of, g, sigma = room(loop)
    factors, values, channel, into, out, terms, residues, T, delay = loop[:9]
    _, own, kinds, free, lever = loop[9:]
    (m, c), p, n, q = into.shape, out.shape[1], g.size, free[1].shape[4]
    z = np.complex128
    bends, bend = np.empty((v.size, n, n)), np.empty((n, n), z)
    crossed, moved = np.empty((c, c), z), np.empty((c, c), z)
    back, ahead = np.empty((max(m, p, q), c), z), np.empty((max(m, p, q), c), z)
    for j in range(v.size):
        gains_and_slopes(factors, values, complex(0.0, v[j]), of[K], of[RATE], g)
        ω, chain = warp(T, v[j])
        response(terms, residues, T, delay, which[j], ω, chain, False, at, G)
        if curve[j] == LoopCurve.GS:
            response(free[0], free[1], 0.0, 0.0, which[j], ω, 1.0, False, at, FREE)
        fill_loop(into, out, of[K], at)
        σ, place = gain_of(
            curve[j], number[j], into, out, own, kinds, q, lever, which[j], at, of, sigma
        )
        kind = gain_kind(curve[j], number[j], p, kinds)
        columns = q if curve[j] == LoopCurve.GS else p
        if kind != GainOf.ROW:  # one entry of S has no other singular value
            columns = 1
        _by_channel(curve[j], number[j], kind, place, into, out, own, q, lever, which[j], at, of,
                    crossed, moved, back, ahead)  # fmt: skip
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
                for f in range(columns):
                    if f != place:
                        za = ahead[f, i] * g[a] + (back[f, i] * g[a]).conjugate()
                        zb = ahead[f, h] * g[b] + (back[f, h] * g[b]).conjugate()
                        total += za.conjugate() * zb * _over_gap(σ, sigma[f])
                first = (of[SHARE, i] * g[a]).real * (of[SHARE, h] * g[b]).real
                bends[j, a, b] = bends[j, b, a] = total.real - 2.0 * first
    return bends


@inlined
def _over_gap(σ, other):
    """1/(λ (λ - λ_m)), σ's gap to σ_m kept from zero."""
    gap, least = σ - other, 1e-2 * σ  # closer ones count as 1 % apart
    if abs(gap) < least:
        gap = -least if gap < 0.0 else least
    return 1.0 / (σ * σ * gap * (σ + other))


@inlined
def _by_channel(curve, number, kind, place, into, out, own, forces, lever, of_plant, at, of,
                crossed, moved, back, ahead):  # fmt: skip
    """Fill left_i K_i R_ij K_j right_j (c, c), (∂M v)ᴴ∂M v (c, c), and both parts of z_m (m, c) for
    ∂ln K_i = 1."""
    (m, c), p, at_actuator = into.shape, out.shape[1], kind == GainOf.ACTUATOR
    shared = m == 1 and p > 1
    one = over_one_plus_L(out, of[K], at) if shared else 1.0 + 0.0j
    of_force, counted = curve == LoopCurve.KS or at_actuator, lever.shape[1]
    rows, columns = m if of_force else p, forces if curve == LoopCurve.GS else p
    levered = curve == LoopCurve.GS and counted > 0
    if levered:
        rows = counted
    columns = 1 if kind != GainOf.ROW else columns
    z = np.complex128
    w = max(m, p, rows, columns)
    R, P, Q = np.zeros((c, c), z), np.zeros((w, c), z), np.zeros((w, c), z)
    for i in range(c):
        for h in range(c):
            for a in range(p):
                left = out[i, a] * one if shared else at[US, i, a]
                R[i, h] += left * at[GV, a, h]
            crossed[i, h] = of[LEFT, i] * of[K, i] * R[i, h] * of[K, h] * of[RIGHT, h]
    sign = 1.0 if curve == LoopCurve.T else -1.0
    for i in range(c):
        for a in range(rows):
            if of_force:
                P[a, i] = into[a, i]
                for h in range(c):
                    P[a, i] -= into[a, h] * of[K, h] * R[h, i]
                if at_actuator:
                    P[a, i] = -P[a, i]
            elif levered:
                for b in range(p):
                    for d in range(p):
                        P[a, i] -= lever[of_plant, a, d] * at[S, d, b] * at[GV, b, i]
                for b in range(m):
                    P[a, i] -= at[G, p + a, b] * into[b, i]
                    for h in range(c):
                        P[a, i] += at[G, p + a, b] * into[b, h] * of[K, h] * R[h, i]
            else:
                if shared:
                    P[a, i] = sign * at[GV, a, i] * one
                else:
                    for b in range(p):
                        P[a, i] += sign * at[S, a, b] * at[GV, b, i]
        for q in range(columns):
            for b in range(p):
                entry = at[V, b, q]
                if curve == LoopCurve.GS:
                    entry = 0.0j
                    for d in range(forces):
                        entry += at[FREE, b, d] * at[V, d, q]
                Q[q, i] += at[US, i, b] * entry
    if number >= p:
        row_of(own[int(of_force), number - p], P, rows, c)
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
