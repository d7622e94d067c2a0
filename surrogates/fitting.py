"""Surrogates of one output, or of several, from samples, by maximum marginal likelihood."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cho_solve, cholesky

from surrogates.gaussian_process import (
    NO_NOISE,
    GaussianProcess,
    Hyperparameters,
    Kernel,
    blocks,
    condition_samples,
    loo_errors,
    observed_covariance,
    radial,
    separations,
    symmetric_inverse,
)
from surrogates.samples import Array, Samples, SurrogateFitError, checked


def blocks_weighed(W: Array, z: Array, phi: list[Array], length_scales: Array) -> Array:
    """Sum W times the blocks of `covariance`, rows and columns of gradients in it, over these.

    W is (a (1 + d), b (1 + d)) as the blocks are, or (a, b) of values alone; the sum is (a, b).
    """
    d, a, b = z.shape
    if len(W) == a:
        return np.asarray(W * phi[0])
    V = W.reshape(1 + d, a, 1 + d, b)
    u = 2.0 * z / length_scales[:, None, None]
    slopes = (u * (V[1:, :, 0] - V[0, :, 1:].transpose(1, 0, 2))).sum(axis=0)
    curved, own = np.zeros((a, b)), np.zeros((a, b))
    for i in range(d):
        curved += u[i] * (V[1 + i, :, 1:].transpose(1, 0, 2) * u).sum(axis=0)
        own += (2.0 / length_scales[i] ** 2) * V[1 + i, :, 1 + i]
    return np.asarray(V[0, :, 0] * phi[0] + (slopes - own) * phi[1] - curved * phi[2])


def log_likelihood(
    kernel: Kernel,
    X: Array,
    targets: Array,
    parameters: Hyperparameters,
    jitter: float = 0.0,
    sample_noise: Array = NO_NOISE,
) -> tuple[float, Array]:
    """Return log p(targets | X) and its gradient in the logarithms of the parameters.

    log p = -½ tᵀK⁻¹t - Σ log L_ii - N/2 log 2π and
    ∂ log p / ∂θ = ½ tr((αα^T - K⁻¹) ∂K/∂θ), α = K⁻¹t,
    in the order θ = log (l_1 ... l_d, σ², noise, gradient noise), shape (d + 3,).
    X (n, d) is scaled; targets (n,) are values, or (n (1 + d),) values and gradients.

    Raises:
        LinAlgError: K is not positive definite.
    """
    n, d = X.shape
    gradients = targets.size > n
    lengths = parameters.length_scales
    z = separations(X, X, lengths)
    squares = z * z
    phi = radial(kernel, squares.sum(axis=0), 3 if gradients else 1)
    C = blocks(z, phi, lengths, gradients, gradients)
    K = observed_covariance(C, n, parameters, jitter, sample_noise)
    L = cholesky(K, lower=True, overwrite_a=True)
    alpha = cho_solve((L, True), targets)
    value = (
        -0.5 * targets @ alpha - np.log(np.diag(L)).sum() - 0.5 * targets.size * np.log(2.0 * np.pi)
    )
    W = np.outer(alpha, alpha) - symmetric_inverse(L)

    # K depends on log l_m in two ways. Through s, ds/dlog l_m = -2 z_m², which
    # shifts every φ to its derivative; and through the factors 1/l of the gradient
    # rows and columns, z_i/l_i going as l_i^-2 but the δ_ij term as l_i^-2 in all.
    S, components = blocks_weighed(W, z, phi[1:], lengths), targets.size // n
    slope = np.empty(d + 3)
    slope[:d] = -np.tensordot(squares, S, axes=2)
    WK = W * C
    WK[np.diag_indices_from(WK)] *= 1.0 + jitter
    if gradients:
        # The jitter sits on the diagonal, where z = 0 and only the δ_ij term acts.
        own = np.einsum("iaib->iab", W.reshape(components, n, components, n))[1:]
        with_jitter = phi[1] * (1.0 + jitter * np.eye(n))
        slope[:d] -= 2.0 * WK.sum(axis=1).reshape(components, n).sum(axis=1)[1:]
        slope[:d] += -(2.0 / lengths**2) * np.einsum("iab,ab->i", own, with_jitter)
    slope[:d] *= parameters.signal_variance
    slope[d] = 0.5 * parameters.signal_variance * WK.sum()
    W_diagonal = np.diag(W)
    slope[d + 1] = 0.5 * parameters.noise_variance * W_diagonal[:n].sum()
    slope[d + 2] = 0.5 * parameters.gradient_noise_variance * W_diagonal[n:].sum()
    return float(value), slope


Noise = ArrayLike | None


@dataclass(frozen=True)
class FitOptions:
    """Numbers of a fit.

    Attributes
    ----------
    most_observations : int
        That an exact process holds: 200 MB and some ten seconds to factorise.
    start_observations, polish_observations : int
        The likelihood costs O(N³) an evaluation: several starts are tried on the first number, the
        best is polished on the second. Hyperparameters hardly move beyond that.
    search_jitter : float
        Relative, during the search, so that no trial point is lost to rounding.
    singular : float
        -log p where K is singular: flat, so that the line search backs off.
    length_bounds, signal_bounds, noise_bounds : (float, float)
        Of hyperparameters, scaled units. Samples of a unit box do not distinguish shorter length
        scales, nor longer ones from that of an input without influence (a bound of 100 costs a
        tenth in error on the OTL circuit function); smooth functions need a signal far above the
        sample variance.
    """

    most_observations: int = 5000
    start_observations: int = 200
    polish_observations: int = 600
    search_jitter: float = 1e-15
    singular: float = 1e10
    length_bounds: tuple[float, float] = (1e-2, 1e3)
    signal_bounds: tuple[float, float] = (1e-3, 1e6)
    noise_bounds: tuple[float, float] = (1e-12, 1e0)


@dataclass(frozen=True)
class CalibrationOptions:
    """Numbers of the calibration of deviations."""

    least_samples: int = 5  # left out: fewer do not show how a function continues
    refitted: int = 100  # observations up to which samples are left out of fits
    folds: int = 8  # parts in which they are left out


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
    options: FitOptions = FitOptions(),
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
    options : FitOptions
        Numbers of the method.

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
    if samples.observations > options.most_observations:
        raise SurrogateFitError(
            f"{samples.observations} observations are more than the {options.most_observations} "
            "an exact Gaussian process holds: take fewer samples, or leave gradients out"
        )
    parameters = estimate(samples, family, seed, starts, options)
    return calibrate(condition_samples(parameters, samples, family, uneven_noise(samples)))


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


def estimate(
    samples: Samples, kernel: Kernel, seed: int, starts: int, options: FitOptions = FitOptions()
) -> Hyperparameters:
    """Return the hyperparameters that maximise log p(Y, dY | X) (R & W eq. 5.8).

    Length scales, signal and, where it is not given, noise variance, from `starts` seeded starts on
    at most `polish_observations`; that of gradients is estimated always.
    """
    from scipy.optimize import minimize  # slow to import, and only fitting needs it

    own = uneven_noise(samples)
    fixed: list[float | None] = [None, 0.0 if samples.dY is None else None]
    if samples.noise is not None:
        fixed[0] = 0.0 if own.size else float(samples.noise_variances[0])
    rng, X = np.random.default_rng(seed), samples.unit
    n, d = X.shape
    bounds = [options.length_bounds] * d + [options.signal_bounds]
    free = options.noise_bounds
    bounds += [free if noise is None else (max(noise, 1e-300),) * 2 for noise in fixed]
    limits = np.log(bounds)
    order = rng.permutation(n)
    by_component = samples.targets.reshape(-1, n)

    def search(starts: list[Array], limit: int, iterations: int) -> Array:
        """Search from the starts by L-BFGS-B over the logarithms, on `limit` observations; return
        the best end."""
        rows = order[: max(limit // len(by_component), 2)]
        observed = by_component[:, rows].ravel()
        own_here = own[rows] if own.size else own

        def negative(logarithms: Array) -> tuple[float, Array]:
            parameters = _parameters(np.exp(logarithms))
            try:
                value, slope = log_likelihood(
                    kernel, X[rows], observed, parameters, options.search_jitter, own_here
                )
            except LinAlgError:
                return options.singular, np.zeros_like(logarithms)
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
    natural = search([first, 10.0 * first, *drawn][:starts], options.start_observations, 100)
    if samples.observations > options.start_observations:
        natural = search([natural], options.polish_observations, 60)
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


def calibrate(
    process: GaussianProcess,
    misses: Array | None = None,
    options: CalibrationOptions = CalibrationOptions(),
) -> GaussianProcess:
    """Return the process with its deviation stretched until its samples fit in their bands.

    Each of n samples is left out in turn: z_i = |y_i - μ_{-i}|/σ_{-i}, the `misses` where these are
    known already. Of the sorted z the one of number ⌈(n + 1) p⌉ bounds a fresh one with probability
    p (Vovk, Gammerman & Shafer 2005), so that

        band = max(1, z_(⌈(n + 1) p_k⌉)/k,  k = 1, 2, 3),   p_k of k deviations of a normal one,

    the largest z where n is too small for p_k. It never narrows, the samples being few.

    Parameters
    ----------
    process : GaussianProcess
        Of n samples.
    misses : (n,) array
        z, where they are known.
    options : CalibrationOptions
        Numbers of the method.

    Returns
    -------
    GaussianProcess
        With its `band`.
    """
    n = len(process.X)
    if n < options.least_samples:
        return process
    if misses is None:
        residuals, deviations = loo_errors(process)
        misses = np.abs(residuals) / deviations
    z = np.sort(misses)
    places = [min(math.ceil((n + 1) * share), n) - 1 for share in (0.6827, 0.9545, 0.9973)]
    ratios = [z[place] / k for k, place in enumerate(places, 1)]
    return replace(process, band=max(1.0, *map(float, ratios)))


def recalibrate(
    process: GaussianProcess, seed: int = 0, options: CalibrationOptions = CalibrationOptions()
) -> GaussianProcess:
    """Return the process with the band of samples that are left out of fits, in parts.

    Hyperparameters that were found with a sample know it: kept, as `calibrate` alone keeps them,
    they make few samples much surer of themselves than fresh points bear out. It takes as many
    fits; the process as it is where it has so many observations that this matters little.

    Parameters
    ----------
    process : GaussianProcess
        With its samples.
    seed : int
        Of the parts and the fits.
    options : CalibrationOptions
        Numbers of the method.

    Returns
    -------
    GaussianProcess
        With its `band`.
    """
    n = len(process.X)
    few = process.targets.size <= options.refitted and n >= options.least_samples
    if not few or process.sample_noise.size:
        return process
    width, scaled = process.upper - process.lower, process.targets.reshape(-1, n)
    noise = process.output_scale * math.sqrt(process.hyperparameters.noise_variance)
    X, Y = process.lower + width * process.X, process.output_mean + process.output_scale * scaled[0]
    dY = process.output_scale * scaled[1:].T / width if len(scaled) > 1 else None
    fold, misses = np.random.default_rng(seed).permutation(n) % options.folds, np.empty(n)
    for number in range(options.folds):
        out = fold == number
        part = checked(X[~out], Y[~out], process.lower, process.upper,
                       None if dY is None else dY[~out], noise)  # fmt: skip
        hyperparameters = estimate(part, process.kernel, seed, 1)
        other = condition_samples(hyperparameters, part, process.kernel, np.empty(0))
        mean, deviation = other.predict(X[out], return_std=True)
        misses[out] = np.abs(Y[out] - mean) / deviation
    return calibrate(process, misses, options)
