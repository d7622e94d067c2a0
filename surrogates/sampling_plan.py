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
    """Return the full tensor grid, last input running fastest, bounds included.

    n = Π_j points_per_axis_j rows; an axis of one point sits at the middle.

    Raises:
        ValueError: bad bounds, or fewer than one point on an axis.

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
    """Return the 2^d corners of the box, to add to a plan that avoids them."""
    return grid(lower, upper, 2)


def sobol(lower: ArrayLike, upper: ArrayLike, n: int, seed: int) -> Array:
    """Return n points (n, d) of a scrambled Sobol sequence.

    The balance of the sequence is a property of its first 2^m points. For another
    n the next power of two is drawn and cut, so that plans of one seed are nested:
    `sobol(..., n)` is the head of `sobol(..., m)` for every m > n.

    Raises:
        ValueError: bad bounds, or n < 1.

    Source: Owen, "Scrambling Sobol' and Niederreiter-Xing points", J. Complexity 1998.
    """
    from scipy.stats import qmc  # 0.5 s to import, so only where it is needed

    low, high = box(lower, upper)
    _positive(n)
    sequence = qmc.Sobol(low.size, scramble=True, rng=np.random.default_rng(seed))
    return _spread(sequence.random_base2((n - 1).bit_length())[:n], low, high)


def latin_hypercube(lower: ArrayLike, upper: ArrayLike, n: int, seed: int) -> Array:
    """Return n points (n, d), exactly one in each of the n slices of every input.

    Raises:
        ValueError: bad bounds, or n < 1.

    Source: McKay, Beckman and Conover, Technometrics 1979.
    """
    from scipy.stats import qmc

    low, high = box(lower, upper)
    _positive(n)
    return _spread(
        qmc.LatinHypercube(low.size, rng=np.random.default_rng(seed)).random(n), low, high
    )


def design(
    kind: DesignKind | str, lower: ArrayLike, upper: ArrayLike, n: int, seed: int = 0
) -> Array:
    """Return the plan named `kind`; n is the points per axis for 'grid', else all points.

    Raises:
        ValueError: unknown kind, bad bounds or n < 1.

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


def _positive(n: int) -> None:
    if n < 1:
        raise ValueError(f"a plan needs at least one point, got n = {n}")


def _spread(unit: Array, low: Array, high: Array) -> Array:
    # qmc.scale can overshoot the upper bound by one rounding; the sampled function
    # may be undefined there.
    return np.clip(low + unit * (high - low), low, high)
