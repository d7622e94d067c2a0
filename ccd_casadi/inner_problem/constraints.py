"""λ(θ) <= 0 in shares of each constraint's own size: whether it is met, and which of it are active.

A user may write a constraint in Pa or in m. Its size is by how much it changes over the box, to
first order from the start, or its value there where that is more: no unit decides what is rounding.
"""

from functools import lru_cache

import numpy as np

from ccd_casadi.inner_problem.plant_source import PlantSource, plant_from
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import constraint_values, hardware_slopes
from ccd_casadi.support.arrays import Array

MET = 1e-9  # of its size: so far past 0 a constraint is met to rounding
ACTIVE = 1e-6  # of its size: so near to 0 a design runs along it


def constraint_sizes(problem: CoDesignProblem) -> Array:
    """The size (m,) of each constraint, positive."""
    return _sizes(problem.source, problem.names, problem.lower, problem.upper, problem.start)


def constraint_shares(problem: CoDesignProblem, theta: Array | tuple[float, ...]) -> Array:
    """λ(θ) (m,) over the sizes."""
    return constraint_values(plant_of(problem), theta) / constraint_sizes(problem)


def violated(problem: CoDesignProblem, theta: Array | tuple[float, ...]) -> tuple[str, ...]:
    """Names of the constraints that θ breaks by more than rounding; none where it is allowed."""
    names, shares = plant_of(problem).constraint_names, constraint_shares(problem, theta)
    return tuple(name for name, share in zip(names, shares, strict=True) if not share <= MET)


def binding(problem: CoDesignProblem, theta: Array | tuple[float, ...]) -> tuple[str, ...]:
    """Names of the constraints that are active at θ."""
    names, shares = plant_of(problem).constraint_names, constraint_shares(problem, theta)
    return tuple(name for name, share in zip(names, shares, strict=True) if share >= -ACTIVE)


@lru_cache(maxsize=8)
def _sizes(
    source: PlantSource,
    names: tuple[str, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
    start: tuple[float, ...],
) -> Array:
    plant = plant_from(source, names, lower, upper)
    if not plant.constraint_names:
        return np.ones(0)
    change = np.abs(hardware_slopes(plant, start)[1]) @ np.subtract(upper, lower)
    values = [np.abs(constraint_values(plant, theta)) for theta in (start, lower, upper)]
    sizes = np.fmax(change, values[0])  # NaN where one is unknown
    for size in (*values[1:], np.ones_like(sizes)):
        sizes = np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, size)
    return sizes
