"""J of the outer problem and its constraints, and their slopes, at true values of the inner one.

    J(θ) = w1 f(θ) + w2 v(θ),   v = ω_b* in rad/s or the least RMS error in m,   λ(θ) <= 0

λ counts in shares of each constraint's own size: a user may write one in Pa or in m. Its size is
by how much it changes over the box, to first order from the start, or its value there where that is
more: no unit decides what is rounding. θ is in the user's units, slopes are per share of the box,
in which every variable goes from 0 to 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ccd_casadi.inner_problem.plant_source import Ends, Names, PlantSource, plant_from
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.plants.plant import constraint_values, hardware_cost, hardware_slopes
from ccd_casadi.support.arrays import Array

MET = 1e-9  # of its size: so far past 0 a constraint is met to rounding
ACTIVE = 1e-6  # of its size: so near to 0 a design runs along it


@dataclass(frozen=True)
class InnerValue:
    """v(θ) and its gradient (n,) per unit of θ: ω_b* in rad/s, NaN where no design is certified.

    Where the inner problem minimises something else `error` is that in SI (RMS error in m, time of
    a move in s) and what the gradient is of; `bandwidth` is that of its controller.
    """

    theta: tuple[float, ...]
    bandwidth: float
    gradient: tuple[float, ...]
    error: float = field(default=np.nan, kw_only=True)

    @property
    def value(self) -> float:
        """What J counts."""
        return self.bandwidth if np.isnan(self.error) else self.error

    @property
    def feasible(self) -> bool:
        """Whether a certified design meets the constraints at θ."""
        return bool(np.isfinite(self.bandwidth))


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
def _sizes(source: PlantSource, names: Names, lower: Ends, upper: Ends, start: Ends) -> Array:
    plant = plant_from(source, names, lower, upper)
    if not plant.constraint_names:
        return np.ones(0)
    change = np.abs(hardware_slopes(plant, start)[1]) @ np.subtract(upper, lower)
    values = [np.abs(constraint_values(plant, theta)) for theta in (start, lower, upper)]
    sizes = np.fmax(change, values[0])  # NaN where one is unknown
    for size in (*values[1:], np.ones_like(sizes)):
        sizes = np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, size)
    return sizes


def objective(problem: CoDesignProblem, theta: Sequence[float] | Array, value: float) -> float:
    """J at θ with a value v of the inner problem."""
    return sum(objective_terms(problem, theta, value))


def objective_terms(
    problem: CoDesignProblem, theta: Sequence[float] | Array, value: float
) -> tuple[float, float]:
    """w1 f(θ) and w2 v, which may cancel."""
    cost = hardware_cost(plant_of(problem), theta)
    return problem.w1 * cost, problem.w2 * float(value)


def objective_of(problem: CoDesignProblem, sample: InnerValue) -> float:
    """J of a sample; infinite where no design is certified or λ(θ) <= 0 is not met."""
    if not sample.feasible or violated(problem, sample.theta):
        return np.inf
    return objective(problem, sample.theta, sample.value)


@dataclass(frozen=True)
class Hardware:
    """w1 ∇f (n,), λ (m,) in shares of its size and ∇λ (m, n) at θ, per share of the box."""

    cost_gradient: Array
    constraints: Array
    slopes: Array


def hardware_at(problem: CoDesignProblem, theta: Array) -> Hardware:
    """What θ costs and may not, to first order."""
    df, dlam = hardware_slopes(plant_of(problem), theta)
    width, sizes = box(problem).width, constraint_sizes(problem)
    shares = constraint_shares(problem, theta)
    return Hardware(problem.w1 * df * width, shares, dlam * width / sizes[:, None])


def objective_gradient(problem: CoDesignProblem, sample: InnerValue) -> Array:
    """∇J (n,) per share of the box; of one side, where v has a kink."""
    own = hardware_at(problem, np.array(sample.theta)).cost_gradient
    return own + problem.w2 * np.array(sample.gradient) * box(problem).width
