"""The box that variables are searched in, and points of it as shares z of its sides, 0 to 1."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ccd_casadi.support.arrays import Array


class Box(NamedTuple):
    """lower <= x <= upper, both (n,)."""

    lower: Array
    upper: Array

    @property
    def width(self) -> Array:
        """Of its sides (n,)."""
        return self.upper - self.lower

    def shares(self, x: ArrayLike) -> Array:
        """z of points x (…, n)."""
        return np.asarray(np.subtract(x, self.lower) / self.width)

    def point(self, z: Array) -> Array:
        """x of points z (…, n), kept in the box against rounding."""
        return np.clip(self.lower + self.width * z, self.lower, self.upper)

    def away(self, x: ArrayLike, other: ArrayLike) -> Array:
        """The largest component of x - other (…, n), in shares."""
        return np.asarray(np.abs(np.subtract(x, other) / self.width).max(axis=-1))

    def around(self, x: Array | Sequence[float], radius: float) -> "Box":
        """The part of it within `radius` shares of x."""
        half = radius * self.width
        return Box(np.maximum(self.lower, x - half), np.minimum(self.upper, x + half))
