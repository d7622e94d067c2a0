"""A Gaussian process of many samples through m inducing ones: FITC.

Predicting costs what an exact process of m samples costs, and the export is the same
graph. It is smooth everywhere, which a process of the nearest samples is not where the
neighbours change, and an optimiser with exact derivatives would notice.

Source: Snelson & Ghahramani, Sparse Gaussian Processes using Pseudo-inputs, NIPS 2005;
Quiñonero-Candela & Rasmussen, JMLR 6 (2005), section 6. The inducing samples are the
first pivots of a pivoted Cholesky factorisation of the covariance.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dpstrf

from surrogates.flat_limit import FlatLimit, flat_limit
from surrogates.interface import Array, SurrogateFitError, box, freeze, points_in
from surrogates.kernels import Hyperparameters, Kernel, covariance
from surrogates.maximum_likelihood import estimate
from surrogates.samples import Samples
from surrogates.validation import Errors, errors, folds_of

INDUCING = 1000
# The inducing samples are picked among this many, the covariance of all being too large.
CANDIDATES = 2500
# Share of σ² below which a further inducing sample is determined by the others, and
# which the noise never falls below: it bounds the condition of what is factorised. Of
# 6,000 samples of a smooth function of 4 inputs, 1e-10 keeps 60 inducing ones and errs by
# 4e-3, this keeps 500 and errs by 3e-4.
RESOLUTION = 1e-12
FOLDS = 4
CHUNK = 1000


@dataclass(frozen=True, eq=False)
class SparseProcess:
    """A process conditioned on n samples as far as m inducing points Z carry them.

    mean(x) = output_mean + output_scale k_Z(x̂)ᵀ weights,
    var(x) = output_scale² (σ² - ‖L⁻¹k_Z‖² + ‖B⁻¹L⁻¹k_Z‖²), L the factor of K_ZZ, B that of
    I + V Λ⁻¹ Vᵀ, V = L⁻¹K_ZX, Λ = diag(σ² - ‖V‖²) + noise.

    Fields as of `GaussianProcess`; X (n, d), targets (n,), noise (n,) variances, inducing
    (m, d), weights (m,). left_out (n,): by 4-fold cross-validation with the
    hyperparameters kept.
    """

    kernel: Kernel
    lower: Array
    upper: Array
    output_mean: float
    output_scale: float
    hyperparameters: Hyperparameters
    X: Array
    targets: Array
    noise: Array
    inducing: Array
    weights: Array
    left_out: Array
    loo: Errors

    def __post_init__(self) -> None:
        d, n = box(self.lower, self.upper)[0].size, len(self.X)
        if self.X.shape != (n, d) or self.inducing.shape != (self.weights.size, d):
            raise ValueError(f"samples and inducing points do not have the {d} inputs of the box")
        if self.targets.shape != (n,) or self.noise.shape != (n,):
            raise ValueError("there must be one target and one noise to each sample")
        freeze(self.lower, self.upper, self.X, self.targets, self.noise, self.inducing)
        freeze(self.weights, self.left_out)

    @property
    def has_std(self) -> bool:
        """A process knows its deviation."""
        return True

    @cached_property
    def factors(self) -> tuple[Array, Array]:
        """The lower factors L and B (m, m)."""
        return _condition(
            self.kernel, self.hyperparameters, self.X, self.targets, self.noise, self.inducing
        )[1:]

    @cached_property
    def flat(self) -> FlatLimit | None:
        """The mean without cancellation, where large weights of a smooth function would cancel."""
        return flat_limit(self.kernel, self.hyperparameters, self.inducing, self.weights)

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the mean (m,) at X (m, d), and the standard deviation (m,) if asked."""
        unit = (points_in(self, X) - self.lower) / (self.upper - self.lower)
        p = self.hyperparameters
        parts = []
        for start in range(0, len(unit), CHUNK):  # bounds the memory of the separations
            rows = unit[start : start + CHUNK]
            k = _covariance(self.kernel, p, rows, self.inducing)
            scaled = k @ self.weights if self.flat is None else self.flat.mean(rows)
            mean = self.output_mean + self.output_scale * scaled
            if not return_std:
                parts.append(mean[None])
                continue
            L, B = self.factors
            v = solve_triangular(L, k.T, lower=True)
            w = solve_triangular(B, v, lower=True)
            variance = p.signal_variance - np.sum(v * v, axis=0) + np.sum(w * w, axis=0)
            variance = np.maximum(variance, RESOLUTION * p.signal_variance)
            parts.append(np.stack([mean, self.output_scale * np.sqrt(variance)]))
        answer = np.concatenate(parts, axis=1)
        return (answer[0], answer[1]) if return_std else answer[0]


def fit_sparse(
    samples: Samples,
    kernel: Kernel = Kernel.MATERN52,
    inducing: int = INDUCING,
    seed: int = 0,
    starts: int = 5,
) -> SparseProcess:
    """Fit a sparse process: hyperparameters from 600 of the samples, weights from all.

    Raises:
        SurrogateFitError: gradients are given, or a covariance that is singular.
    """
    if samples.dY is not None:
        raise SurrogateFitError(
            "a sparse process takes no gradients: leave dY out, or use fewer samples with "
            "kind='gaussian_process'"
        )
    parameters = estimate(samples, kernel, None, seed, starts)
    n = len(samples.X)
    unit, targets = samples.unit, samples.targets
    noise = samples.noise_variances
    if samples.noise is None:
        noise = np.full(n, parameters.noise_variance)
    left_out = np.empty(n)
    for held, rest in folds_of(n, min(FOLDS, n), seed):
        Z = _inducing(kernel, parameters, unit[rest], inducing, seed)
        weights, *_ = _condition(kernel, parameters, unit[rest], targets[rest], noise[rest], Z)
        for some in np.array_split(held, -(-len(held) // CHUNK)):
            k = _covariance(kernel, parameters, unit[some], Z)
            left_out[some] = samples.scaling[1] * (targets[some] - k @ weights)
    Z = _inducing(kernel, parameters, unit, inducing, seed)
    weights, *_ = _condition(kernel, parameters, unit, targets, noise, Z)
    return SparseProcess(
        kernel=kernel,
        lower=samples.lower,
        upper=samples.upper,
        output_mean=samples.scaling[0],
        output_scale=samples.scaling[1],
        hyperparameters=parameters,
        X=unit,
        targets=targets,
        noise=noise,
        inducing=Z,
        weights=weights,
        left_out=left_out,
        loo=errors(left_out, samples.Y),
    )


def _covariance(kernel: Kernel, p: Hyperparameters, A: Array, B: Array) -> Array:
    return p.signal_variance * covariance(kernel, A, B, p.length_scales)


def _inducing(kernel: Kernel, p: Hyperparameters, X: Array, count: int, seed: int) -> Array:
    """The samples of largest variance given those before them, one after the other."""
    rows = np.random.default_rng(seed).permutation(len(X))[:CANDIDATES]
    K = covariance(kernel, X[rows], X[rows], p.length_scales)
    _, pivots, rank, info = dpstrf(K, tol=RESOLUTION, lower=1, overwrite_a=True)
    if info < 0:
        raise SurrogateFitError("the covariance of the samples is not finite")
    return X[rows[pivots[: min(count, rank)] - 1]]


def _condition(
    kernel: Kernel, p: Hyperparameters, X: Array, targets: Array, noise: Array, Z: Array
) -> tuple[Array, Array, Array]:
    """Weights (m,) and the factors L and B (m, m)."""
    K = _covariance(kernel, p, Z, Z)
    # The pivots left at least RESOLUTION of σ²: this only covers rounding.
    K[np.diag_indices_from(K)] *= 1.0 + 1e-2 * RESOLUTION
    L = cholesky(K, lower=True)
    inner = np.eye(len(Z))
    right = np.zeros(len(Z))
    for start in range(0, len(X), CHUNK):
        rows = slice(start, start + CHUNK)
        V = solve_triangular(L, _covariance(kernel, p, Z, X[rows]), lower=True)
        own = np.maximum(p.signal_variance - np.sum(V * V, axis=0), 0.0) + noise[rows]
        own = np.maximum(own, RESOLUTION * p.signal_variance)
        inner += (V / own) @ V.T
        right += V @ (targets[rows] / own)
    B = cholesky(inner, lower=True)
    half = solve_triangular(B, right, lower=True)
    weights = solve_triangular(
        L, solve_triangular(B, half, lower=True, trans="T"), lower=True, trans="T"
    )
    return weights, L, B
