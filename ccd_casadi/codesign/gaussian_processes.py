"""Which Gaussian process stands in for the truth: the kernel that a case names, or the better one.

Only processes serve here: lifted has gradients, retraining and the report need deviations.
"""

from collections.abc import Iterable

from surrogates import GaussianProcess, Kernel


def kernels_of(kind: str) -> tuple[Kernel, ...]:
    """The kernels that `[outer] surrogate` allows: the one it names, all for "auto".

    >>> [kernel.value for kernel in kernels_of("auto")]
    ['matern52', 'rbf']
    """
    return tuple(Kernel) if kind == "auto" else (Kernel(kind),)


def best_left_out(processes: Iterable[GaussianProcess]) -> GaussianProcess:
    """The process with the least rms error on samples left out; the first of equals."""
    return min(processes, key=lambda process: process.loo.rms)
