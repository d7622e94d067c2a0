"""Surrogates of one output, or of several, from samples."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surrogates.covariance import Kernel
from surrogates.gaussian_process import GaussianProcess, conditioned
from surrogates.interface import SurrogateFitError
from surrogates.maximum_likelihood import calibrated, estimate, uneven_noise
from surrogates.samples import checked

Noise = ArrayLike | None
# Observations that an exact process holds: 200 MB and some ten seconds to factorise.
EXACT_LIMIT = 5000


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
