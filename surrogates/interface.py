"""What every surrogate of this package offers, and nothing more.

A new kind is a frozen dataclass with the attributes below, one
`casadi_export.expression` registration, one entry in `serialise.KINDS` and one in
`fitting`; no other module has to know about it.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class SurrogateFitError(ValueError):
    """The samples given cannot be fitted: wrong shapes, non-finite, singular."""


@dataclass(frozen=True)
class Errors:
    """Prediction errors on samples left out: rms and max in output units, Q² ≤ 1.

    Q² = 1 - Σ (y - ŷ)² / Σ (y - ȳ)²: 1 is exact, 0 no better than the mean. For
    samples that do not vary it is 1 if they are predicted exactly and 0 otherwise.
    """

    rms: float
    max: float
    q2: float


class Surrogate(Protocol):
    """A smooth scalar function of d inputs that stands in for an expensive one."""

    @property
    def lower(self) -> Array:
        """Lower bounds (d,) of the sampled box, in input units."""

    @property
    def upper(self) -> Array:
        """Upper bounds (d,) of the sampled box, in input units."""

    @property
    def left_out(self) -> Array:
        """Residuals (n,) of the samples, each predicted without it, in output units."""

    @property
    def loo(self) -> Errors:
        """The errors that `left_out` amounts to."""

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...


def box(lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    """Return the bounds of a box as float arrays (d,), lower < upper and finite.

    Raises:
        ValueError: the bounds differ in shape, are not finite or not increasing.
    """
    low = np.array(lower, dtype=float, ndmin=1)
    high = np.array(upper, dtype=float, ndmin=1)
    if low.ndim != 1 or low.shape != high.shape or low.size == 0:
        raise ValueError(f"bounds must be two vectors of one length, got {low.shape}, {high.shape}")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise ValueError("bounds must be finite with lower < upper in every input")
    return low, high


def points_in(surrogate: Surrogate, X: ArrayLike) -> Array:
    """Return X as points (m, d) of the surrogate's inputs; a single point (d,) is one row.

    Raises:
        ValueError: X does not have the inputs of the box.
    """
    points = np.atleast_2d(np.asarray(X, dtype=float))
    if points.ndim != 2 or points.shape[1] != surrogate.lower.size:
        raise ValueError(f"expected points (m, {surrogate.lower.size}), got {points.shape}")
    return points


def freeze(*arrays: Array) -> None:
    """Make arrays that whoever holds the surrogate shares read-only."""
    for array in arrays:
        array.flags.writeable = False
