"""Sampling plans: which points of a box to spend the expensive evaluations on.

Every plan returns an (n, d) array in input units and is a function of its
arguments alone: the same seed gives the same points, bit for bit.
"""

from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from surrogates.interface import Array, box


class DesignKind(StrEnum):
    """Names of the sampling plans `design` knows."""

    GRID = "grid"
    SOBOL = "sobol"
    LHS = "lhs"


def grid(lower: ArrayLike, upper: ArrayLike, points_per_axis: int | list[int]) -> Array:
    """The full tensor grid, the last input running fastest, bounds included.

    Parameters
    ----------
    lower, upper : array (d,)
        The box.
    points_per_axis : int or sequence
        For all inputs or for each; an axis of one point is in the middle.

    Returns
    -------
    array (N, d)

    Raises
    ------
    ValueError
        Bad bounds, or fewer than one point on an axis.

    Examples
    --------
    >>> grid([0, 0], [1, 2], 2).tolist()
    [[0.0, 0.0], [0.0, 2.0], [1.0, 0.0], [1.0, 2.0]]
    """
    low, high = box(lower, upper)
    counts = np.broadcast_to(np.asarray(points_per_axis, dtype=int), low.shape)
    if (counts < 1).any():
        raise ValueError("a grid needs at least one point per axis")
    axes = [
        np.linspace(a, b, m) if m > 1 else np.array([0.5 * (a + b)])
        for a, b, m in zip(low, high, counts, strict=True)
    ]
    mesh = np.meshgrid(*axes, indexing="ij")
    return np.stack([m.ravel() for m in mesh], axis=1)


def corners(lower: ArrayLike, upper: ArrayLike) -> Array:
    """The corners of the box, to add to a plan that avoids them.

    Parameters
    ----------
    lower, upper : array (d,)
        The box.

    Returns
    -------
    array (2^d, d)
    """
    return grid(lower, upper, 2)


def sobol(lower: ArrayLike, upper: ArrayLike, n: int, seed: int) -> Array:
    """n points of a scrambled Sobol sequence [1]_; plans of one seed are nested.

    Balanced are its first 2^m points: for another n the next power of two is drawn and cut.

    Parameters
    ----------
    lower, upper : array (d,)
        The box.
    n, seed : int
        Number of points, and seed of the scrambling.

    Returns
    -------
    array (n, d)

    Raises
    ------
    ValueError
        Bad bounds, or n < 1.

    .. [1] Owen, "Scrambling Sobol' and Niederreiter-Xing points", J. Complexity 1998.
    """
    from scipy.stats import qmc  # 0.5 s to import, so only where it is needed

    low, high = _box(lower, upper, n)
    sequence = qmc.Sobol(low.size, scramble=True, rng=np.random.default_rng(seed))
    return _spread(sequence.random_base2((n - 1).bit_length())[:n], low, high)


def latin_hypercube(lower: ArrayLike, upper: ArrayLike, n: int, seed: int) -> Array:
    """n points, exactly one in each of the n slices of every input (McKay et al., 1979).

    Parameters
    ----------
    lower, upper : array (d,)
        The box.
    n, seed : int
        Number of points, and seed.

    Returns
    -------
    array (n, d)

    Raises
    ------
    ValueError
        Bad bounds, or n < 1.
    """
    from scipy.stats import qmc

    low, high = _box(lower, upper, n)
    cells = qmc.LatinHypercube(low.size, rng=np.random.default_rng(seed))
    return _spread(cells.random(n), low, high)


def design(
    kind: DesignKind | str, lower: ArrayLike, upper: ArrayLike, n: int, seed: int = 0
) -> Array:
    """The plan named `kind` over a box.

    Parameters
    ----------
    kind : DesignKind or str
        "grid", "sobol" or "lhs".
    lower, upper : array (d,)
        The box.
    n, seed : int
        Points along each axis of a grid, else all points; seed of the others.

    Returns
    -------
    array (N, d)

    Raises
    ------
    ValueError
        Unknown kind, bad bounds or n < 1.

    Examples
    --------
    >>> design("lhs", [0.0], [1.0], 4, seed=1).shape
    (4, 1)
    """
    match DesignKind(kind):
        case DesignKind.GRID:
            return grid(lower, upper, n)
        case DesignKind.SOBOL:
            return sobol(lower, upper, n, seed)
        case DesignKind.LHS:
            return latin_hypercube(lower, upper, n, seed)


def _box(lower: ArrayLike, upper: ArrayLike, n: int) -> tuple[Array, Array]:
    if n < 1:
        raise ValueError(f"a plan needs at least one point, got n = {n}")
    return box(lower, upper)


def _spread(unit: Array, low: Array, high: Array) -> Array:
    # qmc.scale can overshoot the upper bound by one rounding; the sampled function
    # may be undefined there.
    return np.clip(low + unit * (high - low), low, high)
