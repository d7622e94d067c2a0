"""One loop at one frequency: S, T, KS and GS, and their slopes to the controller's parameters."""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.linear_algebra import gain_bound, invert, jacobi_svd
from ccd_casadi.kernels.modes import response
from ccd_casadi.kernels.sections import (
    GainOf,
    LoopCurve,
    gains,
    gains_and_slopes,
    inverse,
    offset,
    warp,
)

# What a point, one plant's loop at one frequency, has of matrices (10, w, w) and of vectors (10, w)
G, DG, FREE, DFREE, GV, GK, S, US, M, V = range(10)  # GV = G V, US = Uᵀ S
# K_i, ∂ln K_i/∂ln v; U = ũ, W = v or G₀ v, SEEN = ũ or ũ H
K, RATE, U, W, LEFT, RIGHT, SHARE, X, Y, SEEN = range(10)


class LoopArrays(NamedTuple):
    """A controller of fixed structure and the plants that it runs on, as arrays.

    Attributes
    ----------
    factors, values : arrays
        Of the controller (`sections`).
    channel : int array (n,)
        Of each value.
    into, out : arrays (m, c), (c, p)
        V and Uᵀ.
    terms, residues, period, delay
        The plants (`modes.Plants`); below their p outputs y what else of the z errors N x counts.
    limits : array
        Rows of `sections.LoopCurve` and `sections.Limit`.
    rows : array (3, channels, m)
        Rows uᵀ of S and wᵀ of KS that channels bound for themselves, and directions r of a
        reference, in the plants' coordinates.
    kinds : int array (channels,)
        Of these, `sections.GainOf`.
    free : tuple of arrays
        Terms and residues of the plants as q disturbing forces move them.
    lever : array (P, z, p)
        H of what counts, H y + N x; z = 0: the outputs themselves do.
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
    kinds: Any
    free: Any
    lever: Any


@compiled
def room(loop):
    """Matrices, vectors, g (n,) and σ of a point, to be filled."""
    w = max(loop.into.shape[0], loop.into.shape[1])
    w = max(w, loop.free[1].shape[3], loop.free[1].shape[4])
    z = np.complex128
    return np.zeros((10, w, w), z), np.zeros((10, w), z), np.zeros(loop.values.size, z), np.zeros(w)


@compiled
def over_one_plus_L(out, k, at):
    """1/(1 + L), L = Σ K_i U_iᵀ G V_i, of one actuator; S G V = G V/(1 + L) there."""
    c, p = out.shape
    total = 1.0 + 0.0j
    for i in range(c):
        for a in range(p):
            total += k[i] * out[i, a] * at[GV, a, i]
    return inverse(total)


@compiled
def fill_loop(into, out, k, at):
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
    elif m == 1:  # GK = g kᵀ: I + GK is all but singular where |L| is large
        one = over_one_plus_L(out, k, at)
        for a in range(p):
            for b in range(p):
                at[S, a, b] = -at[GK, a, b] * one
            others = 1.0 + 0.0j  # 1 + L without what a has of it, the trace of GK being L
            for b in range(p):
                if b != a:
                    others += at[GK, b, b]
            at[S, a, a] = others * one
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
def matrix(curve, into, out, k, q, at):
    """Fills M of a curve, S G₀ of q forces; its rows and columns."""
    (m, c), p = into.shape, out.shape[1]
    if curve == LoopCurve.KS:
        for b in range(p):
            for a in range(m):
                total = 0.0j
                for i in range(c):
                    total += into[a, i] * (k[i] * at[US, i, b])
                at[M, a, b] = total
        return m, p
    columns = q if curve == LoopCurve.GS else p
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
def moved(into, out, k, q, lever, of_plant, at):
    """Fills M with what q forces move of z errors H y + N x

        H S G₀ + N₀ - N K S G₀

    of which each term is as large as the sum towards 0 Hz, where G₀ alone is not; z and q.
    """
    (m, c), p, z = into.shape, out.shape[1], lever.shape[1]
    for b in range(q):
        for a in range(z):
            total = at[FREE, p + a, b]
            for d in range(p):
                for e in range(p):
                    total += lever[of_plant, a, d] * at[S, d, e] * at[FREE, e, b]
            for i in range(c):
                force = 0.0j
                for d in range(p):
                    force += k[i] * at[US, i, d] * at[FREE, d, b]
                for e in range(m):
                    total -= at[G, p + a, e] * into[e, i] * force
            at[M, a, b] = total
    return z, q


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
def gain_kind(curve, number, p, kinds):
    """`GainOf` a number: one place alone of S and T where it says so, else rows and whole gains."""
    found = 0
    if number >= p and curve != LoopCurve.KS and curve != LoopCurve.GS:
        found = kinds[number - p]
    return found


@compiled
def own_gain(curve, i, into, out, k, own, kinds, q, at):
    """Gain of channel i's own; its row is in M's first row, of one place its entry."""
    (m, c), p = into.shape, out.shape[1]
    kind = gain_kind(curve, p + i, p, kinds)
    if kind == GainOf.ACTUATOR:  # (I + KG)⁻¹ = I - K S G, K = V diag(K_i) Uᵀ
        for a in range(m):
            for b in range(m):
                total = 1.0 + 0.0j if a == b else 0.0j
                for h in range(c):
                    inner = 0.0j
                    for d in range(p):
                        inner += at[US, h, d] * at[G, d, b]
                    total -= into[a, h] * k[h] * inner
                at[M, a, b] = total
        if m == 1 and p > 1:
            at[M, 0, 0] = over_one_plus_L(out, k, at)
        rows, columns = m, m
    else:
        rows, columns = matrix(curve, into, out, k, q, at)
    of_force = int(curve == LoopCurve.KS or kind == GainOf.ACTUATOR)
    length = row_of(own[of_force, i], at[M], rows, columns)
    if kind == GainOf.ROW:
        return length
    entry = 0.0j
    for b in range(columns):
        entry += at[M, 0, b] * own[2, i, b]
    at[M, 0, 0] = entry
    return abs(entry)


@compiled
def gain_of(curve, number, into, out, own, kinds, q, lever, of_plant, at, of, sigma):
    """σ of one gain and the column of its v in V; fills V, σ, ũ, x, right, left, share and y."""
    (m, c), p, z = into.shape, out.shape[1], lever.shape[1]
    kind, place = gain_kind(curve, number, p, kinds), number
    columns = q if curve == LoopCurve.GS else p
    rows = m if curve == LoopCurve.KS else p
    levered = curve == LoopCurve.GS and z > 0
    if levered:
        rows = z
        moved(into, out, of[K], q, lever, of_plant, at)
        jacobi_svd(at[M], rows, columns, at[V], sigma, True)
    elif number < p:
        matrix(curve, into, out, of[K], q, at)
        jacobi_svd(at[M], rows, columns, at[V], sigma, True)
    else:
        place = 0
        size = own_gain(curve, number - p, into, out, of[K], own, kinds, q, at)
        if kind == GainOf.ROW:
            jacobi_svd(at[M], 1, columns, at[V], sigma, True)
        else:
            columns = rows = m if kind == GainOf.ACTUATOR else p
            sigma[0] = size
            for b in range(columns):
                at[V, b, 0] = own[2, number - p, b]
    at_actuator = kind == GainOf.ACTUATOR
    shared = m == 1 and p > 1
    one = over_one_plus_L(out, of[K], at) if shared else 1.0 + 0.0j
    scale = 1.0 / (sigma[place] * sigma[place])
    for a in range(rows):
        if number < p:
            of[U, a] = at[M, a, place].conjugate() * scale
        else:
            row = own[int(curve == LoopCurve.KS or at_actuator), number - p, a]
            of[U, a] = row * at[M, 0, 0].conjugate() * scale
    for a in range(p):
        of[SEEN, a] = of[U, a]
    if levered:
        for a in range(p):
            of[SEEN, a] = 0.0j
            for b in range(z):
                of[SEEN, a] += of[U, b] * lever[of_plant, b, a]
    for a in range(p):
        total = 0.0j
        if curve == LoopCurve.GS:
            for b in range(q):
                total += at[FREE, a, b] * at[V, b, place]
        elif at_actuator:
            for b in range(m):
                total += at[G, a, b] * at[V, b, 0]
        else:
            total = at[V, a, place]
        of[W, a] = total
    for i in range(c):
        total = 0.0j
        for b in range(p):
            left = out[i, b] * one if shared and at_actuator else at[US, i, b]
            total += left * of[W, b]
        of[RIGHT, i], total = total, 0.0j
        if curve == LoopCurve.KS or at_actuator:
            for a in range(m):
                total += of[U, a] * into[a, i]
        elif levered:
            for a in range(z):
                for b in range(m):
                    total -= of[U, a] * at[G, p + a, b] * into[b, i]
        of[LEFT, i] = total  # so far ũᵀV, or -ũᵀN V
    sign = 1.0 if curve == LoopCurve.T else -1.0
    for b in range(p):
        total = 0.0j
        if curve == LoopCurve.KS or at_actuator or levered:
            for i in range(c):
                total -= of[LEFT, i] * of[K, i] * at[US, i, b]
        if not (curve == LoopCurve.KS or at_actuator):
            for a in range(p):
                total += sign * of[SEEN, a] * at[S, a, b]
        of[X, b] = total
    for a in range(z):
        of[X, p + a] = -of[U, a] if levered else 0.0j
    for i in range(c):
        total = of[LEFT, i]
        if shared:
            total *= one
            if curve != LoopCurve.KS and not at_actuator:
                for a in range(p):
                    total += sign * of[U, a] * at[GV, a, i] * one
        else:
            for a in range(p):
                total += of[X, a] * at[GV, a, i]
        if at_actuator:  # d(I + KG)⁻¹ = -(I + KG)⁻¹ dK S G, of KS it is (I + KG)⁻¹ dK S
            total = -total
        of[LEFT, i], of[SHARE, i] = total, total * of[K, i] * of[RIGHT, i]
    for a in range(m):
        total = 0.0j
        for i in range(c):
            total += into[a, i] * of[K, i] * of[RIGHT, i]
        if shared and at_actuator:
            total = at[V, a, 0] * one
        elif at_actuator:
            total = at[V, a, 0] - total
        of[Y, a] = total
    return sigma[place], place


@compiled
def levels(curves, which, v, loop, least, answers):
    """Evaluate ln of gains over their bounds.

    Parameters
    ----------
    curves : int array (N, C)
        Curves of each of N plants.
    which : int array (N,)
        The plants.
    v : array (N, k)
    loop : LoopArrays
    least : float
        A level that cannot exceed it is not computed.
    answers : Answers
        Responses of plants that are known.

    Returns
    -------
    array (N, k, C, numbers)
        -inf where none can be above `least`, and where there is no bound.
    """
    count, most = v.shape
    at, of, _, sigma = room(loop)
    factors, values, into, outputs = loop.factors, loop.values, loop.into, loop.out
    terms, residues, T, d = loop.terms, loop.residues, loop.period, loop.delay
    limits, own, places = loop.limits, loop.rows, answers.place
    free_terms, free_residues = loop.free
    q, lever, levered = free_residues.shape[4], loop.lever, loop.lever.shape[1] > 0
    k, matrix_room, vectors = of[K], at[M], at[V]
    p, numbers, m = outputs.shape[1], limits.shape[1], into.shape[0]
    out = np.full((count, most, curves.shape[1], numbers), -np.inf)
    sensitivity = np.empty(p)
    for i in range(count):
        for j in range(most):
            ω, chain = warp(T, v[i, j])
            gains(factors, values, complex(0.0, v[i, j]), k)
            place = places[i, j] if places.size else -1
            if place < 0:
                response(terms, residues, T, d, which[i], ω, chain, False, at, G)
            else:
                for a in range(answers.held.shape[2]):
                    for b in range(m):
                        at[G, a, b] = answers.held[which[i], place, a, b]
                for a in range(answers.free.shape[2]):
                    for b in range(q):
                        at[FREE, a, b] = answers.free[which[i], place, a, b]
            fill_loop(into, outputs, k, at)
            height, known = np.nan, False  # of S: ln of its largest gain, and of all others
            for c in range(curves.shape[1]):
                curve = curves[i, c]
                of_s = curve != LoopCurve.KS and curve != LoopCurve.T and curve != LoopCurve.GS
                if curve == LoopCurve.GS and place < 0:
                    response(free_terms, free_residues, 0.0, 0.0, which[i], ω, 1.0, False, at, FREE)
                rows, columns, top = p, p, height
                if not of_s or np.isnan(height):
                    if curve == LoopCurve.GS and levered:
                        rows, columns = moved(into, outputs, k, q, lever, which[i], at)
                    else:
                        rows, columns = matrix(curve, into, outputs, k, q, at)
                    top = abs(at[M, 0, 0])
                    if rows + columns > 2:
                        top = gain_bound(matrix_room, rows, columns)
                    top = np.log(top)
                    height = top if of_s else height
                level = offset(curve, 0, ω, chain, limits)[0]
                if rows + columns == 2:
                    out[i, j, c, 0] = top + level
                elif top + level > least:
                    if not (of_s and known):
                        if curve == LoopCurve.GS and levered:
                            moved(into, outputs, k, q, lever, which[i], at)
                        else:
                            matrix(curve, into, outputs, k, q, at)
                        jacobi_svd(matrix_room, rows, columns, vectors, sigma, False)
                    for number in range(p):
                        if of_s and not known:
                            sensitivity[number] = sigma[number]
                        gain = sensitivity[number] if of_s else sigma[number]
                        out[i, j, c, number] = np.log(gain) + level
                    known = known or of_s
                for number in range(p, numbers):
                    if limits[curve, number] < np.inf:
                        size = own_gain(curve, number - p, into, outputs, k, own, loop.kinds, q, at)
                        level = offset(curve, number, ω, chain, limits)[0]
                        out[i, j, c, number] = np.log(size) + level
    return out


@compiled
def rows(curve, number, which, v, loop):
    """Evaluate M rows and their derivatives.

    Rows at the same frequency of the same plant that follow each other share their loop.

    Parameters
    ----------
    curve, number, which : int arrays (M,)
        Curve, its number, plant.
    v : array (M,)
    loop : LoopArrays

    Returns
    -------
    value, slope : arrays (M,)
        ln of gain over bound, and its slope to ln v.
    to_kappa : array (M, n)
    x, y, w : complex arrays (M, p + z), (M, m), (M, q)
        Vectors of the slopes to the plant, w of GS.
    """
    at, of, g, sigma = room(loop)
    # Unpacked once: to hand all of them to a function costs as much as a row.
    factors, values, channel, into, out, terms, residues, T, delay = loop[:9]
    limits, own, kinds, free, lever = loop[9:]
    count, (m, c), p, q = v.size, into.shape, out.shape[1], free[1].shape[4]
    wide = p + lever.shape[1]
    value, slope, to_kappa = np.empty(count), np.empty(count), np.empty((count, g.size))
    x, y = np.empty((count, wide), np.complex128), np.empty((count, m), np.complex128)
    w = np.zeros((count, q), np.complex128)
    for j in range(count):
        before, of_gs, (ω, chain) = j - 1, curve[j] == LoopCurve.GS, warp(T, v[j])
        known = j > 0 and v[j] == v[before] and which[j] == which[before]
        if not known:
            gains_and_slopes(factors, values, complex(0.0, v[j]), of[K], of[RATE], g)
            response(terms, residues, T, delay, which[j], ω, chain, True, at, G)
            fill_loop(into, out, of[K], at)
        if of_gs and not (known and curve[before] == LoopCurve.GS):
            response(free[0], free[1], 0.0, 0.0, which[j], ω, 1.0, True, at, FREE)
        σ, place = gain_of(
            curve[j], number[j], into, out, own, kinds, q, lever, which[j], at, of, sigma
        )
        level, rise = offset(curve[j], number[j], ω, chain, limits)
        for i in range(c):
            rise += (of[SHARE, i] * of[RATE, i]).real
        for a in range(wide):
            x[j, a] = of[X, a]
            for b in range(m):
                rise += (of[X, a] * at[DG, a, b] * of[Y, b]).real
            if of_gs:
                for b in range(q):
                    rise -= chain * (of[X, a] * at[DFREE, a, b] * at[V, b, place]).real
        value[j], slope[j] = np.log(σ) + level, rise
        for a in range(g.size):
            to_kappa[j, a] = (of[SHARE, channel[a]] * g[a]).real
        for b in range(m):
            y[j, b] = of[Y, b]
        if of_gs:
            for b in range(q):
                w[j, b] = at[V, b, place]
    return value, slope, to_kappa, x, y, w


@compiled
def close(curve, number, which, start, low, high, loop, tolerances):
    """Refine local maxima by Illinois false position on the slope.

    A bracket that two steps do not halve is cut in the middle: where the slope is tiny at one end
    and large at the other, as with two maxima close to each other, false position alone is slow.

    Parameters
    ----------
    curve, number, which : int arrays (M,)
        Curve, its number, plant.
    start, low, high : arrays (M,)
        v, and brackets around it.
    loop : LoopArrays
    tolerances : tuple
        Slope that is flat, relative width of a bracket, steps.

    Returns
    -------
    top : array (M,)
        v; the start where the slopes of a bracket have one sign.
    closed_in : bool array (M,)
        Where they change sign.
    """
    flat, narrowest, most = tolerances
    top, closed_in = start.copy(), np.zeros(start.size, np.bool_)
    fa, end = rows(curve, number, which, start, loop)[1], low.copy()
    for j in range(start.size):
        if fa[j] > 0.0:
            end[j] = high[j]
    fb = rows(curve, number, which, end, loop)[1]
    a, b, x = np.log(start), np.log(end), np.empty(start.size)
    narrow, before, wider = np.empty(start.size), np.empty(start.size), np.empty(start.size)
    going, left = np.empty(start.size, np.int64), 0  # the brackets that are still too wide
    for j in range(start.size):
        if fa[j] * fb[j] < 0.0 and np.isfinite(fa[j]) and np.isfinite(fb[j]):
            closed_in[j], going[left] = True, j
            narrow[j] = narrowest * abs(b[j] - a[j])
            before[j], wider[j] = np.inf, np.inf  # widths one and two steps ago
            left += 1
    for _ in range(int(most)):
        going = going[:left]
        if left == 0:
            break
        for j in going:
            width = abs(b[j] - a[j])
            x[j] = b[j] - fb[j] * (b[j] - a[j]) / (fb[j] - fa[j])
            if width > 0.5 * wider[j]:
                x[j] = 0.5 * (a[j] + b[j])
            wider[j], before[j] = before[j], width
        fx = rows(curve[going], number[going], which[going], np.exp(x[going]), loop)[1]
        left = 0
        for k in range(fx.size):
            j = going[k]
            if fx[k] * fb[j] < 0.0:
                a[j], fa[j] = b[j], fb[j]
            else:
                fa[j] *= 0.5
            b[j], fb[j] = x[j], fx[k]
            if abs(fx[k]) >= flat and abs(b[j] - a[j]) > narrow[j]:
                going[left] = j
                left += 1
    for j in range(start.size):
        if closed_in[j]:
            top[j] = np.exp(b[j])
    return top, closed_in
