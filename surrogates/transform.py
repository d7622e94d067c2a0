"""Outputs fitted through a transform: a positive quantity by its logarithm."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from surrogates.interface import Array, Surrogate, SurrogateFitError, freeze
from surrogates.samples import Samples
from surrogates.validation import Errors, errors


class Transform(StrEnum):
    """What is fitted in place of y: y itself, or ln y."""

    IDENTITY = "identity"
    LOG = "log"


@dataclass(frozen=True, eq=False)
class Exponential:
    """exp of a surrogate of ln y: value e^m(x), deviation e^m(x) s(x).

    The value is the median of the log-normal prediction, the deviation that of its
    linearisation, which is what a band of a few per cent is. left_out (n,), loo: in
    units of y.
    """

    logarithm: Surrogate
    left_out: Array
    loo: Errors

    def __post_init__(self) -> None:
        freeze(self.left_out)

    @property
    def lower(self) -> Array:
        """Lower bounds (d,)."""
        return self.logarithm.lower

    @property
    def upper(self) -> Array:
        """Upper bounds (d,)."""
        return self.logarithm.upper

    @property
    def has_std(self) -> bool:
        """Whether the surrogate of the logarithm knows its deviation."""
        return self.logarithm.has_std

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the value (m,) at X (m, d), and the deviation (m,) if asked."""
        if not return_std:
            return np.exp(self.logarithm.predict(X))
        mean, std = self.logarithm.predict(X, return_std=True)
        return np.exp(mean), np.exp(mean) * std


def logarithms(samples: Samples) -> Samples:
    """Return the samples of ln Y: dY / Y and noise / Y with it.

    Raises:
        SurrogateFitError: a value is not positive.
    """
    if not (samples.Y > 0.0).all():
        raise SurrogateFitError(
            f"the smallest sample is {samples.Y.min():g}: the log transform needs positive values"
        )
    return Samples(
        samples.lower,
        samples.upper,
        samples.X,
        np.log(samples.Y),
        None if samples.dY is None else samples.dY / samples.Y[:, None],
        None if samples.noise is None else samples.noise / samples.Y,
    )


def exponential(logarithm: Surrogate, samples: Samples) -> Exponential:
    """Return the surrogate of Y, given that of ln Y on the same samples."""
    predicted = np.exp(np.log(samples.Y) - logarithm.left_out)
    residuals = samples.Y - predicted
    return Exponential(logarithm, residuals, errors(residuals, samples.Y))
