"""Surrogates of one output, or of several, from samples, by maximum marginal likelihood."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError

from surrogates.covariance import (
    LENGTH_BOUNDS,
    NOISE_BOUNDS,
    SIGNAL_BOUNDS,
    Hyperparameters,
    Kernel,
    log_likelihood,
)
from surrogates.gaussian_process import GaussianProcess, conditioned, loo_errors
from surrogates.samples import Array, Samples, SurrogateFitError, checked

Noise = ArrayLike | None
# Observations that an exact process holds: 200 MB and some ten seconds to factorise.
EXACT_LIMIT = 5000
# The likelihood costs O(N³) a look. Several starts are tried on at most START_ORDER
# observations, the best polished on at most POLISH_ORDER: hyperparameters hardly
# move beyond that, while all samples are kept in the process itself.
START_ORDER = 200
POLISH_ORDER = 600
# Relative jitter during the search, so that no trial point is lost to rounding.
SEARCH_JITTER = 1e-15
SINGULAR = 1e10  # -log p where K is: a wall, flat, so that the line search backs off
LEAST_TO_CALIBRATE = 5  # samples: fewer left out say nothing of how a function goes on
REFITTED, FOLDS = 100, 8  # observations up to which samples are left out of fits; these parts
NORMAL_SHARES = (0.6827, 0.9545, 0.9973)  # within 1, 2 and 3 deviations


def fit(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    kernel: Kernel | str = Kernel.MATERN52,
    noise: Noise = None,
    seed: int = 0,
    starts: int = 5,
) -> GaussianProcess:
    """Fit a process to samples of one output, with gradients if there are any.

    Parameters
    ----------
    X, Y : array (n, d), array (n,)
        Places and values of the samples, in input and output units.
    dY : array (n, d), optional
        Gradients ∂Y/∂X.
    lower, upper : array (d,), optional
        Box that scales the inputs; left out, the range of X.
    kernel : Kernel or str
        Covariance.
    noise : float or array (n,), optional
        Standard deviation of Y, in output units; 0 interpolates, None estimates it.
    seed, starts : int
        Of the search for hyperparameters.

    Returns
    -------
    GaussianProcess
        The surrogate, with its leave-one-out errors.

    Raises
    ------
    SurrogateFitError
        Wrong shapes, values that are not finite, negative noise, an unknown kernel, or more samples
        than an exact process holds; the sentence says what to do.
    """
    samples = checked(X, Y, lower, upper, dY, noise)
    if starts < 1:
        raise SurrogateFitError("there must be a start")
    try:
        family = Kernel(kernel)
    except ValueError:
        known = ", ".join(Kernel)
        raise SurrogateFitError(f"unknown kernel {kernel!r}; it is one of: {known}") from None
    if samples.observations > EXACT_LIMIT:
        raise SurrogateFitError(
            f"{samples.observations} observations are more than the {EXACT_LIMIT} an exact "
            "Gaussian process holds: take fewer samples, or leave gradients out"
        )
    parameters = estimate(samples, family, seed, starts)
    return calibrated(conditioned(parameters, samples, family, uneven_noise(samples)))


def fit_outputs(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    kernel: Kernel | str = Kernel.MATERN52,
    noise: Sequence[Noise] | float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> tuple[GaussianProcess, ...]:
    """Fit one process to each column of Y; the outputs are taken as independent.

    Parameters
    ----------
    X, Y, dY, lower, upper, kernel, seed, starts
        As for `fit`, with outputs (n, k) and gradients (n, k, d).
    noise : float or sequence, optional
        One for all outputs, or one for each (a number or an array (n,)).

    Returns
    -------
    tuple of GaussianProcess
        One for each output, in order. Raises what `fit` does.
    """
    values = np.asarray(Y, dtype=float)
    slopes = None if dY is None else np.asarray(dY, dtype=float)
    if values.ndim != 2:
        raise SurrogateFitError(f"expected Y (n, k), got {values.shape}")
    k = values.shape[1]
    if slopes is not None and (slopes.ndim != 3 or slopes.shape[1] != k):
        raise SurrogateFitError(f"expected dY (n, {k}, d), got {slopes.shape}")
    noises = noise if isinstance(noise, Sequence) else [noise] * k
    if len(noises) != k:
        raise SurrogateFitError(f"expected {k} noises, got {len(noises)}")
    options: dict[str, Any] = {"lower": lower, "upper": upper, "seed": seed, "starts": starts}
    each = zip(
        values.T, [None] * k if slopes is None else slopes.swapaxes(0, 1), noises, strict=True
    )
    return tuple(fit(X, y, slope, kernel=kernel, noise=own, **options) for y, slope, own in each)


def estimate(samples: Samples, kernel: Kernel, seed: int, starts: int) -> Hyperparameters:
    """Return the hyperparameters that maximise log p(Y, dY | X) (R & W eq. 5.8).

    Length scales, signal and, where it is not given, noise variance, from `starts` seeded starts on
    at most 600 of the observations; that of gradients is estimated always.
    """
    from scipy.optimize import minimize  # slow to import, and only fitting needs it

    own = uneven_noise(samples)
    fixed: list[float | None] = [None, 0.0 if samples.dY is None else None]
    if samples.noise is not None:
        fixed[0] = 0.0 if own.size else float(samples.noise_variances[0])
    rng, X = np.random.default_rng(seed), samples.unit
    n, d = X.shape
    bounds = [LENGTH_BOUNDS] * d + [SIGNAL_BOUNDS]
    bounds += [NOISE_BOUNDS if noise is None else (max(noise, 1e-300),) * 2 for noise in fixed]
    limits = np.log(bounds)
    order = rng.permutation(n)
    by_component = samples.targets.reshape(-1, n)

    def search(starts: list[Array], limit: int, iterations: int) -> Array:
        """Their best end by L-BFGS-B over the logarithms, on `limit` observations."""
        rows = order[: max(limit // len(by_component), 2)]
        observed = by_component[:, rows].ravel()
        own_here = own[rows] if own.size else own

        def negative(logarithms: Array) -> tuple[float, Array]:
            parameters = _parameters(np.exp(logarithms))
            try:
                value, slope = log_likelihood(
                    kernel, X[rows], observed, parameters, SEARCH_JITTER, own_here
                )
            except LinAlgError:
                return SINGULAR, np.zeros_like(logarithms)
            return -value, -slope

        ends = [
            minimize(
                negative, np.clip(np.log(start), *limits.T), jac=True, bounds=limits,
                method="L-BFGS-B", options={"maxiter": iterations},
            )
            for start in starts
        ]  # fmt: skip
        return np.asarray(np.exp(min(ends, key=lambda end: float(end.fun)).x))

    # The second start is a nearly linear function of many inputs, the others are drawn.
    first = np.array([0.5] * d + [1.0, 1e-6, 1e-6])
    spread = np.array([4.0] * d + [10.0, 100.0, 100.0])
    drawn = [first * spread ** rng.uniform(-1.0, 1.0, d + 3) for _ in range(starts - 2)]
    natural = search([first, 10.0 * first, *drawn][:starts], START_ORDER, 100)
    if samples.observations > START_ORDER:
        natural = search([natural], POLISH_ORDER, 60)
    for place, known in enumerate(fixed, d + 1):
        if known is not None:  # exactly, and 0 too
            natural[place] = known
    return _parameters(natural)


def uneven_noise(samples: Samples) -> Array:
    """Return noise variances (n,) where the samples differ in them, (0,) where they do not."""
    # Equal but for rounding, as noise / Y of a relative noise is, counts as equal.
    if samples.noise is None or np.ptp(samples.noise) <= 1e-9 * samples.noise.max():
        return np.empty(0)
    return samples.noise_variances


def _parameters(natural: Array) -> Hyperparameters:
    *_, signal, noise, gradient_noise = map(float, natural)
    return Hyperparameters(natural[:-3], signal, noise, gradient_noise)


def calibrated(process: GaussianProcess, misses: Array | None = None) -> GaussianProcess:
    """Return the process with its deviation stretched until its samples fit in their bands.

    Each of n samples is left out in turn: z_i = |y_i - μ_{-i}|/σ_{-i}, the `misses` where these are
    known already. Of the sorted z the one of number ⌈(n + 1) p⌉ bounds a fresh one with probability
    p (Vovk, Gammerman & Shafer 2005), so that

        band = max(1, z_(⌈(n + 1) p_k⌉)/k,  k = 1, 2, 3),   p_k of k deviations of a normal one,

    the largest z where n is too small for p_k. It never narrows, the samples being few.
    """
    n = len(process.X)
    if n < LEAST_TO_CALIBRATE:
        return process
    if misses is None:
        residuals, deviations = loo_errors(process)
        misses = np.abs(residuals) / deviations
    z = np.sort(misses)
    places = [min(math.ceil((n + 1) * share), n) - 1 for share in NORMAL_SHARES]
    ratios = [z[place] / k for k, place in enumerate(places, 1)]
    return replace(process, band=max(1.0, *map(float, ratios)))


def recalibrated(process: GaussianProcess, seed: int = 0) -> GaussianProcess:
    """Return the process with the band of samples that are left out of fits, in `FOLDS` parts.

    Hyperparameters that were found with a sample know it: kept, as `calibrated` alone keeps them,
    they make few samples much surer of themselves than fresh points bear out. It takes as many
    fits; the process as it is where it has so many observations that this matters little.
    """
    n = len(process.X)
    if process.targets.size > REFITTED or n < LEAST_TO_CALIBRATE or process.sample_noise.size:
        return process
    width, scaled = process.upper - process.lower, process.targets.reshape(-1, n)
    noise = process.output_scale * math.sqrt(process.hyperparameters.noise_variance)
    X, Y = process.lower + width * process.X, process.output_mean + process.output_scale * scaled[0]
    dY = process.output_scale * scaled[1:].T / width if len(scaled) > 1 else None
    fold, misses = np.random.default_rng(seed).permutation(n) % FOLDS, np.empty(n)
    for number in range(FOLDS):
        out = fold == number
        part = checked(X[~out], Y[~out], process.lower, process.upper,
                       None if dY is None else dY[~out], noise)  # fmt: skip
        hyperparameters = estimate(part, process.kernel, seed, 1)
        other = conditioned(hyperparameters, part, process.kernel, np.empty(0))
        mean, deviation = other.predict(X[out], return_std=True)
        misses[out] = np.abs(Y[out] - mean) / deviation
    return calibrated(process, misses)
