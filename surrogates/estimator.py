"""A surrogate as an estimator of scikit-learn, for its pipelines and searches."""

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from surrogates.fitting import fit
from surrogates.gaussian_process import Kernel
from surrogates.samples import Array


class SurrogateRegressor(RegressorMixin, BaseEstimator):
    """`fit` and `predict` of scikit-learn, by `surrogates.fit`.

    After `fit`, `surrogate_` is the surrogate itself, ready for `to_casadi`.

    Parameters
    ----------
    kernel, noise, starts, seed
        As for `surrogates.fit`; the box is the range of X.

    Examples
    --------
    >>> import numpy as np
    >>> X = np.linspace(0.0, 3.0, 12)[:, None]
    >>> model = SurrogateRegressor(kernel="rbf", noise=0.0).fit(X, np.sin(X[:, 0]))
    >>> bool(abs(model.predict([[1.3]])[0] - np.sin(1.3)) < 1e-4)
    True
    """

    def __init__(
        self,
        *,
        kernel: Kernel | str = "matern52",
        noise: float | None = None,
        starts: int = 5,
        seed: int = 0,
    ) -> None:
        self.kernel = kernel
        self.noise = noise
        self.starts = starts
        self.seed = seed

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Fit to samples. Raises ValueError where no process can take them, and says why."""
        data: tuple[Array, Array] = validate_data(
            self, X, y, y_numeric=True, ensure_min_samples=2, dtype=np.float64
        )
        low, high = data[0].min(axis=0), data[0].max(axis=0)
        flat = high - low <= 1e-12 * np.maximum(abs(low), abs(high))  # an input that never varies
        options: dict[str, Any] = self.get_params() | {
            "lower": np.where(flat, low - 0.5, low),
            "upper": np.where(flat, high + 0.5, high),
        }
        self.surrogate_: Any = fit(*data, **options)
        return self

    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """The mean (m,), and with `return_std` its deviation."""
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, dtype=np.float64)
        found: Array | tuple[Array, Array] = self.surrogate_.predict(X, return_std)
        return found
