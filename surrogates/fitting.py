"""Surrogates of one output, or of several, from samples."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from surrogates.covariance import Kernel
from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import SurrogateFitError
from surrogates.maximum_likelihood import fit_process
from surrogates.samples import checked

Noise = ArrayLike | None


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
    """Fit a Gaussian process to samples of one output, with gradients if there are any.

    X (n, d) in input units, Y (n,) in output units, dY (n, d) = ∂Y/∂X. `lower`, `upper` (d,)
    scale the inputs; left out, they are the range of X. The hyperparameters are those of
    largest likelihood, from `starts` seeded starts.

    `noise` is the standard deviation of Y in output units, one for all or one to each
    sample (n,); 0 interpolates, None estimates it.

    Raises:
        SurrogateFitError: wrong shapes, values that are not finite, negative noise, an unknown
            kernel, or samples that no process can take; the sentence says what to do.
    """
    samples = checked(X, Y, lower, upper, dY, noise)
    if starts < 1:
        raise SurrogateFitError("there must be a start")
    try:
        family = Kernel(kernel)
    except ValueError:
        known = ", ".join(Kernel)
        raise SurrogateFitError(f"unknown kernel {kernel!r}; it is one of: {known}") from None
    return fit_process(samples, family, seed, starts)


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
    """Fit one process to each column of Y (n, k), with dY (n, k, d) if it is given.

    The outputs are taken as independent. Noises are one for all or a sequence of one to each
    output (which may be (n,) in turn); everything else is as in `fit`, and so are the errors.
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
    return tuple(
        fit(
            X,
            values[:, i],
            None if slopes is None else slopes[:, i],
            lower=lower,
            upper=upper,
            kernel=kernel,
            noise=noises[i],
            seed=seed,
            starts=starts,
        )
        for i in range(k)
    )
