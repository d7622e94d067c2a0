"""Hyperparameters by maximum marginal likelihood, and the process they give.

Values alone go through scikit-learn's regressor; values with gradients, which it
does not know, through `likelihood.log_likelihood` and L-BFGS-B.
"""

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from surrogates.gaussian_process import (
    GaussianProcess,
    checked,
    condition,
    output_scaling,
    scaled,
)
from surrogates.interface import Array, SurrogateFitError
from surrogates.kernels import Hyperparameters, Kernel
from surrogates.likelihood import (
    LENGTH_BOUNDS,
    NOISE_BOUNDS,
    SIGNAL_BOUNDS,
    log_likelihood,
)

# The likelihood costs O(N³) a look. Several starts are tried on at most START_ORDER
# observations, the best polished on at most POLISH_ORDER: hyperparameters hardly
# move beyond that, while all samples are kept in the process itself.
START_ORDER = 200
POLISH_ORDER = 600
# Relative jitter during the search, so that no trial point is lost to rounding.
SEARCH_JITTER = 1e-13


def fit(
    X: ArrayLike,
    Y: ArrayLike,
    *,
    lower: ArrayLike,
    upper: ArrayLike,
    kernel: Kernel | str = Kernel.MATERN52,
    dY: ArrayLike | None = None,
    noise: float | None = None,
    gradient_noise: float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> GaussianProcess:
    """Fit a Gaussian process to samples of one output, with gradients if there are any.

    Maximises log p(Y, dY | X) (R & W eq. 5.8) over length scales, signal and noise
    variance from `starts` seeded starts. X (n, d) in input units, Y (n,) in output
    units, dY (n, d) = ∂Y/∂X. `noise` fixes the standard deviation of Y, in output
    units (0 interpolates); `gradient_noise` that of dY (upper - lower), in output
    units too. Both are estimated if None.

    Raises:
        SurrogateFitError: wrong shapes, values that are not finite, negative noise,
            contradictory samples with no noise.
    """
    low, high, points, values, slopes = checked(X, Y, lower, upper, dY)
    if min(noise or 0.0, gradient_noise or 0.0) < 0.0 or starts < 1:
        raise SurrogateFitError("noise must not be negative and there must be a start")
    family = Kernel(kernel)
    unit, targets = scaled(low, high, points, values, slopes)
    _, scale = output_scaling(values)
    fixed = [None if s is None else (s / scale) ** 2 for s in (noise, gradient_noise)]
    rng = np.random.default_rng(seed)
    if slopes is None:
        parameters = _by_scikit_learn(family, unit, targets, fixed[0], rng, starts)
    else:
        parameters = _by_joint_likelihood(family, unit, targets, fixed, rng, starts)
    return condition(parameters, points, values, lower=low, upper=high, kernel=family, dY=slopes)


def fit_outputs(
    X: ArrayLike,
    Y: ArrayLike,
    *,
    lower: ArrayLike,
    upper: ArrayLike,
    kernel: Kernel | str = Kernel.MATERN52,
    dY: ArrayLike | None = None,
    noise: Sequence[float | None] | float | None = None,
    gradient_noise: Sequence[float | None] | float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> tuple[GaussianProcess, ...]:
    """Fit one process to each column of Y (n, k), with dY (n, k, d) if it is given.

    The outputs are taken as independent. Noises are one for all or one to each
    output; everything else is as in `fit`, and so are the errors raised.
    """
    values = np.asarray(Y, dtype=float)
    slopes = None if dY is None else np.asarray(dY, dtype=float)
    if values.ndim != 2:
        raise SurrogateFitError(f"expected Y (n, k), got {values.shape}")
    k = values.shape[1]
    if slopes is not None and (slopes.ndim != 3 or slopes.shape[1] != k):
        raise SurrogateFitError(f"expected dY (n, {k}, d), got {slopes.shape}")
    return tuple(
        fit(
            X,
            values[:, i],
            lower=lower,
            upper=upper,
            kernel=kernel,
            dY=None if slopes is None else slopes[:, i],
            noise=noise_i,
            gradient_noise=gradient_noise_i,
            seed=seed,
            starts=starts,
        )
        for i, (noise_i, gradient_noise_i) in enumerate(
            zip(_each(noise, k), _each(gradient_noise, k), strict=True)
        )
    )


def _each(noise: Sequence[float | None] | float | None, k: int) -> list[float | None]:
    given = list(noise) if isinstance(noise, Sequence) else [noise] * k
    if len(given) != k:
        raise SurrogateFitError(f"expected {k} noises, got {len(given)}")
    return given


def _by_scikit_learn(
    kernel: Kernel,
    X: Array,
    y: Array,
    noise: float | None,
    rng: np.random.Generator,
    starts: int,
) -> Hyperparameters:
    """Maximise the marginal likelihood of values with scikit-learn's regressor."""
    # Imported here: it takes longer than the rest of the package together, and
    # nobody who only reloads and evaluates a surrogate needs it.
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
    floor = NOISE_BOUNDS[0] if noise is None else max(noise, NOISE_BOUNDS[0])
    order = rng.permutation(len(X))
    # A first look at few samples from many starts, then one polish on more of them.
    for limit, restarts in ((START_ORDER, starts - 1), (POLISH_ORDER, 0)):
        rows = order[:limit]
        regressor = GaussianProcessRegressor(
            covariance,
            alpha=floor,
            n_restarts_optimizer=restarts,
            random_state=int(rng.integers(2**31)),
        )
        with warnings.catch_warnings():
            # Parameters at a bound are ordinary (an input without influence, noise-
            # free samples), and so is a line search ended by rounding.
            warnings.simplefilter("ignore", ConvergenceWarning)
            regressor.fit(X[rows], y[rows])
        covariance = regressor.kernel_
        if len(X) <= START_ORDER:
            break
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
    rng: np.random.Generator,
    starts: int,
) -> Hyperparameters:
    """Maximise the joint likelihood of values and gradients with L-BFGS-B."""
    from scipy.linalg import LinAlgError
    from scipy.optimize import minimize

    n, d = X.shape
    bounds = np.log([LENGTH_BOUNDS] * d + [SIGNAL_BOUNDS])
    for noise in fixed:
        known = NOISE_BOUNDS if noise is None else (max(noise, 1e-300),) * 2
        bounds = np.vstack([bounds, np.log(known)])
    order = rng.permutation(n)
    by_component = targets.reshape(1 + d, n)

    def search(theta0: Array, limit: int, iterations: int) -> tuple[float, Array]:
        rows = order[: max(limit // (1 + d), 2)]
        samples, observed = X[rows], by_component[:, rows].ravel()

        def negative(theta: Array) -> tuple[float, Array]:
            try:
                value, slope = log_likelihood(
                    kernel, samples, observed, _parameters(theta, d), SEARCH_JITTER
                )
            except LinAlgError:
                # A wall: large and flat, so that the line search backs off.
                return 1e10, np.zeros_like(theta)
            return -value, -slope

        found = minimize(
            negative,
            theta0,
            jac=True,
            bounds=bounds,
            method="L-BFGS-B",
            options={"maxiter": iterations},
        )
        return float(found.fun), found.x

    first = np.log([0.5] * d + [1.0, 1e-6, 1e-6])
    spread = np.log([4.0] * d + [10.0, 100.0, 100.0])
    trials = [first + spread * rng.uniform(-1.0, 1.0, d + 3) for _ in range(starts - 1)]
    found = [
        search(np.clip(t, bounds[:, 0], bounds[:, 1]), START_ORDER, 100) for t in [first, *trials]
    ]
    theta = min(found, key=lambda pair: pair[0])[1]
    if n * (1 + d) > START_ORDER:
        theta = search(theta, POLISH_ORDER, 60)[1]
    best = _parameters(theta, d)
    return Hyperparameters(
        length_scales=best.length_scales,
        signal_variance=best.signal_variance,
        noise_variance=best.noise_variance if fixed[0] is None else fixed[0],
        gradient_noise_variance=best.gradient_noise_variance if fixed[1] is None else fixed[1],
    )


def _parameters(theta: Array, d: int) -> Hyperparameters:
    natural = np.exp(theta)
    return Hyperparameters(
        length_scales=natural[:d],
        signal_variance=float(natural[d]),
        noise_variance=float(natural[d + 1]),
        gradient_noise_variance=float(natural[d + 2]),
    )
