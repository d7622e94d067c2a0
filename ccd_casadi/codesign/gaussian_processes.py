"""Which Gaussian process stands in for the truth: the kernel that a case names, or the better one.

Only processes serve here: lifted has gradients, retraining and the report need deviations.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ccd_casadi.codesign.verified import Verified
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import Progress
from surrogates import GaussianProcess, Kernel, Quality, SurrogateFitError, condition, quality_of
from surrogates.fitting import calibrate

BOUNDED = ("sensitivity_peak", "sensitivity_low", "compliance")  # whose logarithms are fitted


def kernels_of(kind: str) -> tuple[Kernel, ...]:
    """The kernels that `[outer] surrogate` allows: the one it names, all for "auto".

    >>> [kernel.value for kernel in kernels_of("auto")]
    ['matern52', 'rbf']
    """
    return tuple(Kernel) if kind == "auto" else (Kernel(kind),)


def best_left_out(processes: Iterable[GaussianProcess]) -> GaussianProcess:
    """The process with the least rms error on samples left out; the first of equals."""
    return min(processes, key=lambda process: process.loo.rms)


def interpolating(
    process: GaussianProcess, X: Array, Y: Array, dY: Array | None, longest: float = np.inf
) -> GaussianProcess:
    """The process conditioned on other samples, hyperparameters kept but for their noise.

    The truth has none: what a fit to the whole box takes for noise is what its kernel cannot
    follow there, and would be averaged away sample by sample where samples gather. `longest`: of
    its length scales, in shares of the box.
    """
    exact = replace(
        process.hyperparameters,
        length_scales=np.minimum(process.hyperparameters.length_scales, longest),
        noise_variance=0.0, gradient_noise_variance=0.0,
    )  # fmt: skip
    ends = {"lower": process.lower, "upper": process.upper}
    return calibrate(condition(exact, X, Y, **ends, kernel=process.kernel, dY=dY))


def with_sample(
    process: GaussianProcess,
    x: Array,
    value: float,
    slope: Array,
    *,
    same: float = 1e-6,
    rounding: float = 1e-6,
) -> GaussianProcess:
    """The process with one more sample (d,), its slope (d,) too where it has those of the others.

    It replaces samples at the same x, closer than `same` in shares of the box. The process as it is
    where it cannot take it, or would predict no better there; a relative error up to `rounding`
    is good enough.
    """
    n = len(process.X)
    sloped = process.targets.size > n
    width = process.upper - process.lower
    if sloped and not np.isfinite(slope).all():
        return process
    others = np.abs(process.X - (x - process.lower) / width).max(axis=1) > same
    targets = process.output_scale * process.targets.reshape(-1, n)[:, others]
    dY = np.vstack([targets[1:].T / width, slope]) if sloped else None
    X = np.vstack([process.lower + width * process.X[others], x])
    Y = np.append(process.output_mean + targets[0], value)
    best = process

    def missed(each: GaussianProcess) -> float:
        return abs(float(each.predict(x[None, :])[0]) - value)

    for longest in (np.inf, 10.0, 3.0, 1.0, 0.3):  # of the box: what a jump lets a process have
        try:
            best = min(best, interpolating(process, X, Y, dY, longest), key=missed)
        except SurrogateFitError:
            continue
        if missed(best) <= rounding * abs(value):
            break
    return best


def surrogate_quality(
    processes: Sequence[GaussianProcess], at: Verified, *, quiet: bool = True
) -> tuple[Quality, ...]:
    """Judge the processes of what J counts, and of ln of each bounded figure, at a design."""
    figure = at.problem.figure
    outputs = [(figure.key, figure.unit, figure.factor), *((name, "%", 100.0) for name in BOUNDED)]
    found = []
    bar = Progress(len(processes), "judging the surrogates", quiet)
    for process, (name, unit, factor) in zip(bar.over(processes), outputs, strict=False):
        point = at.point[: process.lower.size]
        found.append(quality_of(process, point, name=name, unit=unit, factor=factor,
                                logarithm=name in BOUNDED))  # fmt: skip
    return tuple(found)


def recommendation(qualities: Sequence[Quality]) -> str:
    """Recommend what follows from the quality of surrogates.

    Parameters
    ----------
    qualities : sequence of Quality
        Of all surrogates of a run.

    Returns
    -------
    str
        One or two sentences; empty where there is no surrogate.
    """
    if not qualities:
        return ""
    said, names = [], {q.name: q.name.replace("_", " ") for q in qualities}
    poor = [q for q in qualities if q.poor]
    if poor:
        which = ", ".join(f"{names[q.name]} (Q² {q.loo.q2:.2g})" for q in poor)
        said.append(
            f"Left-out samples of {which} are predicted poorly: more samples are needed before the "
            "surrogate says anything away from the design."
        )
    rough = [q for q in qualities if not q.followed and not q.poor]
    if rough:
        which = ", ".join(f"{names[q.name]} (Q² {q.loo.q2:.3g})" for q in rough)
        said.append(
            f"Left-out samples of {which} are predicted roughly, as those of a function with kinks "
            "or jumps are: one smooth surrogate follows them only near the design."
        )
        said.append(
            "Solve with --formulation lifted, whose outputs are smooth where the best bandwidth "
            "is not."
            if len(qualities) == 1
            else "The larger of two local peaks is kinked where they are equal; the rounds refit "
            "near the design, where one of them is the larger."
        )
    beyond = [names[q.name] for q in qualities if q.extrapolates]
    if beyond:
        said.append(
            f"At the design the surrogate of {', '.join(beyond)} extrapolates: trust the "
            "verification, and retrain before moving bounds or weights."
        )
    for q in qualities:
        if q.unsupported and not q.extrapolates and not q.poor:
            said.append(f"{names[q.name].capitalize()}: {q.unsupported}.")
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
                "coverage_95": q.coverage,
                "samples_are": q.samples_are,
                "extrapolates": list(q.extrapolates),
                "left_out_at_design": None
                if q.at_point is None
                else {"error": q.at_point[0], "deviations": q.at_point[1]},
            }
            for q in qualities
        },
        "recommendation": recommendation(qualities),
    }
