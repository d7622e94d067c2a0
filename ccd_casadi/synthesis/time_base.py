"""Whether matrices without a sampling period are those of a system in discrete time."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class TimeBaseOptions:
    """Numbers by which a discrete A is known from its eigenvalues."""

    outside: float = 1e-3  # what |λ| may exceed 1 by: rounding, and slow unstable poles
    near: float = 0.8  # |λ| from which an eigenvalue lies near the unit circle
    share: float = 0.5  # of all eigenvalues: more are near the circle with a positive real part
    least: int = 2  # states: one eigenvalue alone shows nothing


HINT = "the matrices appear discrete: all eigenvalues within the unit circle, most of them near 1"


def appears_discrete(A: Array, options: TimeBaseOptions = TimeBaseOptions()) -> bool:
    """Report whether A is likely one of discrete time.

    e^(pT) of a plant that is sampled fast enough lies near 1. The same numbers as poles in 1/s
    would be unstable nearly all, and all slower than 1 rad/s.

    Parameters
    ----------
    A : (n, n) array
    options : TimeBaseOptions

    Returns
    -------
    bool

    Examples
    --------
    >>> appears_discrete(np.array([[1.0, 0.001], [0.0, 0.99]]))
    True
    >>> appears_discrete(np.array([[0.0, 1.0], [-1.0, -0.1]]))
    False
    """
    if len(A) < options.least:
        return False
    roots = np.linalg.eigvals(A)
    size = np.abs(roots)
    usual = (size >= options.near) & (roots.real > 0.0)
    return bool(size.max() <= 1.0 + options.outside and usual.mean() > options.share)
