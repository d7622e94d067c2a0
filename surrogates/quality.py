"""How far a Gaussian process can be trusted, judged by its own samples.

Left out one by one and fold by fold, with the hyperparameters kept (estimated anew they would
cost more than a whole solve, and differ by little); bands against residuals; kinks and jumps;
and whether a point of interest lies where the samples are.
"""

import warnings
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from surrogates.extrapolation import extrapolation
from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, conditioned, loo_errors
from surrogates.interface import Array, Errors
from surrogates.likelihood import LENGTH_BOUNDS, SIGNAL_BOUNDS
from surrogates.samples import Samples
from surrogates.validation import errors, held_out

FOLDS = 10
# Samples without which likelihoods of roughness say nothing, and those that enter the four
# likelihood fits; they cost O(n³) each.
LEAST_FOR_ROUGHNESS = 20
ROUGHNESS_ORDER = 200
NUGGET = 1e-9
# Q² above which the samples are followed whatever their roughness.
EXCELLENT = 1.0 - 1e-6


class Roughness(StrEnum):
    """The kind of function the samples look like at their own resolution."""

    SMOOTH = "smooth"
    KINKED = "kinked"
    JUMPS = "jumps"


@dataclass(frozen=True, eq=False)
class Quality:
    """One output, its errors in `unit`.

    true, predicted (n,): each sample, and its prediction without it; standardised (n,): the
    difference over the deviation of the band; coverage: share inside nominal 95 % bands.
    loo, kfold: errors left out one by one and in ten folds. extrapolates: what is amiss at the
    point of interest, nothing where samples support it.

    roughness: a kink across a surface has Sobolev regularity just below 3/2, a jump just below
    1/2, and sample paths of a Matérn process regularity ν. Each ν is fitted by maximum
    likelihood (at most 200 of the samples, values only) and the verdict is 'smooth' if ν = 5/2
    or ∞ explains the values best; else 'jumps' if ν = 1/2 explains them better than 5/2, and
    'kinked' if not. The measure sees what the samples resolve and no more: kinks and jumps that
    are small beside the smooth variation read one class too smooth, the more so the fewer
    samples and the more inputs; a steep smooth step reads as rough. So 'jumps' and 'kinked' are
    grounds to act, 'smooth' is no proof.

    Source: Stein, Interpolation of Spatial Data (1999), section 6.7, on estimating
    ν by likelihood; Rasmussen & Williams (2006), section 5.4.2 on leave-one-out.
    """

    name: str
    unit: str
    true: Array
    predicted: Array
    standardised: Array
    loo: Errors
    kfold: Errors
    coverage: float
    roughness: Roughness
    extrapolates: tuple[str, ...]

    @property
    def smooth_enough(self) -> bool:
        """Whether one smooth surrogate suits the samples."""
        return self.roughness is Roughness.SMOOTH or self.kfold.q2 >= EXCELLENT


def quality_of(
    process: GaussianProcess,
    x: Array,
    *,
    name: str = "output",
    unit: str = "",
    factor: float = 1.0,
    logarithm: bool = False,
    seed: int = 0,
) -> Quality:
    """Judge a process by the samples it holds, and at a point of interest x (d,).

    `factor` turns its output into `unit`; of a `logarithm` the samples and their predictions
    are given as what it is the logarithm of.

    Raises:
        ValueError: the point does not have the process's inputs.
    """
    samples = _samples(process)
    residuals, deviations = loo_errors(process)
    n = len(process.X)
    folded = held_out(
        lambda part: conditioned(process.hyperparameters, part, process.kernel, np.empty(0)),
        samples,
        min(FOLDS, n),
        seed,
    )
    kind = Roughness.SMOOTH
    if n >= LEAST_FOR_ROUGHNESS:
        kind = roughness(smoothness_likelihoods(process.X, process.targets[:n], seed))
    standardised = residuals / (process.band * deviations)
    predicted = samples.Y - residuals
    return Quality(
        name=name,
        unit=unit,
        true=np.exp(samples.Y) if logarithm else factor * samples.Y,
        predicted=np.exp(predicted) if logarithm else factor * predicted,
        standardised=standardised,
        loo=errors(factor * residuals, factor * samples.Y),
        kfold=errors(factor * folded, factor * samples.Y),
        coverage=float(np.mean(np.abs(standardised) <= TWO_SIDED_95)),
        roughness=kind,
        extrapolates=extrapolation(process, samples.X, x).reasons,
    )


def roughness(likelihoods: dict[str, float]) -> Roughness:
    """Return the verdict of the likelihoods of the four smoothnesses, as `Quality` says it.

    >>> roughness({"1/2": -9.0, "3/2": 0.0, "5/2": -4.0, "inf": -20.0}).value
    'kinked'
    """
    rough = max(likelihoods["1/2"], likelihoods["3/2"])
    if max(likelihoods["5/2"], likelihoods["inf"]) >= rough:
        return Roughness.SMOOTH
    return Roughness.JUMPS if likelihoods["1/2"] > likelihoods["5/2"] else Roughness.KINKED


def smoothness_likelihoods(X: Array, values: Array, seed: int) -> dict[str, float]:
    """Return the log likelihoods of the values under Matérn kernels, keyed by ν; 0 is the best.

    X (n, d) in the unit box; values (n,) in units of their own deviation.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern

    n, d = X.shape
    rows = np.random.default_rng(seed).permutation(n)[:ROUGHNESS_ORDER]
    found = {}
    for name, nu in (("1/2", 0.5), ("3/2", 1.5), ("5/2", 2.5), ("inf", np.inf)):
        shape = Matern(np.full(d, 0.5), LENGTH_BOUNDS, nu=nu)
        regressor = GaussianProcessRegressor(
            ConstantKernel(1.0, SIGNAL_BOUNDS) * shape,
            alpha=NUGGET,
            n_restarts_optimizer=1,
            random_state=seed,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # as in fitting
            regressor.fit(X[rows], values[rows])
        found[name] = float(regressor.log_marginal_likelihood_value_)
    best = max(found.values())
    return {name: value - best for name, value in found.items()}


def _samples(process: GaussianProcess) -> Samples:
    """The samples that a process holds, in input and output units."""
    n, d = process.X.shape
    width = process.upper - process.lower
    targets = process.output_scale * process.targets.reshape(-1, n)
    slopes = None if len(targets) == 1 else targets[1 : 1 + d].T / width
    X = process.lower + process.X * width
    return Samples(process.lower, process.upper, X, process.output_mean + targets[0], slopes)
