"""Gaussian process regression on values, and gradients where there are any.

Source: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006),
algorithm 2.1 (prediction), section 9.4 (derivatives), eq. 5.12 (leave one out).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, solve_triangular

from surrogates.covariance import Hyperparameters, Kernel, covariance, factorise, symmetric_inverse
from surrogates.samples import Array, Errors, Samples, box, checked, errors, freeze

TWO_SIDED_95 = 1.959963984540054  # standard deviations: quantile 0.975 of the normal distribution


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """A Gaussian process conditioned on its samples.

    With x̂ = (x - lower) / (upper - lower) and k̂ the covariances of f(x̂) with the
    observations, mean(x) = output_mean + output_scale k̂(x̂)ᵀ weights.

    Parameters
    ----------
    kernel, hyperparameters : Kernel, Hyperparameters
        The covariance, in scaled units.
    lower, upper, output_mean, output_scale : array (d,), float
        The box, and shift and scale of the outputs.
    X, targets, weights : array
        Samples (n, d) in the unit box; scaled values (n,), or values then gradients by component
        (n (1 + d),); α = K⁻¹ targets.
    jitter, loo : float, Errors
        What the factorisation needed on its diagonal; closed-form leave-one-out errors.
    sample_noise, band : array, float
        Scaled variances (n,) of samples that differ in their noise, on top of the one in the
        hyperparameters, else empty; factor on the deviation that `fitting.calibrate` found.
    """

    # Rounding leaves the predictive variance at noise-free samples anywhere within a few eps of
    # zero, of either sign; below this share of σ² it is taken as the floor.
    variance_floor: ClassVar[float] = 1e-20

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
    sample_noise: Array = field(default_factory=lambda: np.empty(0))
    band: float = 1.0

    def __post_init__(self) -> None:
        d = box(self.lower, self.upper)[0].size
        n = len(self.X)
        if self.X.shape != (n, d) or self.hyperparameters.length_scales.shape != (d,):
            raise ValueError(f"samples and length scales do not have the {d} inputs of the box")
        if self.targets.shape not in ((n,), (n * (1 + d),)):
            raise ValueError(f"{self.targets.shape} targets fit neither values nor gradients")
        if self.weights.shape != self.targets.shape:
            raise ValueError("there must be one weight to each target")
        if self.sample_noise.shape not in ((0,), (n,)):
            raise ValueError("there must be one noise to each sample, or none")
        freeze(self.lower, self.upper, self.X, self.targets, self.weights, self.sample_noise)

    @cached_property
    def left_out(self) -> Array:
        """Leave-one-out residuals (n,), output units."""
        return loo_errors(self)[0]

    @property
    def has_gradients(self) -> bool:
        """Whether gradients were among the observations."""
        return self.targets.size > len(self.X)

    @cached_property
    def factor(self) -> Array:
        """Lower Cholesky factor of the observations' covariance, scaled units."""
        # Recomputed rather than stored, O(n²) numbers that follow from O(n). Another
        # machine may round differently and need a little more jitter than was found.
        own = self.has_gradients, self.jitter, self.sample_noise
        return factorise(self.kernel, self.X, self.hyperparameters, *own)[0]

    def in_unit_box(self, X: ArrayLike) -> Array:
        """x̂ = (x - lower) / (upper - lower) of points (m, d); a single point (d,) is one row.

        Raises:
            ValueError: X does not have the inputs of the box.
        """
        points = np.atleast_2d(np.asarray(X, dtype=float))
        if points.ndim != 2 or points.shape[1] != self.lower.size:
            raise ValueError(f"expected points (m, {self.lower.size}), got {points.shape}")
        return np.asarray((points - self.lower) / (self.upper - self.lower))

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the mean (m,) at X (m, d), and the standard deviation (m,) if asked.

        mean = k̂ᵀ α, var = band² (σ² - ‖L⁻¹ k̂‖²), in output units; the deviation is that of
        the function itself, measurement noise not added.

        Raises:
            ValueError: X does not have the inputs of the box.
        """
        unit = self.in_unit_box(X)
        p = self.hyperparameters
        k = p.signal_variance * covariance(
            self.kernel, unit, self.X, p.length_scales, gradients_of_b=self.has_gradients
        )
        mean = self.output_mean + self.output_scale * (k @ self.weights)
        if not return_std:
            return mean
        v = solve_triangular(self.factor, k.T, lower=True)
        variance = p.signal_variance - np.einsum("ab,ab->b", v, v)
        floor = self.variance_floor * p.signal_variance
        return mean, self.band * self.output_scale * np.sqrt(np.maximum(variance, floor))


def condition(
    hyperparameters: Hyperparameters,
    X: ArrayLike,
    Y: ArrayLike,
    *,
    lower: ArrayLike,
    upper: ArrayLike,
    kernel: Kernel | str = Kernel.MATERN52,
    dY: ArrayLike | None = None,
    noise: ArrayLike | None = None,
) -> GaussianProcess:
    """Condition a process of given (scaled) hyperparameters on samples.

    Parameters
    ----------
    hyperparameters : Hyperparameters
        In scaled units.
    X, Y, dY, lower, upper, kernel
        As for `fit`; the box is required.
    noise : array (n,), optional
        Deviations of samples that differ in it, output units; their variances add to that of the
        hyperparameters.

    Returns
    -------
    GaussianProcess

    Raises
    ------
    SurrogateFitError
        Wrong shapes, values that are not finite, or a covariance that is singular beyond a small
        jitter.
    """
    samples = checked(X, Y, lower, upper, dY, noise)
    own = np.empty(0) if noise is None else samples.noise_variances
    return condition_samples(hyperparameters, samples, Kernel(kernel), own)


def condition_samples(
    hyperparameters: Hyperparameters, samples: Samples, kernel: Kernel, sample_noise: Array
) -> GaussianProcess:
    """Condition as `condition` does, on samples that are checked already."""
    mean, scale = samples.scaling
    unit, targets = samples.unit, samples.targets
    gradients = samples.dY is not None
    L, jitter = factorise(kernel, unit, hyperparameters, gradients, 0.0, sample_noise)
    process = GaussianProcess(
        kernel=kernel,
        lower=samples.lower,
        upper=samples.upper,
        output_mean=mean,
        output_scale=scale,
        hyperparameters=hyperparameters,
        X=unit,
        targets=targets,
        weights=cho_solve((L, True), targets),
        jitter=jitter,
        loo=Errors(0.0, 0.0, 0.0),
        sample_noise=sample_noise,
    )
    # A copy starts with nothing cached; a factor of a thousand samples would carry 8 MB
    # along wherever the process is kept.
    residuals, _ = loo_errors(process)
    return replace(process, loo=errors(residuals, samples.Y))


def loo_errors(process: GaussianProcess) -> tuple[Array, Array]:
    """Residuals y_i - μ_{-i} and their deviations, by the rows B_i of K⁻¹ of each sample.

    Leaving sample i out with its gradient (Rasmussen & Williams, 5.12, blockwise),
    residual = ((K⁻¹)_{B_i B_i})⁻¹ α_{B_i} and covariance = ((K⁻¹)_{B_i B_i})⁻¹, of which the first
    component is the value. Exact for fixed hyperparameters and output scaling.

    Parameters
    ----------
    process : GaussianProcess
        Whose samples are left out in turn.

    Returns
    -------
    residuals, deviations : array (n,)
        In output units; the deviations with the noise, before `band`.
    """
    n = len(process.X)
    c = process.targets.size // n
    inverse = symmetric_inverse(process.factor).reshape(c, n, c, n)
    own = np.einsum("iaja->aij", inverse)
    selected = np.linalg.inv(own)[:, 0, :]
    residuals = np.einsum("ai,ia->a", selected, process.weights.reshape(c, n))
    # Positive in exact arithmetic; a nearly singular K may round it below zero.
    variance = np.maximum(selected[:, 0], process.variance_floor)
    return process.output_scale * residuals, process.output_scale * np.sqrt(variance)
