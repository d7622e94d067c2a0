"""What every module of this package shares: arrays, boxes, errors of prediction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class SurrogateFitError(ValueError):
    """The samples given cannot be fitted: wrong shapes, non-finite, singular."""


@dataclass(frozen=True)
class Errors:
    """Prediction errors on samples left out.

    Parameters
    ----------
    rms, max : float
        In output units.
    q2 : float
        Q² = 1 - Σ (y - ŷ)² / Σ (y - ȳ)²: 1 is exact, 0 no better than the mean. Of samples that do
        not vary it is 1 if they are predicted exactly and 0 otherwise.
    """

    rms: float
    max: float
    q2: float


def errors(residuals: ArrayLike, Y: ArrayLike) -> Errors:
    """Summarise residuals y - ŷ at samples.

    Parameters
    ----------
    residuals, Y : array (n,)
        In output units.

    Returns
    -------
    Errors

    Examples
    --------
    >>> errors([0.0, 3.0, 4.0], [0.0, 5.0, 10.0])
    Errors(rms=2.886751345948129, max=4.0, q2=0.5)
    """
    e = np.asarray(residuals, dtype=float)
    y = np.asarray(Y, dtype=float)
    wrong = float(e @ e)
    spread = float(np.sum((y - y.mean()) ** 2))
    q2 = 1.0 - wrong / spread if spread > 0.0 else float(wrong == 0.0)
    return Errors(float(np.sqrt(wrong / e.size)), float(np.abs(e).max()), q2)


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


def freeze(*arrays: Array) -> None:
    """Make arrays that whoever holds the surrogate shares read-only."""
    for array in arrays:
        array.flags.writeable = False
