"""How far from the model something holds: a walk whose steps no narrow loss slips through.

The caller's steps resolve what he knows of the function. A local maximum between two steps that
might reach zero is climbed; what is found there is closed in on.
"""

from collections.abc import Callable, Sequence

from scipy.optimize import minimize_scalar

FIRST = 1e-4  # the first step; then they grow to the caller's
GROWTH = 1.6
CLOSE = 1e-4  # relative: of an end, and how near to the model none is told from none
LEAST = 1e-9

Function = Callable[[float], float]


def reach(f: Function, step: Function, limit: float, marks: Sequence[float] = ()) -> float:
    """The largest x in [0, `limit`] up to which f <= 0, which f(0) is taken to be.

    `step` at x is how far the next place may lie; `marks` are places that are asked besides.

    >>> round(reach(lambda x: 1e-6 - (x - 0.3) ** 2, lambda x: 0.05, 1.0), 4)
    0.299
    """
    ahead = sorted(mark for mark in {*marks, limit} if 0.0 < mark <= limit)
    before, x, fx, width = None, 0.0, f(0.0), FIRST
    while x < limit:
        width = min(GROWTH * width, step(x))
        place = min(x + width, next(mark for mark in ahead if mark > x))
        value = f(place)
        if value > 0.0:
            return _end(f, x, place)
        if before is not None:
            top = highest(f, (before[0], x, place), (before[1], fx, value))
            if top is not None and f(top) > 0.0:
                return _end(f, max(y for y in (before[0], x) if y < top), top)
        before, x, fx = (x, fx), place, value
    return limit


def highest(f: Function, places: Sequence[float], values: Sequence[float]) -> float | None:
    """Where the local maximum is that three neighbours bracket; None where it stays below zero.

    A parabola rises above its middle place by less than by what that is above the lower of the
    others.
    """
    left, middle, right = values
    if middle < max(left, right) or 2.0 * middle - min(left, right) <= 0.0:
        return None
    options = {"xatol": 1e-5 * (places[2] - places[0]) + LEAST}
    found = minimize_scalar(lambda x: -f(float(x)), bounds=(places[0], places[2]),
                            method="bounded", options=options)  # fmt: skip
    return float(found.x) if -found.fun >= middle else places[1]


def _end(f: Function, inside: float, outside: float) -> float:
    while outside - inside > max(LEAST, CLOSE * outside):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if f(middle) <= 0.0 else (inside, middle)
    return inside
