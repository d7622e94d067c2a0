"""Samples of a function, what is asked of a surrogate of them, and the plans by which samples are
placed."""

from dataclasses import dataclass
from enum import StrEnum

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
