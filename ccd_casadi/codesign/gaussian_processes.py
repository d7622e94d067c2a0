"""Which Gaussian process stands in for the truth: the kernel that a case names, or the better one.

Only processes serve here: lifted has gradients, retraining and the report need deviations.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess, Kernel, SurrogateFitError, condition

TAKEN = 1e-6  # relative: an error at a sample that is rounding
SAME = 1e-6  # of the box: samples that are closer are of one place


def kernels_of(kind: str) -> tuple[Kernel, ...]:
    """The kernels that `[outer] surrogate` allows: the one it names, all for "auto".

    >>> [kernel.value for kernel in kernels_of("auto")]
    ['matern52', 'rbf']
    """
    return tuple(Kernel) if kind == "auto" else (Kernel(kind),)


def best_left_out(processes: Iterable[GaussianProcess]) -> GaussianProcess:
    """The process with the least rms error on samples left out; the first of equals."""
    return min(processes, key=lambda process: process.loo.rms)


def with_sample(process: GaussianProcess, x: Array, value: float, slope: Array) -> GaussianProcess:
    """The process with one more sample (d,), its slope (d,) too where it has those of the others.

    It takes the place of samples at the same x. The process as it is where it cannot take it, or
    would say no better there.
    """
    n = len(process.X)
    sloped = process.targets.size > n
    width = process.upper - process.lower
    if sloped and not np.isfinite(slope).all():
        return process
    others = np.abs(process.X - (x - process.lower) / width).max(axis=1) > SAME
    targets = process.output_scale * process.targets.reshape(-1, n)[:, others]
    dY = np.vstack([targets[1:].T / width, slope]) if sloped else None
    X = np.vstack([process.lower + width * process.X[others], x])
    Y = np.append(process.output_mean + targets[0], value)
    box, best = {"lower": process.lower, "upper": process.upper}, process

    def missed(each: GaussianProcess) -> float:
        return abs(float(each.predict(x[None, :])[0]) - value)

    scales = process.hyperparameters.length_scales
    for longest in (np.inf, 10.0, 3.0, 1.0, 0.3):  # of the box: what a jump lets a process have
        exact = replace(
            process.hyperparameters, length_scales=np.minimum(scales, longest),
            noise_variance=0.0, gradient_noise_variance=0.0,
        )  # fmt: skip
        try:
            found = condition(exact, X, Y, **box, kernel=process.kernel, dY=dY)
        except SurrogateFitError:
            continue
        best = min(best, found, key=missed)
        if missed(best) <= TAKEN * abs(value):
            break
    return best
