"""Hyperparameters of a process by maximum marginal likelihood.

Values alone go through scikit-learn's regressor; values with gradients, which it
does not know, through `likelihood.log_likelihood` and L-BFGS-B.
"""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from surrogates.covariance import Hyperparameters, Kernel
from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, conditioned, loo_errors
from surrogates.interface import Array, SurrogateFitError
from surrogates.likelihood import (
    LENGTH_BOUNDS,
    NOISE_BOUNDS,
    SIGNAL_BOUNDS,
    log_likelihood,
    maximised,
)
from surrogates.samples import Samples
from surrogates.validation import errors

# The likelihood costs O(N³) a look. Several starts are tried on at most START_ORDER
# observations, the best polished on at most POLISH_ORDER: hyperparameters hardly
# move beyond that, while all samples are kept in the process itself.
START_ORDER = 200
POLISH_ORDER = 600
# Relative jitter during the search, so that no trial point is lost to rounding.
SEARCH_JITTER = 1e-13
# Scaled variances added in the search, until the covariance at its end is definite.
NUGGETS = (0.0, 1e-10, 1e-8, 1e-6)
# Observations that an exact process holds: 200 MB and some ten seconds to factorise.
EXACT_LIMIT = 5000


def fit_process(
    samples: Samples,
    kernel: Kernel = Kernel.MATERN52,
    gradient_noise: float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> GaussianProcess:
    """Return the process that maximises log p(Y, dY | X) (R & W eq. 5.8).

    Over length scales, signal and, where it is not given, noise variance, from
    `starts` seeded starts; then `centred` and its bands `calibrated`. `gradient_noise` is
    the deviation of dY (upper - lower), in output units, estimated if None.

    Raises:
        SurrogateFitError: more observations than an exact process holds, contradictory
            samples with no noise.
    """
    if samples.observations > EXACT_LIMIT:
        raise SurrogateFitError(
            f"{samples.observations} observations are more than the {EXACT_LIMIT} an exact "
            "Gaussian process holds: use kind='polynomial', or fewer samples"
        )
    parameters = estimate(samples, kernel, gradient_noise, seed, starts)
    process = conditioned(parameters, samples, kernel, uneven_noise(samples))
    return calibrated(centred(process))


def estimate(
    samples: Samples,
    kernel: Kernel,
    gradient_noise: float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> Hyperparameters:
    """Return the hyperparameters of `fit_process`, of at most 600 of the observations."""
    noise, own = None, uneven_noise(samples)
    if samples.noise is not None:
        noise = 0.0 if own.size else float(samples.noise_variances[0])
    rng = np.random.default_rng(seed)
    if samples.dY is None:
        return _by_scikit_learn(kernel, samples.unit, samples.targets, noise, own, rng, starts)
    slope_noise = None
    if gradient_noise is not None:
        slope_noise = (gradient_noise / samples.scaling[1]) ** 2
    return _by_joint_likelihood(
        kernel, samples.unit, samples.targets, [noise, slope_noise], own, rng, starts
    )


def uneven_noise(samples: Samples) -> Array:
    """Return noise variances (n,) where the samples differ in them, (0,) where they do not."""
    # Equal but for rounding, as noise / Y of a relative noise is, counts as equal.
    if samples.noise is None or np.ptp(samples.noise) <= 1e-9 * samples.noise.max():
        return np.empty(0)
    return samples.noise_variances


def _by_scikit_learn(
    kernel: Kernel,
    X: Array,
    y: Array,
    noise: float | None,
    own: Array,
    rng: np.random.Generator,
    starts: int,
) -> Hyperparameters:
    """Maximise the marginal likelihood of values with scikit-learn's regressor."""
    # Imported here: it takes longer than the rest of the package together, and
    # nobody who only reloads and evaluates a surrogate needs it.
    from scipy.linalg import LinAlgError
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

    lengths = np.full(X.shape[1], 0.5)
    shape = (
        RBF(lengths, LENGTH_BOUNDS)
        if kernel is Kernel.RBF
        else Matern(lengths, LENGTH_BOUNDS, nu=2.5)
    )
    covariance = ConstantKernel(1.0, SIGNAL_BOUNDS) * shape
    if noise is None:
        covariance = covariance + WhiteKernel(1e-6, NOISE_BOUNDS)
    known = own if own.size else np.full(len(X), noise or 0.0)
    floor = np.maximum(known, NOISE_BOUNDS[0])
    order = rng.permutation(len(X))

    def search(initial: Any, rows: NDArray[np.intp]) -> tuple[float, Any]:
        for more in NUGGETS:
            regressor = GaussianProcessRegressor(initial, alpha=np.maximum(floor[rows], more))
            try:
                with warnings.catch_warnings():
                    # Parameters at a bound are ordinary (an input without influence,
                    # noise-free samples), and so is a line search ended by rounding.
                    warnings.simplefilter("ignore", ConvergenceWarning)
                    regressor.fit(X[rows], y[rows])
                return float(regressor.log_marginal_likelihood_value_), regressor.kernel_
            except LinAlgError:
                # The optimum itself is singular: many samples close together, no noise.
                continue
        raise SurrogateFitError("the covariance of the samples is not positive definite")

    # A first look at few samples from many starts, then one polish on more of them. The
    # second start is a nearly linear function of many inputs, the others are drawn.
    first = covariance.theta
    shift = np.log(np.full(first.size, 10.0))
    drawn = [first + rng.uniform(-1.5, 4.0, first.size) for _ in range(starts - 2)]
    trials = [first, first + shift, *drawn][:starts]
    found = [search(covariance.clone_with_theta(theta), order[:START_ORDER]) for theta in trials]
    covariance = max(found, key=lambda pair: pair[0])[1]
    if len(X) > START_ORDER:
        covariance = search(covariance, order[:POLISH_ORDER])[1]
    theta = np.exp(covariance.theta)
    d = X.shape[1]
    return Hyperparameters(
        length_scales=theta[1 : 1 + d],
        signal_variance=float(theta[0]),
        noise_variance=noise if noise is not None else float(theta[1 + d]),
    )


def _by_joint_likelihood(
    kernel: Kernel,
    X: Array,
    targets: Array,
    fixed: list[float | None],
    own: Array,
    rng: np.random.Generator,
    starts: int,
) -> Hyperparameters:
    """Maximise the joint likelihood of values and gradients with L-BFGS-B."""
    n, d = X.shape
    bounds = [LENGTH_BOUNDS] * d + [SIGNAL_BOUNDS]
    bounds += [NOISE_BOUNDS if noise is None else (max(noise, 1e-300),) * 2 for noise in fixed]
    order = rng.permutation(n)
    by_component = targets.reshape(1 + d, n)

    def search(starts: list[Array], limit: int, iterations: int) -> Array:
        rows = order[: max(limit // (1 + d), 2)]
        samples, observed = X[rows], by_component[:, rows].ravel()
        own_here = own[rows] if own.size else own
        return maximised(
            lambda natural: log_likelihood(
                kernel, samples, observed, _parameters(natural), SEARCH_JITTER, own_here
            ),
            starts,
            bounds,
            iterations,
        )[1]

    first = np.array([0.5] * d + [1.0, 1e-6, 1e-6])
    spread = np.array([4.0] * d + [10.0, 100.0, 100.0])
    drawn = [first * spread ** rng.uniform(-1.0, 1.0, d + 3) for _ in range(starts - 1)]
    natural = search([first, *drawn], START_ORDER, 100)
    if n * (1 + d) > START_ORDER:
        natural = search([natural], POLISH_ORDER, 60)
    for place, known in enumerate(fixed, d + 1):
        if known is not None:  # exactly, and 0 too
            natural[place] = known
    return _parameters(natural)


def _parameters(natural: Array) -> Hyperparameters:
    *_, signal, noise, gradient_noise = map(float, natural)
    return Hyperparameters(natural[:-3], signal, noise, gradient_noise)


# Samples below which a quantile of 95 % is the largest of all, and says little.
LEAST_TO_CALIBRATE = 20


def centred(process: GaussianProcess) -> GaussianProcess:
    """Return the process about its best linear unbiased mean in place of the sample mean.

    μ = 1ᵀK⁻¹t / 1ᵀK⁻¹1 (the ones of the values only), in scaled units: samples that stand
    close together count less. Source: R & W, eq. 2.43, with a constant basis.
    """
    n = len(process.X)
    ones = np.zeros(process.targets.size)
    ones[:n] = 1.0
    along = cho_solve((process.factor, True), ones)
    mu = float(process.weights[:n].sum() / along[:n].sum())
    moved = replace(
        process,
        output_mean=process.output_mean + process.output_scale * mu,
        targets=process.targets - mu * ones,
        weights=process.weights - mu * along,
    )
    residuals, _ = loo_errors(moved)
    values = moved.output_mean + moved.output_scale * moved.targets[:n]
    return replace(moved, loo=errors(residuals, values))


def calibrated(process: GaussianProcess) -> GaussianProcess:
    """Return the process with its deviation stretched until its samples fit in their bands.

    band = max(1, q₉₅(|y_i - μ_{-i}| / σ_{-i}) / 1.96). Maximum likelihood takes the length
    scales for certain, and a smooth kernel on a function that is less smooth is much too
    sure of itself: unseen points of the lifted data were covered to 69 to 80 % in place of
    95 %, and to 84 to 94 % with the factor. It never narrows, the samples being few.
    """
    if len(process.X) < LEAST_TO_CALIBRATE:
        return process
    residuals, deviations = loo_errors(process)
    quantile = float(np.quantile(np.abs(residuals) / deviations, 0.95))
    return replace(process, band=max(1.0, quantile / TWO_SIDED_95))
