"""Derivatives by central differences of fourth order."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ccd_casadi.support.arrays import Array

Value = TypeVar("Value", float, np.ndarray)


def difference(f: Callable[[float], Value], h: float) -> Value:
    """df/dh at zero from f(±h) and f(±2h); the error is of order h⁴."""
    return (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)


def slopes(values: Callable[[Array], Array], at: Array, h: float) -> Array:
    """∂values/∂x_j (M, n) at a point x (n,)."""
    columns = [difference(lambda t, e=e: values(at + t * e), h) for e in np.eye(len(at))]
    return np.stack(columns, axis=1)
