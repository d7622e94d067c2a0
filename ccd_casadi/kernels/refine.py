"""Closing a bracket around a local maximum of a gain over frequency."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled


@compiled
def parabola_vertex(a, fa, x, fx, b, fb):
    """Where the parabola through three points, a < x < b, is highest, and its value there.

    x itself where the points do not bend downwards.
    """
    left, right = (fx - fa) / (x - a), (fb - fx) / (b - x)
    bend = (left - right) / (b - a)
    if not bend > 0.0:
        return x, fx
    slope = left - bend * (x - a)  # the parabola's slope at x
    return x + 0.5 * slope / bend, fx + 0.25 * slope * slope / bend


@compiled
def next_trial(a, fa, x, fx, b, fb, tolerance):
    """The next ln ω to try in a bracket a < x < b with fx its best, and the gain it promises.

    The parabola's vertex, or the middle of the longer side where the vertex is no news. The
    promise is infinite where the parabola cannot be trusted, and 0 at the end: the bracket has
    closed, or a credible parabola promises less than `tolerance`, relative to fx.
    """
    vertex, top = parabola_vertex(a, fa, x, fx, b, fb)
    if b - a < 1e-12:
        return x, 0.0
    credible = max(fx - fa, fx - fb) < 0.1 * abs(fx)
    promise = top - fx if credible else np.inf
    if promise <= tolerance * abs(fx):
        return x, 0.0
    if not (a < vertex < b) or abs(vertex - x) < 1e-3 * (b - a):
        vertex = 0.5 * (a + x) if x - a > b - x else 0.5 * (x + b)
    return vertex, promise


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
