"""How far a Gaussian process can be trusted, judged by its own samples.

Left out one by one and fold by fold, with the hyperparameters kept (estimated anew they would
cost more than a whole solve, and differ by little); bands against residuals; kinks and jumps;
and whether a point of interest lies where the samples are.
"""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np

from surrogates.covariance import Family, Hyperparameters, Kernel, Rough
from surrogates.extrapolation import extrapolation
from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, conditioned, loo_errors
from surrogates.interface import Array, Errors
from surrogates.likelihood import LENGTH_BOUNDS, SIGNAL_BOUNDS, log_likelihood, maximised
from surrogates.samples import Samples
from surrogates.validation import errors, held_out

FOLDS = 10
# Samples without which likelihoods of roughness say nothing, and those that enter the four
# likelihood fits; they cost O(n³) each.
LEAST_FOR_ROUGHNESS = 20
ROUGHNESS_ORDER = 200
NUGGET = 1e-9
# Q² above which the samples are followed whatever their roughness; above which a kink is a slight
# one; and below which the surrogate follows them poorly, smooth or not.
EXCELLENT = 1.0 - 1e-6
GOOD = 0.995
POOR = 0.9
# A sample this close to the point of interest (share of the box) is that point. Left out, it may be
# off by so many of its deviations, or by so much of the samples' range, before the others miss it.
SAME = 1e-6
SIGMAS = 3.0
SHARE = 1e-3
NEAR = 0.05  # share of the box: samples this close to the point of interest are around it


MATERN: dict[str, Family] = {
    "1/2": Rough.MATERN12,
    "3/2": Rough.MATERN32,
    "5/2": Kernel.MATERN52,
    "inf": Kernel.RBF,
}


class Roughness(StrEnum):
    """The kind of function the samples look like at their own resolution."""

    SMOOTH = "smooth"
    KINKED = "kinked"
    JUMPS = "jumps"


@dataclass(frozen=True)
class Missed:
    """A sample at or around the point of interest, left out: error in `unit`, and in deviations."""

    error: float
    sigmas: float
    at_point: bool

    @property
    def where(self) -> str:
        """Of it, as the subject of a sentence."""
        return "the design" if self.at_point else "a sample beside the design"


@dataclass(frozen=True, eq=False)
class Quality:
    """One output, its errors in `unit`.

    true, predicted (n,): each sample, and its prediction without it; standardised (n,): the
    difference over the deviation of the band; coverage: share inside nominal 95 % bands.
    loo, kfold: errors left out one by one and in ten folds. extrapolates: what is amiss at the
    point of interest, nothing where samples support it. at_point: where that point is itself a
    sample, the error there without it in `unit` and in predicted deviations; None elsewhere.
    around: the same of every sample around that point, itself included.

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
    at_point: tuple[float, float] | None = None
    around: tuple[Missed, ...] = ()

    @property
    def missed(self) -> Missed | None:
        """The worst sample at or around the point that the others miss by more than they say."""
        span = 100.0 if self.unit == "%" else float(np.ptp(self.true))
        bad = [m for m in self.around if m.sigmas > SIGMAS and abs(m.error) > SHARE * span]
        return max(bad, key=lambda m: (m.at_point, abs(m.error)), default=None)

    @property
    def at_design(self) -> str:
        """Whether the samples support the point of interest, and if so how well they do."""
        if self.unsupported:
            return self.unsupported
        most = max((abs(m.error) for m in self.around), default=0.0)
        sigmas = max((m.sigmas for m in self.around), default=0.0)
        if sigmas <= SIGMAS:
            return "supported"
        return (
            f"supported to {most:.2g} {self.unit}, but bands too narrow ({sigmas:.0f} deviations)"
        )

    @property
    def poor(self) -> bool:
        """Whether left-out samples are predicted too badly to speak of support."""
        return not self.kfold.q2 >= POOR

    @property
    def samples_look(self) -> str:
        """Smooth, kinked or torn, as far as the surrogate follows the samples at all."""
        if self.poor:
            return "poorly followed"
        if self.roughness is Roughness.KINKED and self.kfold.q2 >= GOOD:
            return "nearly smooth"
        return self.roughness.value

    @property
    def unsupported(self) -> str:
        """Why the samples do not support the point of interest; nothing where they do."""
        if self.extrapolates:
            return "; ".join(self.extrapolates)
        if self.poor:
            return f"followed to Q² {self.kfold.q2:.3g} only"
        missed = self.missed
        if missed is None:
            return ""
        what = "a sample" if missed.at_point else "one"
        return (
            f"{missed.where} is {what} that the others miss by {abs(missed.error):.3g} "
            f"{self.unit}, {missed.sigmas:.1f} deviations"
        )

    @property
    def smooth_enough(self) -> bool:
        """Whether one smooth surrogate suits the samples."""
        smooth = self.roughness is Roughness.SMOOTH and not self.poor
        return smooth or self.kfold.q2 >= EXCELLENT


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
    samples, residuals, deviations, folded = _left_out(process, seed)
    standardised = residuals / (process.band * deviations)
    predicted = samples.Y - residuals
    unit_x = (np.asarray(x, float) - process.lower) / (process.upper - process.lower)
    away = np.abs(process.X - unit_x).max(axis=1)
    around = tuple(
        Missed(float(factor * residuals[i]), float(abs(standardised[i])), bool(away[i] <= SAME))
        for i in np.flatnonzero(away <= NEAR)
    )
    at_point = next(((m.error, m.sigmas) for m in around if m.at_point), None)
    return Quality(
        name=name,
        unit=unit,
        true=np.exp(samples.Y) if logarithm else factor * samples.Y,
        predicted=np.exp(predicted) if logarithm else factor * predicted,
        standardised=standardised,
        loo=errors(factor * residuals, factor * samples.Y),
        kfold=errors(factor * folded, factor * samples.Y),
        coverage=float(np.mean(np.abs(standardised) <= TWO_SIDED_95)),
        roughness=_roughness_of(process, seed),
        extrapolates=extrapolation(process, samples.X, x).reasons,
        at_point=at_point,
        around=around,
    )


@lru_cache(maxsize=8)  # a process is judged before it is relied on, and again in the report
def _left_out(process: GaussianProcess, seed: int) -> tuple[Samples, Array, Array, Array]:
    """The samples, residuals and deviations one by one, residuals fold by fold: nothing of x."""
    samples = _samples(process)
    folded = held_out(
        lambda part: conditioned(process.hyperparameters, part, process.kernel, np.empty(0)),
        samples,
        min(FOLDS, len(process.X)),
        seed,
    )
    return (samples, *loo_errors(process), folded)


@lru_cache(maxsize=8)
def _roughness_of(process: GaussianProcess, seed: int) -> Roughness:
    n = len(process.X)
    if n < LEAST_FOR_ROUGHNESS:
        return Roughness.SMOOTH
    return roughness(smoothness_likelihoods(process.X, process.targets[:n], seed))


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
    n, d = X.shape
    rows = np.random.default_rng(seed).permutation(n)[:ROUGHNESS_ORDER]
    starts = [np.array([0.5] * d + [1.0]), np.array([5.0] * d + [100.0])]
    found = {}
    for name, family in MATERN.items():

        def at(natural: Array, family: Family = family) -> tuple[float, Array]:
            parameters = Hyperparameters(natural[:d], float(natural[d]), NUGGET)
            value, slope = log_likelihood(family, X[rows], values[rows], parameters)
            return value, slope[: d + 1]

        found[name] = maximised(at, starts, [LENGTH_BOUNDS] * d + [SIGNAL_BOUNDS])[0]
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
