"""How wrong a surrogate is on samples it has not seen."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogates.interface import Array, Errors, Surrogate
from surrogates.samples import Samples


def errors(residuals: ArrayLike, Y: ArrayLike) -> Errors:
    """Summarise residuals y - ŷ (n,) at samples Y (n,).

    >>> errors([0.0, 3.0, 4.0], [0.0, 5.0, 10.0])
    Errors(rms=2.886751345948129, max=4.0, q2=0.5)
    """
    e = np.asarray(residuals, dtype=float)
    y = np.asarray(Y, dtype=float)
    wrong = float(e @ e)
    spread = float(np.sum((y - y.mean()) ** 2))
    q2 = 1.0 - wrong / spread if spread > 0.0 else float(wrong == 0.0)
    return Errors(float(np.sqrt(wrong / e.size)), float(np.abs(e).max()), q2)


def folds_of(n: int, folds: int, seed: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Yield the rows held out and the rest, fold by fold, of a seeded permutation.

    Raises:
        ValueError: folds outside 2 ... n.
    """
    if not 2 <= folds <= n:
        raise ValueError(f"folds must lie between 2 and the {n} samples, got {folds}")
    for held in np.array_split(np.random.default_rng(seed).permutation(n), folds):
        yield held, np.setdiff1d(np.arange(n), held)


def held_out(
    fitter: Callable[[Samples], Surrogate], samples: Samples, folds: int, seed: int
) -> Array:
    """Return the residuals (n,) of k-fold cross-validation, refitting on every fold's rest.

    Raises:
        ValueError: folds outside 2 ... n.
    """
    residuals = np.empty(samples.Y.size)
    for held, rest in folds_of(samples.Y.size, folds, seed):
        fitted = fitter(samples.rows(rest))
        residuals[held] = samples.Y[held] - fitted.predict(samples.X[held])
    return residuals
