"""How far the last surrogates of a run can be trusted, judged by their own samples.

Left out one by one and fold by fold, with the hyperparameters kept (estimated anew they would
cost more than the whole solve, and differ by little); bands against residuals; kinks and jumps;
and whether the design lies where the samples are.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from surrogates import Errors, GaussianProcess, Roughness, errors, extrapolation, loo_errors
from surrogates.diagnostics import roughness, smoothness_likelihoods
from surrogates.gaussian_process import TWO_SIDED_95, conditioned
from surrogates.samples import Samples
from surrogates.validation import held_out

FOLDS = 10
LEAST_FOR_ROUGHNESS = 20
# Q² above which the samples are followed whatever their roughness; above which a kink is a slight
# one; and below which the surrogate follows them poorly, smooth or not.
EXCELLENT = 1.0 - 1e-6
GOOD = 0.995
POOR = 0.9
# A sample this close to the design (share of the box) is the design.
SAME = 1e-6
# Left out, the sample at the design is off by more of its deviations than this, and by more than
# this share of the samples' range: the others do not support the design.
SIGMAS = 3.0
SHARE = 1e-3
# Name, unit of its errors, the number that turns the surrogate's unit into it, whether what is
# fitted is a logarithm.
OUTPUTS = (
    ("bandwidth", "Hz", 1.0 / HZ, False),
    ("sensitivity_peak", "%", 100.0, True),
    ("sensitivity_low", "%", 100.0, True),
)


@dataclass(frozen=True, eq=False)
class Quality:
    """One output, its errors in `unit` (those of the peak and the low end of S in %).

    true, predicted (n,): each sample in Hz or as a gain, and its prediction without it;
    standardised (n,): the difference over the deviation of the band; coverage: share inside
    nominal 95 % bands. extrapolates: what is amiss at the design, nothing where samples
    support it. at_design: where the design is itself a sample, the error there without it in `unit`
    and in predicted deviations; None elsewhere.
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
    at_design: tuple[float, float] | None = None

    @property
    def poor(self) -> bool:
        """Whether left-out samples are predicted too badly to speak of support."""
        return not self.kfold.q2 >= POOR

    @property
    def samples_look(self) -> str:
        """Smooth, kinked or torn, with how well the surrogate follows them."""
        if self.poor:
            return "poorly followed"
        if self.roughness is Roughness.KINKED and self.kfold.q2 >= GOOD:
            return "nearly smooth"
        return self.roughness.value

    @property
    def unsupported(self) -> str:
        """Why the samples do not support the design; nothing where they do."""
        if self.extrapolates:
            return "; ".join(self.extrapolates)
        if self.poor:
            return f"followed to Q² {self.kfold.q2:.3g} only"
        if self.at_design is not None:
            error, sigmas = self.at_design
            unit = 100.0 if self.unit == "%" else float(np.ptp(self.true))
            if sigmas > SIGMAS and abs(error) > SHARE * unit:
                return (
                    f"the design is a sample that the others miss by {abs(error):.3g} {self.unit}, "
                    f"{sigmas:.1f} deviations"
                )
        return ""

    @property
    def smooth_enough(self) -> bool:
        """Whether one smooth surrogate suits the samples."""
        smooth = self.roughness is Roughness.SMOOTH and not self.poor
        return smooth or self.kfold.q2 >= EXCELLENT


def surrogate_quality(
    processes: Sequence[GaussianProcess], x: Array, seed: int = 0
) -> tuple[Quality, ...]:
    """Judge the processes of ω_b, or of ω_b, ln‖S‖∞ and ln|S(jω_low)|, at the design x."""
    return tuple(
        _quality(process, *output, x[: process.lower.size], seed)
        for process, output in zip(processes, OUTPUTS, strict=False)
    )


def recommendation(qualities: Sequence[Quality]) -> str:
    """What follows from them, in one or two sentences; nothing where there is no surrogate."""
    if not qualities:
        return ""
    said = []
    poor = [q for q in qualities if q.poor]
    if poor:
        which = ", ".join(f"{q.name.replace('_', ' ')} (Q² {q.kfold.q2:.2g})" for q in poor)
        said.append(
            f"Left-out samples of {which} are predicted poorly: more samples are needed before the "
            "surrogate says anything away from the design."
        )
    rough = [q.name.replace("_", " ") for q in qualities if not (q.smooth_enough or q.poor)]
    if rough:
        what = ", ".join(rough)
        said.append(
            f"The samples of {what} look kinked or torn: one smooth surrogate follows them only "
            "near the design. "
            + (
                "Solve with --formulation lifted, whose outputs are smooth where the best "
                "bandwidth is not."
                if len(qualities) == 1
                else "The larger of two local peaks is kinked where they are equal; a surrogate "
                "of each (surrogates.fit_maximum) would not be."
            )
        )
    beyond = [q.name.replace("_", " ") for q in qualities if q.extrapolates]
    if beyond:
        said.append(
            f"At the design the surrogate of {', '.join(beyond)} extrapolates: trust the "
            "verification, and retrain before moving bounds or weights."
        )
    missed = [q for q in qualities if q.unsupported and not q.extrapolates and not q.poor]
    for q in missed:
        said.append(f"{q.name.replace('_', ' ').capitalize()}: {q.unsupported}.")
    return " ".join(said) or "The surrogates follow their samples, and support the design."


def quality_dict(qualities: Sequence[Quality]) -> dict[str, Any]:
    """`surrogate_quality` of result.json; errors in the unit that is named."""
    if not qualities:
        return {}
    return {
        "outputs": {
            q.name: {
                "unit": q.unit,
                "samples": len(q.true),
                "leave_one_out": asdict(q.loo),
                "k_fold": asdict(q.kfold),
                "coverage_95": q.coverage,
                "roughness": q.roughness.value,
                "extrapolates": list(q.extrapolates),
                "left_out_at_design": None
                if q.at_design is None
                else {"error": q.at_design[0], "deviations": q.at_design[1]},
            }
            for q in qualities
        },
        "recommendation": recommendation(qualities),
    }


def _quality(
    process: GaussianProcess, name: str, unit: str, factor: float, log: bool, x: Array, seed: int
) -> Quality:
    samples = _samples(process)
    residuals, deviations = loo_errors(process)
    n = len(process.X)
    folded, _ = held_out(
        lambda part: conditioned(process.hyperparameters, part, process.kernel, np.empty(0)),
        samples,
        min(FOLDS, n),
        seed,
    )
    kind = Roughness.SMOOTH
    if n >= LEAST_FOR_ROUGHNESS:
        kind = roughness(smoothness_likelihoods(process.X, process.targets[:n], 0.0, seed))
    standardised = residuals / (process.band * deviations)
    unit_x = (x - process.lower) / (process.upper - process.lower)
    away = np.abs(process.X - unit_x).max(axis=1)
    at = int(np.argmin(away))
    at_design = None
    if away[at] <= SAME:
        at_design = (float(factor * residuals[at]), float(abs(standardised[at])))
    return Quality(
        name=name,
        unit=unit,
        true=np.exp(samples.Y) if log else factor * samples.Y,
        predicted=np.exp(samples.Y - residuals) if log else factor * (samples.Y - residuals),
        standardised=standardised,
        loo=errors(factor * residuals, factor * samples.Y),
        kfold=errors(factor * folded, factor * samples.Y),
        coverage=float(np.mean(np.abs(standardised) <= TWO_SIDED_95)),
        roughness=kind,
        extrapolates=extrapolation(process, samples.X, x).reasons,
        at_design=at_design,
    )


def _samples(process: GaussianProcess) -> Samples:
    """The samples that a process holds, in input and output units."""
    n, d = process.X.shape
    width = process.upper - process.lower
    targets = process.output_scale * process.targets.reshape(-1, n)
    slopes = None if len(targets) == 1 else targets[1 : 1 + d].T / width
    X = process.lower + process.X * width
    return Samples(process.lower, process.upper, X, process.output_mean + targets[0], slopes)
