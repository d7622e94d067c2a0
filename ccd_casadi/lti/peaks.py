"""Local maxima of a gain over frequency, and the top of one between its neighbours on a grid."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from ccd_casadi.support.arrays import Array


def local_maxima(values: Array) -> np.ndarray:
    """Places inside the array that are above their left neighbour and not below their right one."""
    return np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1


def climbed(
    gain: Callable[[float], float], low: float, high: float, xatol: float = 1e-10
) -> tuple[float, float]:
    """(ω, gain) at the local maximum between two frequencies above 0, by Brent's method in ln ω.

    `xatol`: in ln ω.
    """
    top = minimize_scalar(
        lambda x: -gain(float(np.exp(x))), bounds=(np.log(low), np.log(high)),
        method="bounded", options={"xatol": xatol},
    )  # fmt: skip
    return float(np.exp(top.x)), -float(top.fun)
