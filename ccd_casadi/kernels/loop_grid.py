"""Frequencies through every root of a set's loops, and the maxima of curves over them."""

from typing import Any, NamedTuple

import numpy as np

from ccd_casadi.kernels.compiled import compiled


class Answers(NamedTuple):
    """Of most frequencies only the controller changes during a search: what plants answer there.

    G and G without hold and delay (P, F, p, m), and the `place` (P, k) of each frequency among
    them, -1 where it is none. Without places (0, 0) nothing is known.
    """

    place: Any
    held: Any
    free: Any


NONE = Answers(np.zeros((0, 0), np.int64), *np.zeros((2, 0, 0, 1, 1), complex))


@compiled
def merged(fixed, roots, poles, flanks, ends, apart, far):
    """Frequencies v (P, k), ascending, and the place of each in `fixed` (P, F), or -1.

    `fixed`, the flanks and sizes of the `roots` (R,) of the controller and of the `poles` (P, n) of
    the loops, from the first of `ends` on, and one `far` past the last root and the other end.
    Points nearer than `apart` (relative) would hide a peak between them, and count once. Below the
    first are spares: one, or as many as a plant has fewer points than another.
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
    """Local maxima above `depth` of levels (P, k, C, numbers) at v (P, k), which stop at `end` (C,
    numbers): their indices (N, 4), and v at their neighbours (N, 2)."""
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
def unseen(value, v, least):
    """Steps of the grid near a bound (above `least`) in which a flat maximum may lie that no point
    shows: plant, curve and number (N, 3), and the ends in v (N, 2).

    A parabola through a step and the point before it ends with a slope of the other sign.
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
