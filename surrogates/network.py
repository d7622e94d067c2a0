"""A small neural network: scikit-learn's MLPRegressor with tanh, kept as its matrices."""

import warnings
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from surrogates.interface import Array, SurrogateFitError, box, freeze, no_deviation, points_in
from surrogates.samples import Samples
from surrogates.validation import Errors, errors, folds_of

HIDDEN = (20, 20)
PENALTY = 1e-5
ITERATIONS = 1000
FOLDS = 5


@dataclass(frozen=True, eq=False)
class Network:
    """A feed-forward network, v = 2 (x - lower) / (upper - lower) - 1.

    value(x) = mean + scale (W_Lᵀ h_L + b_L), h_1 = v, h_{k+1} = tanh(W_kᵀ h_k + b_k).

    matrices: W_k (inputs, outputs) of each layer. biases: b_k (outputs,). left_out (n,),
    loo: from 5-fold cross-validation, each left-out sample a training being too dear.
    """

    lower: Array
    upper: Array
    output_mean: float
    output_scale: float
    matrices: tuple[Array, ...]
    biases: tuple[Array, ...]
    left_out: Array
    loo: Errors

    def __post_init__(self) -> None:
        width = box(self.lower, self.upper)[0].size
        for W, b in zip(self.matrices, self.biases, strict=True):
            if W.ndim != 2 or len(W) != width or b.shape != (W.shape[1],):
                raise ValueError("the layers of the network do not fit each other")
            width = W.shape[1]
        if width != 1 or not self.matrices:
            raise ValueError("the network must end in one output")
        freeze(self.lower, self.upper, self.left_out, *self.matrices, *self.biases)

    @property
    def has_std(self) -> bool:
        """One network alone does not know how wrong it is."""
        return False

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the value (m,) at X (m, d).

        Raises:
            ValueError: the deviation is asked for, which there is none of.
        """
        if return_std:
            raise no_deviation("network")
        h = 2.0 * (points_in(self, X) - self.lower) / (self.upper - self.lower) - 1.0
        for W, b in zip(self.matrices[:-1], self.biases[:-1], strict=True):
            h = np.tanh(h @ W + b)
        return (
            self.output_mean + self.output_scale * (h @ self.matrices[-1] + self.biases[-1])[:, 0]
        )


def fit_network(
    samples: Samples,
    hidden: tuple[int, ...] = HIDDEN,
    penalty: float = PENALTY,
    seed: int = 0,
    validate: bool = True,
) -> Network:
    """Train a network of tanh layers by L-BFGS, then judge it by 5-fold cross-validation.

    `penalty` is the weight decay; samples are weighed by 1 / noise² where it is known.
    Without `validate` the residuals kept are those of the training, and too small.

    Raises:
        SurrogateFitError: gradients are given.
    """
    if samples.dY is not None:
        raise SurrogateFitError(
            "a network takes no gradients: leave dY out, or use kind='gaussian_process' "
            "or 'polynomial'"
        )
    matrices, biases = _train(samples, hidden, penalty, seed)
    mean, scale = samples.scaling

    def network(W: tuple[Array, ...], b: tuple[Array, ...], m: float, s: float) -> Network:
        nothing = np.zeros(0)
        return Network(samples.lower, samples.upper, m, s, W, b, nothing, Errors(0.0, 0.0, 0.0))

    whole = network(matrices, biases, mean, scale)
    left_out = samples.Y - whole.predict(samples.X)
    n = len(samples.X)
    if validate and n >= 2 * FOLDS:
        for held, rest in folds_of(n, FOLDS, seed):
            part = samples.rows(rest)
            trained = network(*_train(part, hidden, penalty, seed), *part.scaling)
            left_out[held] = samples.Y[held] - trained.predict(samples.X[held])
    return Network(
        samples.lower,
        samples.upper,
        mean,
        scale,
        matrices,
        biases,
        left_out,
        errors(left_out, samples.Y),
    )


def _train(
    samples: Samples, hidden: tuple[int, ...], penalty: float, seed: int
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """The matrices and biases of MLPRegressor trained on scaled samples."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor

    regressor = MLPRegressor(
        hidden_layer_sizes=hidden,
        activation="tanh",
        solver="lbfgs",
        alpha=penalty,
        max_iter=ITERATIONS,
        max_fun=20 * ITERATIONS,
        tol=1e-9,
        random_state=seed,
    )
    more: dict[str, Any] = {}
    if samples.noise is not None and samples.noise.min() < samples.noise.max():
        more["sample_weight"] = samples.least_squares_weights**2
    with warnings.catch_warnings():
        # Stopping at the iteration limit is ordinary; cross-validation judges the result.
        warnings.simplefilter("ignore", ConvergenceWarning)
        regressor.fit(2.0 * samples.unit - 1.0, samples.targets, **more)
    return (
        tuple(np.array(W, dtype=float) for W in regressor.coefs_),
        tuple(np.array(b, dtype=float) for b in regressor.intercepts_),
    )
