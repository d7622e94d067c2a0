"""One way to fit every surrogate of the package.

A kind is named, or chosen by cross-validation (`selection`).
"""

from enum import StrEnum
from typing import Literal, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Surrogate, SurrogateFitError
from surrogates.kernels import Kernel
from surrogates.maximum_likelihood import fit_process
from surrogates.network import fit_network
from surrogates.polynomial import fit_polynomial
from surrogates.radial_basis import fit_radial_basis
from surrogates.samples import Samples, checked
from surrogates.sparse_process import fit_sparse
from surrogates.transform import Transform, exponential, logarithms

Noise = ArrayLike | None
E = TypeVar("E", bound=StrEnum)


class Kind(StrEnum):
    """The kinds of surrogate, and 'auto' for the one cross-validation prefers."""

    GAUSSIAN_PROCESS = "gaussian_process"
    SPARSE_PROCESS = "sparse_process"
    POLYNOMIAL = "polynomial"
    RADIAL_BASIS = "radial_basis"
    NETWORK = "network"
    AUTO = "auto"


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
    gradient_noise: float | None = ...,
    seed: int = ...,
    starts: int = ...,
) -> GaussianProcess: ...
@overload
def fit(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Kind | str = ...,
    transform: Transform | str = ...,
    lower: ArrayLike | None = ...,
    upper: ArrayLike | None = ...,
    kernel: Kernel | str = ...,
    noise: Noise = ...,
    gradient_noise: float | None = ...,
    seed: int = ...,
    starts: int = ...,
) -> Surrogate: ...
def fit(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Kind | str = Kind.GAUSSIAN_PROCESS,
    transform: Transform | str = Transform.IDENTITY,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    kernel: Kernel | str = Kernel.MATERN52,
    noise: Noise = None,
    gradient_noise: float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> Surrogate:
    """Fit a surrogate to samples of one output, with gradients if there are any.

    X (n, d) in input units, Y (n,) in output units, dY (n, d) = ∂Y/∂X, which processes
    and polynomials take. `lower`, `upper` (d,) scale the inputs; left out, they are the
    range of X. `transform` 'log' fits ln Y. `kernel`, `gradient_noise` and `starts` are
    those of the processes; 'auto' tries both kernels.

    `noise` is the standard deviation of Y in output units, one for all or one to each
    sample (n,); 0 interpolates, None estimates it where the kind can. `gradient_noise`
    is that of dY (upper - lower).

    Raises:
        SurrogateFitError: wrong shapes, values that are not finite, negative noise,
            an unknown kind, or samples that this kind cannot take; the sentence says
            what to do.
    """
    samples = checked(X, Y, lower, upper, dY, noise)
    if (gradient_noise or 0.0) < 0.0 or starts < 1:
        raise SurrogateFitError("noise must not be negative and there must be a start")
    return fit_samples(
        samples,
        named(Kind, kind, "kind"),
        named(Transform, transform, "transform"),
        named(Kernel, kernel, "kernel"),
        gradient_noise,
        seed,
        starts,
    )


def fit_samples(
    samples: Samples,
    kind: Kind,
    transform: Transform = Transform.IDENTITY,
    kernel: Kernel = Kernel.MATERN52,
    gradient_noise: float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> Surrogate:
    """As `fit`, of samples that are checked already."""
    if transform is Transform.LOG:
        inside = logarithms(samples)
        # The slope noise of ln y differs from sample to sample; its typical size is kept.
        slope = None if gradient_noise is None else gradient_noise / float(np.median(samples.Y))
        plain = Transform.IDENTITY
        return exponential(fit_samples(inside, kind, plain, kernel, slope, seed, starts), samples)
    match kind:
        case Kind.GAUSSIAN_PROCESS:
            return fit_process(samples, kernel, gradient_noise, seed, starts)
        case Kind.SPARSE_PROCESS:
            return fit_sparse(samples, kernel, seed=seed, starts=starts)
        case Kind.POLYNOMIAL:
            return fit_polynomial(samples)
        case Kind.RADIAL_BASIS:
            return fit_radial_basis(samples)
        case Kind.NETWORK:
            return fit_network(samples, seed=seed)
        case Kind.AUTO:
            from surrogates.selection import choose  # which itself fits the candidates

            best = choose(samples, seed=seed).best
            return fit_samples(
                samples, best.kind, transform, best.kernel, gradient_noise, seed, starts
            )


def named(family: type[E], name: E | str, what: str) -> E:
    """Return the member of a family of names, or raise SurrogateFitError with the names."""
    try:
        return family(name)
    except ValueError:
        known = ", ".join(member.value for member in family)
        raise SurrogateFitError(f"unknown {what} {name!r}; it is one of: {known}") from None
