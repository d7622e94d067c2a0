"""J and λ of the outer problem on the true ω_b*(θ) of a fixed structure.

    min  w1 f(θ) + w2 ω_b*(θ)   s.t.  θ_min <= θ <= θ_max,  λ(θ) <= 0

or w1 f(θ) + w2 e*(θ), w2 > 0, where the inner problem minimises the RMS error e in m.

Every evaluation is a design that the judge confirms, with its envelope gradient, or NaN.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.inner_problem.constraints import constraint_shares, constraint_sizes, unmet
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.plants.plant import hardware_cost, hardware_slopes
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback


class TrueBandwidth(VectorCallback):
    """θ -> ω_b*(θ) in rad/s with its envelope gradient; NaN where no design is certified."""

    def __init__(self, sampler: Sampler, label: str) -> None:
        self.sampler, self.label = sampler, label
        self.known: dict[bytes, BandwidthSample] = {}
        count = len(sampler.problem.names)
        super().__init__("true_bandwidth", count, 1, self._value, self._slope)

    def at(self, theta: Array) -> BandwidthSample:
        """The sample at θ; repeated points cost nothing."""
        key = np.asarray(theta, float).tobytes()
        if key not in self.known:
            self.known[key] = self.sampler.bandwidths(theta, self.label)[0]
        return self.known[key]

    def _value(self, theta: Array) -> Array:
        sample = self.at(theta)
        stationary = np.isfinite(sample.gradient).all()
        return np.array([sample.value if stationary else np.nan])

    def _slope(self, theta: Array) -> Array:
        return np.array(self.at(theta).gradient)[None, :]


def objective(problem: CoDesignProblem, sample: BandwidthSample) -> float:
    """J in its own unit; infinite where θ is infeasible."""
    if not sample.feasible or unmet(problem, sample.theta):
        return np.inf
    cost = hardware_cost(plant_of(problem), sample.theta)
    return problem.w1 * cost + problem.w2 * sample.value


@dataclass(frozen=True)
class Hardware:
    """w1 ∇f (n,), λ (m,) in shares of its size and ∇λ (m, n) at θ, per share of the box."""

    cost_gradient: Array
    constraints: Array
    slopes: Array


def hardware_at(problem: CoDesignProblem, theta: Array) -> Hardware:
    """What θ costs and may not, to first order."""
    lower, upper = box(problem)
    width = upper - lower
    df, dlam = hardware_slopes(plant_of(problem), theta)
    sizes = constraint_sizes(problem)
    shares = constraint_shares(problem, theta)
    return Hardware(problem.w1 * df * width, shares, dlam * width / sizes[:, None])


def objective_gradient(problem: CoDesignProblem, sample: BandwidthSample) -> Array:
    """∇J (n,) per share of the box; of one side, where ω_b* has a kink."""
    lower, upper = box(problem)
    own = hardware_at(problem, np.array(sample.theta)).cost_gradient
    return own + problem.w2 * np.array(sample.gradient) * (upper - lower)
