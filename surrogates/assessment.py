"""Can this surrogate be trusted? Errors left out, calibrated bands, and the words for it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surrogates.diagnostics import Roughness, roughness, smoothness_likelihoods
from surrogates.fitting import Kind, fit_samples
from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess
from surrogates.interface import Array, Surrogate
from surrogates.kernels import Kernel
from surrogates.network import Network
from surrogates.polynomial import Polynomial
from surrogates.radial_basis import RadialBasis
from surrogates.samples import Samples, checked
from surrogates.sparse_process import SparseProcess
from surrogates.transform import Exponential, Transform
from surrogates.validation import Errors, errors, held_out

# Samples that are refitted fold by fold, and samples without which likelihoods of
# roughness say nothing.
VALIDATED = 1000
LEAST_FOR_ROUGHNESS = 20
# Q² below which a surrogate leaves a tenth of the deviation unexplained, and above
# which the samples are followed whatever their roughness.
GOOD, EXCELLENT = 0.99, 1.0 - 1e-6
NARROW, WIDE = 0.90, 0.99

KINDS: dict[type[object], Kind] = {
    GaussianProcess: Kind.GAUSSIAN_PROCESS,
    SparseProcess: Kind.SPARSE_PROCESS,
    Polynomial: Kind.POLYNOMIAL,
    RadialBasis: Kind.RADIAL_BASIS,
    Network: Kind.NETWORK,
}


@dataclass(frozen=True, eq=False)
class Assessment:
    """What the samples say about a surrogate of them.

    loo: the surrogate's own errors left out, hyperparameters kept. kfold: with all of
    it fitted anew on every fold. coverage: the share of samples within nominal 95 %
    bands of k-fold prediction, None without a deviation; stretch: the factor on the
    deviation that makes it 95 %. roughness, smooth_enough: whether one smooth surrogate
    suits the samples. worst (d,): where the largest k-fold error is; worst_share: of
    the squared error, the part of the worst tenth of the samples.
    recommendation: the same in words.
    """

    loo: Errors
    kfold: Errors
    coverage: float | None
    stretch: float | None
    roughness: Roughness
    smooth_enough: bool
    worst: Array
    worst_share: float
    recommendation: str


def assess(
    surrogate: Surrogate,
    X: ArrayLike,
    Y: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    noise: ArrayLike | None = None,
    folds: int = 10,
    seed: int = 0,
) -> Assessment:
    """Judge a surrogate by the samples it was fitted to: X (n, d), Y (n,), dY (n, d), noise.

    k-fold refits its kind, kernel and transform (at most 1,000 of the samples). The
    roughness is that of `diagnose`, of the values in the transformed output.

    Raises:
        SurrogateFitError: samples of other inputs, or that cannot be fitted.
        ValueError: folds outside 2 ... n.
    """
    samples = checked(X, Y, surrogate.lower, surrogate.upper, dY, noise)
    few = samples
    if samples.Y.size > VALIDATED:
        few = samples.rows(np.random.default_rng(seed).permutation(samples.Y.size)[:VALIDATED])
    residuals, deviations = held_out(
        lambda part: refit(surrogate, part, seed), few, min(folds, few.Y.size), seed
    )
    kfold = errors(residuals, few.Y)
    coverage = stretch = None
    if deviations is not None:
        standardised = np.abs(residuals) / np.maximum(deviations, np.finfo(float).tiny)
        coverage = float(np.mean(standardised <= TWO_SIDED_95))
        stretch = float(np.quantile(standardised, 0.95)) / TWO_SIDED_95
    kind = _roughness_of(surrogate, few, seed)
    squares = np.sort(residuals**2)[::-1]
    total = float(squares.sum())
    tenth = -(-squares.size // 10)
    share = float(squares[:tenth].sum()) / total if total > 0.0 else 0.0
    worst = few.X[int(np.argmax(np.abs(residuals)))]
    suits = kind is Roughness.SMOOTH or kfold.q2 >= EXCELLENT
    return Assessment(
        loo=surrogate.loo,
        kfold=kfold,
        coverage=coverage,
        stretch=stretch,
        roughness=kind,
        smooth_enough=suits,
        worst=worst,
        worst_share=share,
        recommendation=_words(kfold, coverage, stretch, kind, suits, worst, share),
    )


def refit(surrogate: Surrogate, samples: Samples, seed: int) -> Surrogate:
    """Return a surrogate of the same kind, kernel and transform of other samples.

    Raises:
        TypeError: a surrogate that is none of this package.
    """
    transform, inside = Transform.IDENTITY, surrogate
    if isinstance(surrogate, Exponential):
        transform, inside = Transform.LOG, surrogate.logarithm
    if type(inside) not in KINDS:
        raise TypeError(f"cannot refit a {type(inside).__name__}")
    kernel = Kernel.MATERN52
    if isinstance(inside, GaussianProcess | SparseProcess):
        kernel = inside.kernel
    kind = KINDS[type(inside)]
    return fit_samples(samples, kind, transform, kernel, seed=seed, starts=1)


def _roughness_of(surrogate: Surrogate, samples: Samples, seed: int) -> Roughness:
    values, noise = samples.Y, samples.noise
    if isinstance(surrogate, Exponential):
        values, noise = np.log(values), None if noise is None else noise / samples.Y
    scale = float(values.std())
    if values.size < LEAST_FOR_ROUGHNESS or scale == 0.0:
        return Roughness.SMOOTH
    known = 0.0 if noise is None else float(np.sqrt(np.mean(noise**2))) / scale
    scaled = (values - values.mean()) / scale
    return roughness(smoothness_likelihoods(samples.unit, scaled, known, seed))


def _words(
    kfold: Errors,
    coverage: float | None,
    stretch: float | None,
    kind: Roughness,
    suits: bool,
    worst: Array,
    share: float,
) -> str:
    where = ", ".join(f"{value:.4g}" for value in worst)
    said = []
    if not suits:
        what = "jumps" if kind is Roughness.JUMPS else "kinks"
        said.append(
            f"The samples look as if the function had {what}: the worst tenth of them hold "
            f"{share:.0%} of the squared error, the worst near ({where}). One smooth surrogate "
            "is not enough: model the smooth quantities behind it, each by a surrogate of its "
            "own (fit_maximum), and leave the maximum or the switch to the optimiser."
        )
    elif kfold.q2 < GOOD:
        said.append(
            f"Q² is only {kfold.q2:.4f}: take more samples, near ({where}) first, or give "
            "the noise if there is any."
        )
    else:
        said.append(f"One smooth surrogate suits the samples (Q² {kfold.q2:.6f}).")
    if coverage is not None and stretch is not None:
        if coverage < NARROW:
            said.append(
                f"Its 95 % bands cover {coverage:.0%} of samples left out: they are too narrow, "
                f"by a factor of {stretch:.2g}."
            )
        elif coverage > WIDE:
            said.append(
                f"Its 95 % bands cover {coverage:.0%} of samples left out, and could be "
                f"narrower by a factor of {stretch:.2g}."
            )
    return " ".join(said)
