"""What every surrogate of this package offers, and nothing more.

A new member (polynomial, radial basis functions, network) is a frozen dataclass
with the attributes below, one `casadi_export.expression` registration and one
entry in `serialise.KINDS`; no other module has to know about it.
"""

from typing import Literal, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class SurrogateFitError(ValueError):
    """The samples given cannot be fitted: wrong shapes, non-finite, singular."""


class Surrogate(Protocol):
    """A smooth scalar function of d inputs that stands in for an expensive one."""

    @property
    def lower(self) -> Array:
        """Lower bounds (d,) of the sampled box, in input units."""

    @property
    def upper(self) -> Array:
        """Upper bounds (d,) of the sampled box, in input units."""

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
