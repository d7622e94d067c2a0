"""J and the constraints of the outer problem at true values of the inner one, and these as a
CasADi function."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np

from ccd_casadi.inner_problem.plant_source import Ends, Names, PlantSource, plant_from
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    box,
    plant_of,
    scaled_plant,
    true_design,
)
from ccd_casadi.plants.plant import constraint_values, hardware_cost, hardware_slopes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.synthesis.closed_loop import recertified_in_si
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import Design, synthesise

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


def final_design(
    problem: CoDesignProblem, theta: Sequence[float], point: tuple[float, float]
) -> Design:
    """The synthesis at (ω_S, ω_T) in rad/s that is handed out, in SI and certified again there."""
    plant, inner = scaled_plant(problem, theta), problem.inner
    made = synthesise(
        plant, problem.weights.at(*point), omega_low=inner.omega_low,
        gamma_backoff=inner.gamma_backoff, compliance=True,
    )  # fmt: skip
    return recertified_in_si(plant, made, inner.omega_low)


class TrueQuantities(VectorCallback):
    """(θ, ln ω_S, ln ω_T) -> ω_b (rad/s), ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt, with exact Jacobian.

    Before γ_opt comes ln‖GS‖∞ (m/N) where the problem has a `compliance_max`. A casadi.Callback:
    keep a reference to it as long as anything built on it is in use. A design that is not certified
    is NaN, on which IPOPT shortens its step.

    Parameters
    ----------
    problem : CoDesignProblem
        The problem.
    kept : callable, optional
        (x, compute) -> Sensitivities: a store of what was computed.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> import numpy as np
    >>> quantities = ccd.TrueQuantities(ccd.problem_of(ccd.load_case(ccd.TWO_MASS)))
    >>> x = [60.0, 60.0, *np.log([800.0 * ccd.HZ, 40.0 * ccd.HZ])]
    >>> round(float(quantities(x)[0]) / ccd.HZ, 2)
    55.56
    """

    def __init__(
        self,
        problem: CoDesignProblem,
        kept: Callable[[Array, Callable[[], Sensitivities]], Sensitivities] | None = None,
    ) -> None:
        """`kept(x, make)` gives the design at x from where designs are kept, or makes it."""
        self.problem = problem
        self.kept = kept
        self.designs: dict[bytes, Sensitivities] = {}
        count = len(problem.names) + 2
        self.size = 2 + len(problem.inner.bounds)
        super().__init__("true_quantities", count, self.size, self.values, self.jacobian_at)

    def at(self, x: Array) -> Sensitivities:
        """The design at x = (θ, ln ω_S, ln ω_T); repeated points cost nothing."""
        x = np.asarray(x, float).ravel()
        key = x.tobytes()
        if key not in self.designs:
            at = self.problem.inner.frequencies(x)
            make = partial(true_design, self.problem, tuple(x[:-2]), *at)
            self.designs[key] = make() if self.kept is None else self.kept(x, make)
        return self.designs[key]

    def values(self, x: Array) -> Array:
        """Values, NaN where the design is not certified."""
        design = self.at(x)
        return design.values if design.figures.certified else np.full(self.size, np.nan)

    def jacobian_at(self, x: Array) -> Array:
        """Derivatives of the values (…, n_θ + 2)."""
        design = self.at(x)
        return np.hstack([design.to_theta, design.to_break_frequencies])
