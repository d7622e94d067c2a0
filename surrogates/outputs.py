"""Several outputs of the same inputs, each with a surrogate of its own."""

from collections.abc import Sequence
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from surrogates.fitting import Kind, Noise, fit
from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Surrogate, SurrogateFitError
from surrogates.kernels import Kernel
from surrogates.transform import Transform


@overload
def fit_outputs(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Literal["gaussian_process", Kind.GAUSSIAN_PROCESS] = ...,
    lower: ArrayLike | None = ...,
    upper: ArrayLike | None = ...,
    kernel: Kernel | str = ...,
    noise: Sequence[Noise] | float | None = ...,
    gradient_noise: Sequence[float | None] | float | None = ...,
    seed: int = ...,
    starts: int = ...,
) -> tuple[GaussianProcess, ...]: ...
@overload
def fit_outputs(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Kind | str = ...,
    transform: Sequence[Transform | str] | Transform | str = ...,
    lower: ArrayLike | None = ...,
    upper: ArrayLike | None = ...,
    kernel: Kernel | str = ...,
    noise: Sequence[Noise] | float | None = ...,
    gradient_noise: Sequence[float | None] | float | None = ...,
    seed: int = ...,
    starts: int = ...,
) -> tuple[Surrogate, ...]: ...
def fit_outputs(
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    kind: Kind | str = Kind.GAUSSIAN_PROCESS,
    transform: Sequence[Transform | str] | Transform | str = Transform.IDENTITY,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    kernel: Kernel | str = Kernel.MATERN52,
    noise: Sequence[Noise] | float | None = None,
    gradient_noise: Sequence[float | None] | float | None = None,
    seed: int = 0,
    starts: int = 5,
) -> tuple[Surrogate, ...]:
    """Fit one surrogate to each column of Y (n, k), with dY (n, k, d) if it is given.

    The outputs are taken as independent. Noises and transforms are one for all or a
    sequence of one to each output (a noise of which may be (n,) in turn); everything
    else is as in `fit`, and so are the errors raised.
    """
    values = np.asarray(Y, dtype=float)
    slopes = None if dY is None else np.asarray(dY, dtype=float)
    if values.ndim != 2:
        raise SurrogateFitError(f"expected Y (n, k), got {values.shape}")
    k = values.shape[1]
    if slopes is not None and (slopes.ndim != 3 or slopes.shape[1] != k):
        raise SurrogateFitError(f"expected dY (n, {k}, d), got {slopes.shape}")
    noises: list[Noise] = _each(noise, k, "noises")
    slope_noises: list[float | None] = _each(gradient_noise, k, "noises")
    forms: list[Transform | str] = _each(transform, k, "transforms")
    return tuple(
        fit(
            X,
            values[:, i],
            None if slopes is None else slopes[:, i],
            kind=kind,
            transform=forms[i],
            lower=lower,
            upper=upper,
            kernel=kernel,
            noise=noises[i],
            gradient_noise=slope_noises[i],
            seed=seed,
            starts=starts,
        )
        for i in range(k)
    )


def _each(given: Any, k: int, what: str) -> list[Any]:
    if isinstance(given, str) or not isinstance(given, Sequence):
        return [given] * k
    if len(given) != k:
        raise SurrogateFitError(f"expected {k} {what}, got {len(given)}")
    return list(given)
