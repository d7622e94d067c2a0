"""Closing a bracket around a local maximum of a gain over frequency."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled


@compiled
def _vertex(a, fa, x, fx, b, fb):
    """Where the parabola through three points, a < x < b, is highest; x if it bends upwards."""
    left, right = (fx - fa) / (x - a), (fb - fx) / (b - x)
    bend = (left - right) / (b - a)
    return x + 0.5 * (left / bend - (x - a)) if bend > 0.0 else x


@compiled
def promised(a, fa, x, fx, b, fb):
    """How far the parabola through three points, a < x < b, rises above fx; inf: it bends upwards.

    Points beside a pole are not evenly spread: a formula for even steps would promise too little.
    """
    left, right = (fx - fa) / (x - a), (fb - fx) / (b - x)
    bend = (left - right) / (b - a)
    return 0.25 * (left - bend * (x - a)) ** 2 / bend if bend > 0.0 else np.inf


@compiled
def next_trial(a, fa, x, fx, b, fb, tolerance):
    """The next ln ω to try in a bracket a < x < b with fx its best, and the room for a gain.

    The parabola's vertex; where that is x itself, a point a little way into the longer side, so
    that the bracket closes from both. The room is the larger drop to the bracket's ends: what a
    parabola may still promise is no measure, it can be zero by the symmetry of three points. It
    comes back as 0 once below `tolerance`, relative to fx, or when the bracket has closed.
    """
    room = max(fx - fa, fx - fb)
    if b - a < 1e-12 or room <= tolerance * abs(fx):
        return x, 0.0
    vertex = _vertex(a, fa, x, fx, b, fb)
    if not (a < vertex < b) or abs(vertex - x) < 1e-2 * (b - a):
        vertex = x - 0.1 * (x - a) if x - a > b - x else x + 0.1 * (b - x)
    return vertex, room


@compiled
def narrow(a, fa, x, fx, b, fb, new, f):
    """The bracket once `new` has been tried."""
    if f > fx:
        if new > x:
            return x, fx, new, f, b, fb
        return a, fa, new, f, x, fx
    if new > x:
        return a, fa, x, fx, new, f
    return new, f, x, fx, b, fb
