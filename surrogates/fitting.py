"""One way to fit every surrogate of the package."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Literal, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from surrogates.covariance import Kernel
from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Surrogate, SurrogateFitError
from surrogates.maximum_likelihood import fit_process
from surrogates.polynomial import Polynomial, fit_polynomial
from surrogates.samples import checked

Noise = ArrayLike | None
E = TypeVar("E", bound=StrEnum)


class Kind(StrEnum):
    """The kinds of surrogate."""

    GAUSSIAN_PROCESS = "gaussian_process"
    POLYNOMIAL = "polynomial"


@overload
def fit(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Literal["gaussian_process", Kind.GAUSSIAN_PROCESS] = ...,
    lower: ArrayLike | None = ...,
    upper: ArrayLike | None = ...,
    kernel: Kernel | str = ...,
    noise: Noise = ...,
    seed: int = ...,
    starts: int = ...,
) -> GaussianProcess: ...
@overload
def fit(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Kind | str,
    lower: ArrayLike | None = ...,
    upper: ArrayLike | None = ...,
    noise: Noise = ...,
) -> Surrogate: ...
def fit(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Kind | str = Kind.GAUSSIAN_PROCESS,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    kernel: Kernel | str = Kernel.MATERN52,
    noise: Noise = None,
    seed: int = 0,
    starts: int = 5,
) -> GaussianProcess | Polynomial:
    """Fit a surrogate to samples of one output, with gradients if there are any.

    X (n, d) in input units, Y (n,) in output units, dY (n, d) = ∂Y/∂X, which processes
    and polynomials take. `lower`, `upper` (d,) scale the inputs; left out, they are the
    range of X. `kernel`, `seed` and `starts` are those of the processes.

    `noise` is the standard deviation of Y in output units, one for all or one to each
    sample (n,); 0 interpolates, None estimates it where the kind can.

    Raises:
        SurrogateFitError: wrong shapes, values that are not finite, negative noise,
            an unknown kind, or samples that this kind cannot take; the sentence says
            what to do.
    """
    samples = checked(X, Y, lower, upper, dY, noise)
    if starts < 1:
        raise SurrogateFitError("there must be a start")
    match _named(Kind, kind, "kind"):
        case Kind.GAUSSIAN_PROCESS:
            family = _named(Kernel, kernel, "kernel")
            return fit_process(samples, family, seed, starts)
        case Kind.POLYNOMIAL:
            return fit_polynomial(samples)


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


def _named(family: type[E], name: E | str, what: str) -> E:
    """Return the member of a family of names, or raise SurrogateFitError with the names."""
    try:
        return family(name)
    except ValueError:
        known = ", ".join(member.value for member in family)
        raise SurrogateFitError(f"unknown {what} {name!r}; it is one of: {known}") from None
