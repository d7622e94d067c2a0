"""Frequencies that resolve a loop: logarithmic, with points on the flanks of every resonance; and
the local maxima of a gain over them.
"""

from collections.abc import Callable

import numpy as np
import scipy

from ccd_casadi.support.arrays import Array

FLANKS = np.array([-3.0, -1.0, -0.4, 0.0, 0.4, 1.0, 3.0])  # in half widths of a root
FIRST, HALVINGS = 11, 16  # points between a maximum's neighbours, then of their spacing
LIGHT = 0.3  # damping ratio below which a pole or zero is a resonance


def root_flanks(roots: np.ndarray, flanks: Array = FLANKS) -> Array:
    """|Im p| + flank |Re p| (..., kf) of roots p (..., k) of any plane in 1/s, rad/s, unsorted."""
    found = np.abs(roots.imag)[..., None] + np.abs(roots.real)[..., None] * flanks
    return np.asarray(found.reshape(*roots.shape[:-1], -1))


def resonant(roots: np.ndarray) -> np.ndarray:
    """Those of the upper half plane with a damping ratio below 0.3, ascending by size."""
    upper = roots[roots.imag > 1e-9 * np.abs(roots)]
    upper = upper[np.abs(upper.real) < LIGHT * np.abs(upper)]
    return np.asarray(upper[np.argsort(np.abs(upper))])


def frequency_grid(
    low: float, high: float, points: int, *special: Array, apart: float = 0.0
) -> Array:
    """`points` frequencies evenly spread over ln ω from `low` to `high`, and special ones within.

    Ascending, each at least `apart` (relative) above the one before.
    """
    grid = np.unique(np.concatenate([np.geomspace(low, high, points), *special]))
    grid = grid[(grid >= low) & (grid <= high)]  # NaN compares false
    return np.asarray(grid[np.append(True, np.diff(grid) > apart * grid[1:])])


def thinned(values: Array, width: float) -> Array:
    """Those above 0, ascending: the least of each interval of ln ω that is so wide.

    >>> thinned(np.array([1.0, 1.01, 2.0, 1.02]), 0.1).tolist()
    [1.0, 2.0]
    """
    ascending = np.sort(values[values > 0.0])
    _, first = np.unique(np.floor(np.log(ascending) / width), return_index=True)
    return np.asarray(ascending[first])


def local_maxima(values: Array) -> np.ndarray:
    """Places inside the array that are above their left neighbour and not below their right one."""
    return np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1


def zoomed(function: Callable[[Array], Array], low: Array, high: Array) -> tuple[Array, Array]:
    """Where N brackets that close in on a maximum end, and its value; `function` of (N, k)."""
    if not len(low):
        return low, low
    points = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, FIRST)
    value = function(points)
    for _ in range(HALVINGS):
        inner = np.argmax(value[:, 1:-1], axis=1)[:, None] + np.arange(3)
        x, f = (np.take_along_axis(part, inner, axis=1) for part in (points, value))
        between = 0.5 * (x[:, :-1] + x[:, 1:])
        order = [0, 3, 1, 4, 2]
        points = np.concatenate([x, between], axis=1)[:, order]
        value = np.concatenate([f, function(between)], axis=1)[:, order]
    best = np.argmax(value, axis=1)[:, None]
    where, height = (np.take_along_axis(part, best, axis=1)[:, 0] for part in (points, value))
    return where, height


def refine_peak(
    gain: Callable[[float], float], low: float, high: float, xatol: float = 1e-10
) -> tuple[float, float]:
    """(ω, gain) at the local maximum between two frequencies above 0, by Brent's method in ln ω.

    `xatol`: in ln ω.
    """
    top = scipy.optimize.minimize_scalar(
        lambda x: -gain(float(np.exp(x))), bounds=(np.log(low), np.log(high)),
        method="bounded", options={"xatol": xatol},
    )  # fmt: skip
    return float(np.exp(top.x)), -float(top.fun)
