"""How well a surrogate predicts: errors left out, calibrated deviations, and extrapolation."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, loo_errors
from surrogates.samples import Array, Errors, errors


@dataclass(frozen=True)
class ExtrapolationOptions:
    """Limits beyond which samples do not support a point."""

    nearest: int = 500  # samples nearest to it that enter the hull: others seldom change it
    spacings: float = 1.0  # typical spacings outside of the hull
    widest_gaps: float = 2.0  # between samples: distance to the nearest
    deviations: float = 2.0  # over the deviation that is met one spacing away from the samples
    rounding: float = 1e-9  # outside of the unit box


@dataclass(frozen=True)
class Extrapolation:
    """The distance of a point from the samples, in the unit box, and what follows.

    Parameters
    ----------
    hull, nearest : float
        Distance to the samples' convex hull, and to the nearest one.
    spacing : float
        Median distance of a sample to its nearest neighbour.
    deviation : float or None
        Predicted deviation over that one spacing from the samples (95 % quantile); None: that is 0.
    reasons : tuple of str
        A sentence for everything amiss; with none the point is supported.
    """

    hull: float
    nearest: float
    spacing: float
    deviation: float | None
    reasons: tuple[str, ...]


def extrapolation(
    surrogate: GaussianProcess,
    X: ArrayLike,
    x: ArrayLike,
    options: ExtrapolationOptions = ExtrapolationOptions(),
) -> Extrapolation:
    """Compare a point with the samples that a surrogate was fitted to.

    Flagged are points outside the box, further outside the convex hull of the samples
    than their typical spacing (in many inputs almost every point of the box is a
    little outside it), further from every sample than twice the widest gap among them,
    or where the deviation is twice the largest that is usual one spacing from a sample.

    Parameters
    ----------
    surrogate : GaussianProcess
        What was fitted.
    X : array (n, d)
        Its samples, in input units.
    x : array (d,)
        The point.
    options : ExtrapolationOptions
        Numbers of the method.

    Returns
    -------
    Extrapolation
        Distances, and a reason for each flag.

    Raises
    ------
    ValueError
        The point or the samples do not have the surrogate's inputs.
    """
    from scipy.spatial import cKDTree

    low, span = surrogate.lower, surrogate.upper - surrogate.lower
    samples, point = surrogate.in_unit_box(X), surrogate.in_unit_box(x)[0]
    near = cKDTree(samples).query(samples, k=2)[0][:, 1]  # to the nearest other sample
    spacing = float(np.median(near))
    distances = np.linalg.norm(samples - point, axis=1)
    nearest = float(distances.min())
    hull = hull_distance(samples[np.argsort(distances)[: options.nearest]], point)
    reasons = []
    beyond = np.flatnonzero((point < -options.rounding) | (point > 1.0 + options.rounding))
    if beyond.size:
        reasons.append(f"input {', '.join(map(str, beyond))} is outside the sampled box")
    if hull > options.spacings * spacing:
        reasons.append(
            f"the point lies {hull:.3g} box widths outside the hull of the samples, which are "
            f"{spacing:.3g} apart"
        )
    if nearest > options.widest_gaps * float(near.max()):
        reasons.append(
            f"the nearest sample is {nearest:.3g} box widths away, where samples are "
            f"{spacing:.3g} apart"
        )
    rng = np.random.default_rng(0)
    step = rng.standard_normal(samples[: options.nearest].shape)
    step *= spacing / np.linalg.norm(step, axis=1, keepdims=True)
    around = low + span * np.clip(samples[: options.nearest] + step, 0.0, 1.0)
    usual = float(np.quantile(surrogate.predict(around, return_std=True)[1], 0.95))
    here = float(surrogate.predict(low + span * point, return_std=True)[1][0])
    deviation = here / usual if usual > 0.0 else None
    if deviation is not None and deviation > options.deviations:
        reasons.append(
            f"the predicted deviation is {deviation:.3g} times what is usual "
            "one spacing from a sample"
        )
    return Extrapolation(hull, nearest, spacing, deviation, tuple(reasons))


def hull_distance(samples: Array, point: Array) -> float:
    """Return min ‖Xᵀw - x‖ over w >= 0, Σ w = 1: the distance of x (d,) to the hull of X (n, d).

    >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    >>> round(hull_distance(square, np.array([1.5, 0.5])), 6)
    0.5
    """
    from scipy.optimize import nnls  # 0.3 s to import

    # The sum as one more, heavy equation; what it is missed by is corrected afterwards.
    heavy = 1e3
    A = np.vstack([samples.T, np.full(len(samples), heavy)])
    w, _ = nnls(A, np.append(point, heavy))
    return float(np.linalg.norm(samples.T @ (w / w.sum()) - point))


@dataclass(frozen=True)
class QualityOptions:
    """Limits of the quality of a surrogate."""

    followed: float = 0.995  # Q² of left-out samples above which the surrogate follows them
    poor: float = 0.9  # below which it does poorly
    same: float = 1e-6  # of the box: a sample this close to the point of interest is that point
    near: float = 0.05  # of the box: samples this close are around it
    # Left out, such a sample may be off by this many of its deviations, or by this share of the
    # samples' range, before the others miss it.
    sigmas: float = 3.0
    share: float = 1e-3


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

    options: ClassVar[QualityOptions] = QualityOptions()

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
        """The error at that point without it where it is a sample, in `unit` and in deviations."""
        return next(((m.error, m.sigmas) for m in self.around if m.at_point), None)

    @property
    def missed(self) -> Missed | None:
        """The worst sample at or around the point that the others miss by more than they say."""
        span = 100.0 if self.unit == "%" else float(np.ptp(self.true))
        sigmas, least = self.options.sigmas, self.options.share * span
        bad = [m for m in self.around if m.sigmas > sigmas and abs(m.error) > least]
        return max(bad, key=lambda m: (m.at_point, abs(m.error)), default=None)

    @property
    def at_design(self) -> str:
        """Whether the samples support the point of interest, and if so how well they do."""
        if self.unsupported:
            return self.unsupported
        most = max((abs(m.error) for m in self.around), default=0.0)
        sigmas = max((m.sigmas for m in self.around), default=0.0)
        if sigmas <= self.options.sigmas:
            return "supported"
        return (
            f"supported to {most:.2g} {self.unit}, but bands too narrow ({sigmas:.0f} deviations)"
        )

    @property
    def poor(self) -> bool:
        """Whether left-out samples are predicted too badly to speak of support."""
        return not self.loo.q2 >= self.options.poor

    @property
    def followed(self) -> bool:
        """Whether one smooth surrogate suits the samples."""
        return self.loo.q2 >= self.options.followed

    @property
    def samples_are(self) -> str:
        """The way in which the surrogate follows them; kinks and jumps are followed roughly at
        best."""
        return "followed" if self.followed else f"{'poorly' if self.poor else 'roughly'} followed"

    @property
    def unsupported(self) -> str:
        """The reason why the samples do not support the point of interest; nothing where they
        do."""
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
               bool(away[i] <= Quality.options.same))
        for i in np.flatnonzero(away <= Quality.options.near)
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
