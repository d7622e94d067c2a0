"""Frequency grids through poles and zeros, and local maxima refined on them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class RootOptions:
    """Frequencies around a pole or zero.

    Attributes
    ----------
    flanks : tuple of float
        In half widths of the root: |Im p| + flank |Re p|.
    """

    flanks: tuple[float, ...] = (-3.0, -1.0, -0.4, 0.0, 0.4, 1.0, 3.0)


def root_flanks(roots: np.ndarray, flanks: Sequence[float] | Array = RootOptions.flanks) -> Array:
    """Place frequencies around poles or zeros p: |Im p| + flank |Re p|.

    Parameters
    ----------
    roots : array (..., k)
        Of any plane in 1/s.
    flanks : sequence of float (f,)
        In half widths of a root.

    Returns
    -------
    array (..., k f)
        rad/s, unsorted.
    """
    found = np.abs(roots.imag)[..., None] + np.abs(roots.real)[..., None] * np.array(flanks)
    return np.asarray(found.reshape(*roots.shape[:-1], -1))


def resonant(roots: np.ndarray, *, light: float = 0.3) -> np.ndarray:
    """Select the resonances among poles or zeros.

    Parameters
    ----------
    roots : complex array (k,)
        1/s.
    light : float
        Damping ratio below which a root is a resonance.

    Returns
    -------
    complex array
        Those of the upper half-plane, ascending by size.
    """
    upper = roots[roots.imag > 1e-9 * np.abs(roots)]
    upper = upper[np.abs(upper.real) < light * np.abs(upper)]
    return np.asarray(upper[np.argsort(np.abs(upper))])


def frequency_grid(
    low: float, high: float, points: int, *special: Array, apart: float = 0.0
) -> Array:
    """Make a grid of frequencies, evenly spread over ln ω, and special ones within.

    Parameters
    ----------
    low, high : float
        Ends, rad/s.
    points : int
        Evenly spread ones.
    *special : arrays
        Further frequencies, rad/s; those outside are dropped.
    apart : float
        Least relative distance from the one before.

    Returns
    -------
    array (g,)
        Ascending.
    """
    grid = np.unique(np.concatenate([np.geomspace(low, high, points), *special]))
    grid = grid[(grid >= low) & (grid <= high)]  # NaN compares false
    return np.asarray(grid[np.append(True, np.diff(grid) > apart * grid[1:])])


def thin(values: Array, width: float) -> Array:
    """Keep the least value of each interval of ln ω.

    Parameters
    ----------
    values : array
        Those above 0 are taken.
    width : float
        Of an interval.

    Returns
    -------
    array
        Ascending.

    Examples
    --------
    >>> thin(np.array([1.0, 1.01, 2.0, 1.02]), 0.1).tolist()
    [1.0, 2.0]
    """
    ascending = np.sort(values[values > 0.0])
    _, first = np.unique(np.floor(np.log(ascending) / width), return_index=True)
    return np.asarray(ascending[first])


def local_maxima(values: Array) -> np.ndarray:
    """Find the entries above their left neighbour and not below their right one.

    Parameters
    ----------
    values : array (n,)

    Returns
    -------
    int array
        Their places, from 1 to n - 2.
    """
    return np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1


def zoom(
    function: Callable[[Array], Array],
    low: Array,
    high: Array,
    *,
    first: int = 11,
    halvings: int = 16,
) -> tuple[Array, Array]:
    """Refine N local maxima, each in its bracket, by halving the spacing of points.

    Parameters
    ----------
    function : callable
        array (N, k) -> array (N, k).
    low, high : arrays (N,)
        Brackets.
    first : int
        Points of a bracket at first.
    halvings : int

    Returns
    -------
    where, height : arrays (N,)
    """
    if not len(low):
        return low, low
    points = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, first)
    value = function(points)
    for _ in range(halvings):
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
    """Refine a local maximum by Brent's method in ln ω.

    Parameters
    ----------
    gain : callable
        ω -> gain.
    low, high : float
        Bracket above 0, rad/s.
    xatol : float
        Tolerance in ln ω.

    Returns
    -------
    ω, gain : float
    """
    top = scipy.optimize.minimize_scalar(
        lambda x: -gain(float(np.exp(x))), bounds=(np.log(low), np.log(high)),
        method="bounded", options={"xatol": xatol},
    )  # fmt: skip
    return float(np.exp(top.x)), -float(top.fun)
