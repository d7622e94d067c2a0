"""The samples of one output, checked once and scaled the same way for every surrogate."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surrogates.interface import Array, SurrogateFitError, box


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one output in a box.

    Parameters
    ----------
    lower, upper : array (d,)
        The box, input units.
    X, Y : array (n, d), array (n,)
        Places and values.
    dY : array (n, d), optional
        Gradients ∂Y/∂X.
    noise : array (n,), optional
        Standard deviations in output units; None: unknown.
    """

    lower: Array
    upper: Array
    X: Array
    Y: Array
    dY: Array | None = None
    noise: Array | None = None

    @property
    def unit(self) -> Array:
        """The samples (n, d) in the unit box."""
        return (self.X - self.lower) / (self.upper - self.lower)

    @property
    def observations(self) -> int:
        """The number of values and derivatives among the samples."""
        return self.Y.size + (0 if self.dY is None else self.dY.size)

    @property
    def scaling(self) -> tuple[float, float]:
        """Mean and standard deviation of the values, the latter 1 if they agree."""
        return float(self.Y.mean()), float(self.Y.std()) or 1.0

    @property
    def targets(self) -> Array:
        """Scaled values (n,), followed component by component by scaled gradients if any."""
        mean, scale = self.scaling
        targets = (self.Y - mean) / scale
        if self.dY is not None:
            slopes = self.dY * (self.upper - self.lower) / scale
            targets = np.concatenate([targets, slopes.T.ravel()])
        return targets

    @property
    def noise_variances(self) -> Array:
        """Noise variances (n,) in units of the sample variance; 0 where unknown."""
        if self.noise is None:
            return np.zeros(self.Y.size)
        return (self.noise / self.scaling[1]) ** 2


def checked(
    X: ArrayLike,
    Y: ArrayLike,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    dY: ArrayLike | None = None,
    noise: ArrayLike | None = None,
) -> Samples:
    """Samples as float arrays, checked.

    Parameters
    ----------
    X, Y, dY : array (n, d), array (n,), array (n, d) or None
        Places, values and gradients ∂Y/∂X.
    lower, upper : array (d,), optional
        The box, in input units; left out, the range of X.
    noise : float or array (n,), optional
        Deviation of Y; a single one becomes one for each sample.

    Returns
    -------
    Samples

    Raises
    ------
    SurrogateFitError
        Wrong shapes, values that are not finite, negative noise, or no range of X to scale an
        input by.
    """
    points, values = np.array(X, dtype=float), np.array(Y, dtype=float)
    if points.ndim != 2 or len(points) < 2:
        raise SurrogateFitError(f"expected X (n >= 2, d), got {points.shape}")
    if values.shape != (len(points),):
        more = "; fit_outputs takes several outputs" if values.ndim == 2 else ""
        raise SurrogateFitError(f"expected Y ({len(points)},), got {values.shape}{more}")
    slopes = None if dY is None else np.array(dY, dtype=float)
    if slopes is not None and slopes.shape != points.shape:
        raise SurrogateFitError(f"expected dY {points.shape}, got {slopes.shape}")
    deviations = None if noise is None else np.array(noise, dtype=float)
    if deviations is not None:
        if deviations.shape not in ((), values.shape):
            raise SurrogateFitError(
                f"expected one noise or one to each of the {len(points)} samples, "
                f"got {deviations.shape}"
            )
        deviations = np.broadcast_to(deviations, values.shape).copy()
        if not (deviations >= 0.0).all():
            raise SurrogateFitError("noise must not be negative")
    if not all(np.isfinite(a).all() for a in (points, values, slopes, deviations) if a is not None):
        raise SurrogateFitError("samples must be finite; drop the failed evaluations first")
    still = np.flatnonzero(np.ptp(points, axis=0) == 0.0)
    if still.size and (lower is None or upper is None):
        raise SurrogateFitError(
            f"input {still[0]} does not vary among the samples: give lower and upper, or leave it "
            "out"
        )
    ends = points.min(axis=0), points.max(axis=0)
    try:
        low, high = box(ends[0] if lower is None else lower, ends[1] if upper is None else upper)
    except ValueError as error:
        raise SurrogateFitError(str(error)) from error
    if points.shape[1] != low.size:
        raise SurrogateFitError(f"expected X (n >= 2, {low.size}), got {points.shape}")
    return Samples(low, high, points, values, slopes, deviations)
