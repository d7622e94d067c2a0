"""Gaussian process regression on values, and gradients where there are any.

Source: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006),
algorithm 2.1 (prediction), section 9.4 (derivatives), eq. 5.12 (leave one out).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, solve_triangular

from surrogates.interface import Array, SurrogateFitError, box
from surrogates.kernels import Hyperparameters, Kernel, covariance
from surrogates.likelihood import factorise, symmetric_inverse
from surrogates.validation import Errors, errors

# Rounding leaves the predictive variance at noise-free samples anywhere within a
# few eps of zero, of either sign; below this share of σ² it is taken as the floor.
VARIANCE_FLOOR = 1e-20


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process conditioned on its samples.

    With x̂ = (x - lower) / (upper - lower) and k̂ the covariances of f(x̂) with the
    observations, mean(x) = output_mean + output_scale k̂(x̂)ᵀ weights.

    kernel: the covariance family. lower, upper (d,): the box, input units.
    output_mean, output_scale: shift and scale of the outputs, output units.
    hyperparameters: in scaled units. X (n, d): the samples in the unit box.
    targets: scaled values (n,), or values then gradients by component (n (1 + d),).
    weights: α = K⁻¹ targets. jitter: what the factorisation needed on its diagonal.
    loo: closed-form leave-one-out errors, hyperparameters and scales kept.
    """

    kernel: Kernel
    lower: Array
    upper: Array
    output_mean: float
    output_scale: float
    hyperparameters: Hyperparameters
    X: Array
    targets: Array
    weights: Array
    jitter: float
    loo: Errors

    def __post_init__(self) -> None:
        d = box(self.lower, self.upper)[0].size
        n = len(self.X)
        if self.X.shape != (n, d) or self.hyperparameters.length_scales.shape != (d,):
            raise ValueError(f"samples and length scales do not have the {d} inputs of the box")
        if self.targets.shape not in ((n,), (n * (1 + d),)):
            raise ValueError(f"{self.targets.shape} targets fit neither values nor gradients")
        if self.weights.shape != self.targets.shape:
            raise ValueError("there must be one weight to each target")
        for array in (self.lower, self.upper, self.X, self.targets, self.weights):
            array.flags.writeable = False  # shared with whoever holds the surrogate

    @property
    def has_gradients(self) -> bool:
        """Whether gradients were among the observations."""
        return self.targets.size > len(self.X)

    @cached_property
    def factor(self) -> Array:
        """Lower Cholesky factor of the observations' covariance, scaled units."""
        # Recomputed rather than stored, O(n²) numbers that follow from O(n). Another
        # machine may round differently and need a little more jitter than was found.
        return factorise(
            self.kernel, self.X, self.hyperparameters, self.has_gradients, self.jitter
        )[0]

    @property
    def rounding(self) -> float:
        """Scale of the rounding error of one evaluation of the mean, output units.

        eps σ² Σ_i |α_i| c_i, c = 1 for values and 1 / l_j for gradients. A fit of a
        very smooth function, with gradients above all, has large weights that
        cancel: near 1e-8 of the output scale it is still far below the error of the
        fit, yet NumPy, CasADi and another machine agree no better than this. More
        noise or jitter lowers it and costs one to two digits of accuracy.
        """
        p = self.hyperparameters
        largest = np.repeat(np.append(1.0, 1.0 / p.length_scales), len(self.X))
        total = float(largest[: self.weights.size] @ np.abs(self.weights))
        eps = float(np.finfo(float).eps)
        return self.output_scale * eps * p.signal_variance * total

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the mean (m,) at X (m, d), and the standard deviation (m,) if asked.

        mean = k̂ᵀ α, var = σ² - ‖L⁻¹ k̂‖², in output units; the deviation is that of
        the function itself, measurement noise not added.

        Raises:
            ValueError: X does not have the inputs of the box.
        """
        points = np.atleast_2d(np.asarray(X, dtype=float))
        if points.ndim != 2 or points.shape[1] != self.lower.size:
            raise ValueError(f"expected points (m, {self.lower.size}), got {points.shape}")
        p = self.hyperparameters
        k = p.signal_variance * covariance(
            self.kernel,
            (points - self.lower) / (self.upper - self.lower),
            self.X,
            p.length_scales,
            gradients_of_b=self.has_gradients,
        )
        mean = self.output_mean + self.output_scale * (k @ self.weights)
        if not return_std:
            return mean
        v = solve_triangular(self.factor, k.T, lower=True)
        variance = p.signal_variance - np.einsum("ab,ab->b", v, v)
        floor = VARIANCE_FLOOR * p.signal_variance
        return mean, self.output_scale * np.sqrt(np.maximum(variance, floor))


def condition(
    hyperparameters: Hyperparameters,
    X: ArrayLike,
    Y: ArrayLike,
    *,
    lower: ArrayLike,
    upper: ArrayLike,
    kernel: Kernel | str = Kernel.MATERN52,
    dY: ArrayLike | None = None,
) -> GaussianProcess:
    """Condition a process of given (scaled) hyperparameters on samples.

    X (n, d) in input units, Y (n,) in output units, dY (n, d) = ∂Y/∂X.

    Raises:
        SurrogateFitError: wrong shapes, values that are not finite, or a covariance
            that is singular beyond a small jitter.
    """
    low, high, points, values, slopes = checked(X, Y, lower, upper, dY)
    mean, scale = output_scaling(values)
    unit, targets = scaled(low, high, points, values, slopes)
    family = Kernel(kernel)
    L, jitter = factorise(family, unit, hyperparameters, slopes is not None)
    process = GaussianProcess(
        kernel=family,
        lower=low,
        upper=high,
        output_mean=mean,
        output_scale=scale,
        hyperparameters=hyperparameters,
        X=unit,
        targets=targets,
        weights=cho_solve((L, True), targets),
        jitter=jitter,
        loo=Errors(0.0, 0.0, 0.0),
    )
    residuals, _ = loo_errors(process)
    return replace(process, loo=errors(residuals, values))


def loo_errors(process: GaussianProcess) -> tuple[Array, Array]:
    """Return residuals y_i - μ_{-i} (n,) and their deviations (n,), output units.

    Leaving sample i out with its gradient, B_i being its rows of K⁻¹,
    residual = ((K⁻¹)_{B_i B_i})⁻¹ α_{B_i} and covariance = ((K⁻¹)_{B_i B_i})⁻¹, of
    which the first component is the value. Exact for fixed hyperparameters and
    output scaling; the noise is part of the deviation. Source: R & W eq. 5.12,
    blockwise.
    """
    n = len(process.X)
    c = process.targets.size // n
    inverse = symmetric_inverse(process.factor).reshape(c, n, c, n)
    own = np.einsum("iaja->aij", inverse)
    selected = np.linalg.inv(own)[:, 0, :]
    residuals = np.einsum("ai,ia->a", selected, process.weights.reshape(c, n))
    # Positive in exact arithmetic; a nearly singular K may round it below zero.
    variance = np.maximum(selected[:, 0], VARIANCE_FLOOR)
    return process.output_scale * residuals, process.output_scale * np.sqrt(variance)


def checked(
    X: ArrayLike, Y: ArrayLike, lower: ArrayLike, upper: ArrayLike, dY: ArrayLike | None
) -> tuple[Array, Array, Array, Array, Array | None]:
    """Return bounds, samples (n, d), values (n,) and gradients (n, d) as float arrays."""
    try:
        low, high = box(lower, upper)
    except ValueError as error:
        raise SurrogateFitError(str(error)) from error
    points, values = np.asarray(X, dtype=float), np.asarray(Y, dtype=float)
    slopes = None if dY is None else np.asarray(dY, dtype=float)
    if points.ndim != 2 or points.shape[1] != low.size or len(points) < 2:
        raise SurrogateFitError(f"expected X (n >= 2, {low.size}), got {points.shape}")
    if values.shape != (len(points),):
        raise SurrogateFitError(f"expected Y ({len(points)},), got {values.shape}")
    if slopes is not None and slopes.shape != points.shape:
        raise SurrogateFitError(f"expected dY {points.shape}, got {slopes.shape}")
    if not all(np.isfinite(a).all() for a in (points, values, slopes) if a is not None):
        raise SurrogateFitError("samples must be finite; drop the failed evaluations first")
    return low, high, points, values, slopes


def output_scaling(values: Array) -> tuple[float, float]:
    """Return the mean and standard deviation of the values, the latter 1 if they agree."""
    return float(values.mean()), float(values.std()) or 1.0


def scaled(
    low: Array, high: Array, points: Array, values: Array, slopes: Array | None
) -> tuple[Array, Array]:
    """Return samples in the unit box and targets in units of the sample deviation."""
    mean, scale = output_scaling(values)
    targets = (values - mean) / scale
    if slopes is not None:
        targets = np.concatenate([targets, (slopes * (high - low) / scale).T.ravel()])
    return (points - low) / (high - low), targets
