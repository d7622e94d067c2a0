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


@dataclass(frozen=True)
class ConstraintOptions:
    """Numbers of the constraints λ(θ) <= 0, in shares of their sizes.

    Attributes
    ----------
    met : float
        Above 0 up to which a constraint is met to rounding.
    active : float
        Below 0 within which a constraint is active.
    """

    met: float = 1e-9
    active: float = 1e-6


@dataclass(frozen=True)
class InnerValue:
    """The value v(θ) of the inner problem.

    Attributes
    ----------
    theta : tuple of float (n,)
    bandwidth : float
        ω_b* in rad/s, or that of the controller where something else is minimised; NaN where no
        design is certified.
    gradient : tuple of float (n,)
        dv/dθ per unit of θ.
    error : float
        Where it is minimised: RMS error in m, time of a move in s; else NaN.
    """

    theta: tuple[float, ...]
    bandwidth: float
    gradient: tuple[float, ...]
    error: float = field(default=np.nan, kw_only=True)

    @property
    def value(self) -> float:
        """v: the error where it is minimised, else the bandwidth."""
        return self.bandwidth if np.isnan(self.error) else self.error

    @property
    def feasible(self) -> bool:
        """Whether a certified design meets the constraints at θ."""
        return bool(np.isfinite(self.bandwidth))


def constraint_sizes(problem: CoDesignProblem) -> Array:
    """Find the size of each constraint: its change over the box or its values, whichever is known.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    array (m,)
        Positive, in the units of λ.
    """
    return _sizes(problem.driven, problem.names, problem.lower, problem.upper, problem.start)


def constraint_shares(problem: CoDesignProblem, theta: Array | tuple[float, ...]) -> Array:
    """Evaluate the constraints over their sizes.

    Parameters
    ----------
    problem, theta : CoDesignProblem, array (n,)
        θ in SI.

    Returns
    -------
    array (m,)
        λ(θ) over `constraint_sizes`.
    """
    return constraint_values(plant_of(problem), theta) / constraint_sizes(problem)


def violations(problem: CoDesignProblem, theta: Array | tuple[float, ...]) -> tuple[str, ...]:
    """Name the constraints that θ exceeds by more than rounding.

    Parameters
    ----------
    problem, theta : CoDesignProblem, array (n,)

    Returns
    -------
    tuple of str
        Empty where θ is allowed; an unknown (NaN) constraint is exceeded.
    """
    names, shares = plant_of(problem).constraint_names, constraint_shares(problem, theta)
    met = ConstraintOptions.met
    return tuple(name for name, share in zip(names, shares, strict=True) if not share <= met)


def binding(problem: CoDesignProblem, theta: Array | tuple[float, ...]) -> tuple[str, ...]:
    """Name the constraints that are active at θ.

    Parameters
    ----------
    problem, theta : CoDesignProblem, array (n,)

    Returns
    -------
    tuple of str
    """
    names, shares = plant_of(problem).constraint_names, constraint_shares(problem, theta)
    active = ConstraintOptions.active
    return tuple(name for name, share in zip(names, shares, strict=True) if share >= -active)


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
    """Evaluate J = w1 f(θ) + w2 v.

    Parameters
    ----------
    problem, theta, value : CoDesignProblem, array (n,), float
        θ and a value v of the inner problem, in SI.

    Returns
    -------
    float
    """
    return sum(objective_terms(problem, theta, value))


def objective_terms(
    problem: CoDesignProblem, theta: Sequence[float] | Array, value: float
) -> tuple[float, float]:
    """Evaluate the terms of J, which may cancel.

    Parameters
    ----------
    problem, theta, value : CoDesignProblem, array (n,), float

    Returns
    -------
    tuple of two floats
        w1 f(θ) and w2 v.
    """
    cost = hardware_cost(plant_of(problem), theta)
    return problem.w1 * cost, problem.w2 * float(value)


def objective_of(problem: CoDesignProblem, sample: InnerValue) -> float:
    """Evaluate J of a sample.

    Parameters
    ----------
    problem, sample : CoDesignProblem, InnerValue

    Returns
    -------
    float
        Infinite where no design is certified or λ(θ) <= 0 is not met.
    """
    if not sample.feasible or violations(problem, sample.theta):
        return np.inf
    return objective(problem, sample.theta, sample.value)


@dataclass(frozen=True)
class Hardware:
    """w1 ∇f (n,), λ (m,) in shares of its size and ∇λ (m, n) at θ, per share of the box."""

    cost_gradient: Array
    constraints: Array
    slopes: Array


def hardware_at(problem: CoDesignProblem, theta: Array) -> Hardware:
    """Find the cost and the constraints of the hardware to first order.

    Parameters
    ----------
    problem, theta : CoDesignProblem, array (n,)

    Returns
    -------
    Hardware
        Slopes per share of the box.
    """
    df, dlam = hardware_slopes(plant_of(problem), theta)
    width, sizes = box(problem).width, constraint_sizes(problem)
    shares = constraint_shares(problem, theta)
    return Hardware(problem.w1 * df * width, shares, dlam * width / sizes[:, None])


def objective_gradient(problem: CoDesignProblem, sample: InnerValue) -> Array:
    """Find the gradient of J at a sample.

    Parameters
    ----------
    problem, sample : CoDesignProblem, InnerValue

    Returns
    -------
    array (n,)
        ∇J per share of the box; of one side, where v has a kink.
    """
    own = hardware_at(problem, np.array(sample.theta)).cost_gradient
    return own + problem.w2 * np.array(sample.gradient) * box(problem).width


def final_design(
    problem: CoDesignProblem, theta: Sequence[float], point: tuple[float, float]
) -> Design:
    """Make the design that a run writes: one synthesis, certified again in SI.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float
    point : tuple of two floats
        ω_S and ω_T in rad/s.

    Returns
    -------
    Design
    """
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
