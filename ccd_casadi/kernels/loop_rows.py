"""Gains of the loops of all plants over their bounds: on grids, at peaks, and closing in on peaks.

See `loop_point` for the matrices, their derivatives and what a loop is made of.
"""

import numpy as np

from ccd_casadi.kernels.compiled import compiled
from ccd_casadi.kernels.limits import LoopCurve, offset, warped
from ccd_casadi.kernels.loop_point import (
    FREE,
    SHARE,
    G,
    K,
    M,
    V,
    X,
    Y,
    closed,
    matrix,
    opened,
    room,
    row_of,
    value_and_slope,
)
from ccd_casadi.kernels.modes import response
from ccd_casadi.kernels.sections import gains
from ccd_casadi.kernels.small import largest_gain, singular


@compiled
def levels(curves, which, v, loop, least):
    """ln of the gains over their bounds, (N, k, curves, numbers), of the curves (N, C) of each of N
    plants `which` at v (N, k); -inf where none can be above `least`, and where nothing bounds one.
    """
    count, most = v.shape
    at, of, _, sigma = room(loop)
    factors, values, into, outputs = loop.factors, loop.values, loop.into, loop.out
    terms, residues, T, d = loop.terms, loop.residues, loop.period, loop.delay
    limits, own = loop.limits, loop.rows
    k, matrix_room, vectors = of[K], at[M], at[V]
    p, numbers = outputs.shape[1], limits.shape[1]
    out = np.full((count, most, curves.shape[1], numbers), -np.inf)
    sensitivity = np.empty(p)
    for i in range(count):
        for j in range(most):
            ω, chain = warped(T, v[i, j])
            gains(factors, values, complex(0.0, v[i, j]), k)
            response(terms, residues, T, d, which[i], v[i, j], False, at, G)
            closed(into, outputs, k, at)
            largest, known = np.nan, False  # of S
            for c in range(curves.shape[1]):
                curve = curves[i, c]
                of_s = curve != LoopCurve.KS and curve != LoopCurve.T and curve != LoopCurve.GS
                if curve == LoopCurve.GS:
                    response(terms, residues, 0.0, 0.0, which[i], ω, False, at, FREE)
                rows, columns, top = p, p, largest
                if not of_s or np.isnan(largest):
                    rows, columns = matrix(curve, into, outputs, k, at)
                    top = abs(at[M, 0, 0])
                    if rows + columns > 2:
                        top = largest_gain(matrix_room, rows, columns)
                largest = top if of_s else largest
                level = offset(curve, 0, ω, chain, limits)[0]
                if rows + columns == 2:
                    out[i, j, c, 0] = np.log(top) + level
                elif np.log(top) + level > least:
                    if not (of_s and known):
                        matrix(curve, into, outputs, k, at)
                        singular(matrix_room, rows, columns, vectors, sigma, False)
                    for number in range(p):
                        if of_s and not known:
                            sensitivity[number] = sigma[number]
                        gain = sensitivity[number] if of_s else sigma[number]
                        out[i, j, c, number] = np.log(gain) + level
                    known = known or of_s
                for number in range(p, numbers):
                    if limits[curve, number] < np.inf:
                        matrix(curve, into, outputs, k, at)
                        row = own[int(curve == LoopCurve.KS), number - p]
                        size = row_of(row, matrix_room, rows, columns)
                        level = offset(curve, number, ω, chain, limits)[0]
                        out[i, j, c, number] = np.log(size) + level
    return out


@compiled
def rows(curve, number, which, v, loop):
    """M rows: value, slope to ln v, ∂c/∂κ (M, n); x (M, p), y and v (M, m) for those to the plant.

    Rows at the same frequency of the same plant that follow each other share their loop.
    """
    at, of, g, sigma = room(loop)
    channel, count, m, p = loop.channel, v.size, loop.into.shape[0], loop.out.shape[1]
    value, slope, to_kappa = np.empty(count), np.empty(count), np.empty((count, g.size))
    x, sides = np.empty((count, p), np.complex128), np.zeros((2, count, m), np.complex128)
    for j in range(count):
        before = j - 1
        known = j > 0 and v[j] == v[before] and which[j] == which[before]
        if not known or (curve[j] == LoopCurve.GS and curve[before] != LoopCurve.GS):
            opened(curve[j], which[j], v[j], loop, at, of, g)
        found = value_and_slope(curve[j], number[j], v[j], loop, at, of, sigma)
        value[j], slope[j], place = found
        for a in range(g.size):
            to_kappa[j, a] = (of[SHARE, channel[a]] * g[a]).real
        for a in range(p):
            x[j, a] = of[X, a]
        for b in range(m):
            sides[0, j, b] = of[Y, b]
            if b < p or curve[j] == LoopCurve.GS:
                sides[1, j, b] = at[V, b, place]
    return value, slope, to_kappa, x, sides[0], sides[1]


@compiled
def close(curve, number, which, start, low, high, loop, tolerances):
    """Local maxima by Illinois false position on the slope, in brackets [low, high] around start.

    A bracket that two steps do not halve is cut in the middle: where the slope is tiny at one end
    and large at the other, as with two maxima about to part, false position alone creeps. Where a
    bracket's slopes do not change sign (an end) the start stays; second: where they do.
    """
    flat, narrowest, most = tolerances
    top, closed_in = start.copy(), np.zeros(start.size, np.bool_)
    point = room(loop)
    for j in range(start.size):
        row = (curve[j], number[j], which[j])
        a = np.log(start[j])
        fa = slope_at(row, start[j], loop, point)
        end = high[j] if fa > 0.0 else low[j]
        b = np.log(end)
        fb = slope_at(row, end, loop, point)
        if not (fa * fb < 0.0 and np.isfinite(fa) and np.isfinite(fb)):
            continue
        closed_in[j] = True
        narrow = narrowest * abs(b - a)
        before, wider = np.inf, np.inf  # widths one and two steps ago
        for _ in range(int(most)):
            width = abs(b - a)
            x = 0.5 * (a + b) if width > 0.5 * wider else b - fb * (b - a) / (fb - fa)
            wider, before = before, width
            fx = slope_at(row, np.exp(x), loop, point)
            if fx * fb < 0.0:
                a, fa = b, fb
            else:
                fa *= 0.5
            b, fb = x, fx
            if abs(fx) < flat or abs(b - a) <= narrow:
                break
        top[j] = np.exp(b)
    return top, closed_in


@compiled
def slope_at(row, v, loop, point):
    """That of a row (curve, number, plant) to ln v."""
    curve, number, i = row
    at, of, g, sigma = point
    opened(curve, i, v, loop, at, of, g)
    return value_and_slope(curve, number, v, loop, at, of, sigma)[1]
