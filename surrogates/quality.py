"""How far a Gaussian process can be trusted, judged by its own samples.

Left out one by one, with the hyperparameters kept (estimated anew they would cost more than a whole
solve, and differ by little); bands against residuals; and whether a point of interest lies where
the samples are.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from surrogates.extrapolation import extrapolation
from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, loo_errors
from surrogates.interface import Array, Errors, errors

# Q² of left-out samples above which the surrogate follows them, and below which it does poorly.
FOLLOWED = 0.995
POOR = 0.9
# A sample this close to the point of interest (share of the box) is that point. Left out, it may be
# off by so many of its deviations, or by so much of the samples' range, before the others miss it.
SAME = 1e-6
SIGMAS = 3.0
SHARE = 1e-3
NEAR = 0.05  # share of the box: samples this close to the point of interest are around it


@dataclass(frozen=True)
class Missed:
    """A sample at or around the point of interest, left out: error in `unit`, and in deviations
    as the likelihood has them, not stretched by the band."""

    error: float
    sigmas: float
    at_point: bool


@dataclass(frozen=True, eq=False)
class Quality:
    """One output of a surrogate, judged at samples left out [1]_.

    Parameters
    ----------
    name, unit : str
        Of the output; errors are in `unit`.
    true, predicted, standardised : array (n,)
        Each sample, its prediction without it, and the difference over the deviation of the band.
    loo, coverage : Errors, float
        Errors left out one by one; share inside nominal 95 % bands.
    extrapolates : tuple of str
        What is amiss at the point of interest; nothing where samples support it.
    around : tuple of Missed
        Error, in `unit` and in deviations, of every sample around that point, itself included.

    .. [1] Rasmussen & Williams (2006), 5.4.2.
    """

    name: str
    unit: str
    true: Array
    predicted: Array
    standardised: Array
    loo: Errors
    coverage: float
    extrapolates: tuple[str, ...]
    around: tuple[Missed, ...] = ()

    @property
    def at_point(self) -> tuple[float, float] | None:
        """Where that point is a sample, the error there without it, in `unit` and in deviations."""
        return next(((m.error, m.sigmas) for m in self.around if m.at_point), None)

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
        return not self.loo.q2 >= POOR

    @property
    def followed(self) -> bool:
        """Whether one smooth surrogate suits the samples."""
        return self.loo.q2 >= FOLLOWED

    @property
    def samples_are(self) -> str:
        """How well the surrogate follows them; kinks and jumps are followed roughly at best."""
        return "followed" if self.followed else f"{'poorly' if self.poor else 'roughly'} followed"

    @property
    def unsupported(self) -> str:
        """Why the samples do not support the point of interest; nothing where they do."""
        if self.extrapolates:
            return "; ".join(self.extrapolates)
        if self.poor:
            return f"followed to Q² {self.loo.q2:.3g} only"
        missed = self.missed
        if missed is None:
            return ""
        of = "the design is a sample" if missed.at_point else "a sample beside the design is one"
        error = f"{abs(missed.error):.3g} {self.unit}, {missed.sigmas:.1f} deviations"
        return f"{of} that the others miss by {error}"


def quality_of(
    process: GaussianProcess,
    x: Array,
    *,
    name: str = "output",
    unit: str = "",
    factor: float = 1.0,
    logarithm: bool = False,
) -> Quality:
    """Judge a process by the samples it holds, and at a point of interest.

    Parameters
    ----------
    process : GaussianProcess
        What is judged.
    x : array (d,)
        The point of interest, in input units.
    name, unit, factor : str, str, float
        Of the output, as the result gives them; the factor turns it into `unit`.
    logarithm : bool
        The output is a logarithm: samples and predictions are those of its exponential.

    Returns
    -------
    Quality
        Errors left out, coverage, support at x.

    Raises
    ------
    ValueError
        The point does not have the process's inputs.
    """
    residuals, deviations = _left_out(process)
    standardised = residuals / (process.band * deviations)
    X = process.lower + process.X * (process.upper - process.lower)
    true = process.output_mean + process.output_scale * process.targets[: len(X)]
    predicted = true - residuals
    away = np.abs(process.X - process.in_unit_box(x)).max(axis=1)
    around = tuple(
        # By the deviations before they were stretched: a wide band excuses no error here.
        Missed(float(factor * residuals[i]), float(abs(residuals[i] / deviations[i])),
               bool(away[i] <= SAME))
        for i in np.flatnonzero(away <= NEAR)
    )  # fmt: skip
    return Quality(
        name=name,
        unit=unit,
        true=np.exp(true) if logarithm else factor * true,
        predicted=np.exp(predicted) if logarithm else factor * predicted,
        standardised=standardised,
        loo=errors(factor * residuals, factor * true),
        coverage=float(np.mean(np.abs(standardised) <= TWO_SIDED_95)),
        extrapolates=extrapolation(process, X, x).reasons,
        around=around,
    )


# A process is judged before it is relied on, and again in the report.
_left_out = lru_cache(maxsize=8)(loo_errors)
