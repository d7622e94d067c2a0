"""Gaussian process regression on values, and gradients where there are any; its kernels.

Source: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006),
algorithm 2.1 (prediction), section 9.4 (derivatives), eq. 5.12 (leave one out).
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import ClassVar, Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri

from surrogates.samples import (
    Array,
    Errors,
    Samples,
    SurrogateFitError,
    box,
    checked,
    errors,
    freeze,
)

ROOT5 = 5.0**0.5
NO_NOISE: Array = np.empty(0)


class Kernel(StrEnum):
    """Covariance families: Matérn 5/2 (twice differentiable) and RBF (analytic)."""

    MATERN52 = "matern52"
    RBF = "rbf"


@dataclass(frozen=True)
class Hyperparameters:
    """The parameters that the likelihood determines, in the scaled units of the unit box.

    Parameters
    ----------
    length_scales : array (d,)
        Fractions of the box.
    signal_variance, noise_variance : float
        In units of the sample variance of the output.
    gradient_noise_variance : float
        The same per box width squared.
    """

    length_scales: Array
    signal_variance: float
    noise_variance: float
    gradient_noise_variance: float = 0.0


def radial(kernel: Kernel, s: Array, order: int) -> list[Array]:
    """Return [φ, φ', ..., φ^(order)](s), order <= 3, for squared distances s >= 0.

    Matérn 5/2: φ = (1 + √5 r + 5/3 r²) e^(-√5 r); RBF: φ = e^(-s/2). The third
    derivative of the Matérn kernel grows as 1/r; it only ever appears times terms
    of order r⁴ and is returned as 0 at r = 0, the limit of those products.
    """
    if kernel is Kernel.RBF:
        e = np.exp(-0.5 * s)
        return [e, -0.5 * e, 0.25 * e, -0.125 * e][: order + 1]
    r = np.sqrt(s)
    e = np.exp(-ROOT5 * r)
    derivatives = [(1.0 + ROOT5 * r + (5.0 / 3.0) * s) * e]
    if order >= 1:
        derivatives.append((-5.0 / 6.0) * (1.0 + ROOT5 * r) * e)
    if order >= 2:
        derivatives.append((25.0 / 12.0) * e)
    if order >= 3:
        inverse = np.divide(1.0, r, out=np.zeros_like(r), where=r > 0.0)
        derivatives.append((-25.0 * ROOT5 / 24.0) * e * inverse)
    return derivatives


def separations(A: Array, B: Array, length_scales: Array) -> Array:
    """Return z (d, a, b) with z_j = (A_j - B_j) / l_j for points A (a, d), B (b, d).

    Differences are taken before squaring: |a|² + |b|² - 2ab would lose the distance
    of close points, where the interpolation happens.
    """
    return (A.T[:, :, None] - B.T[:, None, :]) / length_scales[:, None, None]


def covariance(
    kernel: Kernel,
    A: Array,
    B: Array,
    length_scales: Array,
    *,
    gradients_of_a: bool = False,
    gradients_of_b: bool = False,
) -> Array:
    """The covariance at σ² = 1 of values, and of gradients where required, at A and B.

    With z = (a - b) / lengths the blocks are
    cov(f_a, f_b) = φ, cov(f_a, ∂_j f_b) = -2 z_j φ' / l_j,
    cov(∂_i f_a, f_b) = 2 z_i φ' / l_i,
    cov(∂_i f_a, ∂_j f_b) = -(2 δ_ij φ' + 4 z_i z_j φ'') / (l_i l_j).
    Rows and columns are ordered by component: all values, all ∂_1, all ∂_2, ...

    Parameters
    ----------
    kernel : Kernel
        The family.
    A, B : (a, d), (b, d) array
        Points of the unit box.
    length_scales : (d,) array
        Fractions of the box.
    gradients_of_a, gradients_of_b : bool
        Whether rows, and columns, of gradients are included.

    Returns
    -------
    (a or a (1 + d), b or b (1 + d)) array
        Scaled units.
    """
    z = separations(A, B, length_scales)
    phi = radial(kernel, np.einsum("jab,jab->ab", z, z), int(gradients_of_a) + int(gradients_of_b))
    return blocks(z, phi, length_scales, gradients_of_a, gradients_of_b)


def blocks(
    z: Array, phi: list[Array], length_scales: Array, rows: bool = True, columns: bool = True
) -> Array:
    """Assemble the blocks of `covariance` from separations and radial derivatives."""
    d, a, b = z.shape
    K = np.empty((1 + d * rows, a, 1 + d * columns, b))
    K[0, :, 0] = phi[0]
    if not (rows or columns):
        return K.reshape(a, b)
    u = 2.0 * z / length_scales[:, None, None]
    slopes = u * phi[1]
    if rows:
        K[1:, :, 0] = slopes
    if columns:
        K[0, :, 1:] = -slopes.transpose(1, 0, 2)
    if rows and columns:
        for i, curved in enumerate(u * phi[2]):
            K[1 + i, :, 1:] = (-u * curved).transpose(1, 0, 2)
            K[1 + i, :, 1 + i] -= (2.0 / length_scales[i] ** 2) * phi[1]
    return K.reshape((1 + d * rows) * a, (1 + d * columns) * b)


def observed_covariance(
    C: Array, n: int, parameters: Hyperparameters, jitter: float, sample_noise: Array = NO_NOISE
) -> Array:
    """Return K = σ² C + jitter diag(σ² C) + noise of the observations of n samples.

    C is their `covariance`; `sample_noise` (n,), or (0,) for none, are variances that add to the
    common noise. The jitter is relative to the prior variance of each observation, so that it
    treats values and gradients, whatever their units, alike.
    """
    K = parameters.signal_variance * C
    diagonal = np.einsum("ii->i", K)
    diagonal *= 1.0 + jitter
    diagonal[:n] += parameters.noise_variance
    if sample_noise.size:
        diagonal[:n] += sample_noise
    diagonal[n:] += parameters.gradient_noise_variance
    return K


def factorise(
    kernel: Kernel,
    X: Array,
    parameters: Hyperparameters,
    gradients: bool,
    least: float = 0.0,
    sample_noise: Array = NO_NOISE,
) -> tuple[Array, float]:
    """Return the lower Cholesky factor of K and the relative jitter, >= least, it needed.

    Raises:
        SurrogateFitError: K is indefinite beyond a jitter of 1e-6 (contradictory
            repeated samples with no noise, or parameters that are not finite).
    """
    lengths = parameters.length_scales
    C = covariance(kernel, X, X, lengths, gradients_of_a=gradients, gradients_of_b=gradients)
    jitters = (0.0, *(10.0**k for k in range(-15, -5)))
    for jitter in (j for j in jitters if j >= least):
        K = observed_covariance(C, len(X), parameters, jitter, sample_noise)
        try:
            return cholesky(K, lower=True, overwrite_a=True), jitter
        except (LinAlgError, ValueError):
            continue
    raise SurrogateFitError("the covariance of the samples is not positive definite")


def symmetric_inverse(L: Array) -> Array:
    """Return K⁻¹ in full from the lower Cholesky factor of K."""
    inverse, _ = dpotri(L, lower=1)  # above the diagonal it has the zeros of L
    full = inverse + inverse.T
    np.einsum("ii->i", full)[:] *= 0.5
    return np.asarray(full)


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
