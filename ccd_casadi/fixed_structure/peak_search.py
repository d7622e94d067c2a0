"""Every local peak of curves of a set's loops: a grid that misses none, and their exact maxima.

The grid runs through every pole and zero of plants, controller and closed loops with its flanks:
a rational function has no narrower peak than these. A local maximum on it is closed on the zero of
its exact slope.
"""

from collections.abc import Callable

import numpy as np

from ccd_casadi.fixed_structure.loop_problem import (
    LoopProblem,
    flanked,
)
from ccd_casadi.support.arrays import Array

APART = 1e-8  # relative: grid points that are closer count as one
CLOSINGS = 40  # of a peak's bracket at most; most need four, a curve's kink all
FLAT = 1e-9  # slope at a maximum
NARROW = 1e-6  # of its first width: a bracket that is left alone, as at a kink


def frequency_grid(
    problem: LoopProblem,
    controller: tuple[np.ndarray, np.ndarray],
    poles: np.ndarray,
) -> tuple[Array, np.ndarray]:
    """The frequencies v (P, k), ascending, on which peaks are looked for; which are of the base.

    `controller`: the zeros and the poles of K.
    """
    own = np.concatenate(controller)
    own = np.tile(own[np.abs(own) > 0.0], (len(poles), 1))
    joint = np.concatenate([problem.fixed, flanked(own), flanked(poles)], axis=1)
    bottom, top = problem.base[0], problem.base[-1]
    # Points that fall together would hide a peak between them: spares go below the base instead.
    spare = np.broadcast_to(bottom * np.linspace(0.5, 0.99, joint.shape[1]), joint.shape)
    joint = np.where((joint >= bottom) & (joint <= top), joint, spare)
    order = np.argsort(joint, axis=1, kind="stable")
    v = np.take_along_axis(joint, order, axis=1)
    twice = np.zeros(v.shape, bool)
    twice[:, 1:] = np.diff(v, axis=1) < APART * v[:, 1:]
    regular = (order < len(problem.base)) & ~twice
    v = np.where(twice, spare * 0.5, v)
    order = np.argsort(v, axis=1)
    v, regular = np.take_along_axis(v, order, axis=1), np.take_along_axis(regular, order, axis=1)
    # Conjugate roots fall together, so that nearly half were spares; one below the base is enough.
    useless = slice(1, max(1, int((v < bottom).sum(axis=1).min())))
    return np.delete(v, useless, axis=1), np.delete(regular, useless, axis=1)


def closed_on_zero(
    slope: Callable[[Array, np.ndarray], Array], start: Array, low: Array, high: Array
) -> tuple[Array, np.ndarray]:
    """Local maxima by Illinois false position on the slope, in brackets [low, high] around start.

    A bracket that two steps do not halve is cut in the middle: where the slope is tiny at one end
    and large at the other, as with two maxima about to part, false position alone creeps.
    `slope` takes logarithms and the indices of the brackets that they are in. Where a bracket's
    slopes do not change sign (an end) the start stays; second: where they do.
    """
    if not len(start):
        return start, np.zeros(0, bool)
    every = np.arange(len(start))
    middle = np.log(start)
    f = slope(middle, every)
    other = np.where(f > 0.0, np.log(high), np.log(low))
    g = slope(other, every)
    a, fa, b, fb = middle.copy(), f.copy(), other, g
    inside = (fa * fb < 0.0) & np.isfinite(fa) & np.isfinite(fb)
    left = np.flatnonzero(inside)
    before, wider = np.full((2, len(start)), np.inf)  # widths one and two steps ago
    narrow = NARROW * np.abs(b - a)
    for _ in range(CLOSINGS):
        if not len(left):
            break
        A, FA, B, FB = a[left], fa[left], b[left], fb[left]
        width = np.abs(B - A)
        creeping = width > 0.5 * wider[left]
        wider[left], before[left] = before[left], width
        x = np.where(creeping, 0.5 * (A + B), B - FB * (B - A) / (FB - FA))
        fx = slope(x, left)
        opposite = fx * FB < 0.0
        a[left], fa[left] = np.where(opposite, B, A), np.where(opposite, FB, 0.5 * FA)
        b[left], fb[left] = x, fx
        left = left[(np.abs(fx) >= FLAT) & (np.abs(b - a) > narrow)[left]]
    return np.exp(np.where(inside, b, middle)), inside
