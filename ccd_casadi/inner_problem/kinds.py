"""The kinds of inner problem, what each knows of a problem at a θ, and the loops of its design."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop_view import Bounded, LoopView, loop_view
from ccd_casadi.inner_problem.controller_problem import ControllerProblem, MixedSensitivityProblem
from ccd_casadi.inner_problem.inner_kind import InnerKind
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    plant_of,
    scaled_plant,
    true_inner,
    with_ports,
)
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import ForcedPlant
from ccd_casadi.optim.kkt import non_negative
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.weights import Weights

if TYPE_CHECKING:
    from ccd_casadi.budget.evaluation import BudgetFigures

ENDS = {  # of the ranges, as slopes to (ln ω_S, ln ω_T)
    "omega_S lower": (-1.0, 0.0), "omega_S upper": (1.0, 0.0),
    "omega_T lower": (0.0, -1.0), "omega_T upper": (0.0, 1.0),
}  # fmt: skip


class MixedSensitivity(InnerKind):
    """H∞ controllers by the weights W_S, W_KS and W_T, over their frequencies ω_S and ω_T.

    Attributes
    ----------
    problem : CoDesignProblem
        Others as those of `InnerKind`.
    """

    title = "H-infinity controller"
    slack = 1e-6
    as_designed = False

    def value(self, theta: Sequence[float]) -> tuple[float, Array]:
        found = true_inner(self.problem, theta)
        if found.optimum is None:
            return np.nan, np.full(len(theta), np.nan)
        bounded = tuple(self.problem.inner.bounds)
        return found.bandwidth, bandwidth_gradient(found.optimum, found.active, bounded)

    def describe(self) -> tuple[str, str]:
        inner = self.problem.inner
        ranges = (("ω_S", inner.omega_S), ("ω_T", inner.omega_T))
        words = (f"{name} {a / HZ:.5g} to {b / HZ:.5g} Hz" for name, (a, b) in ranges)
        return "mixed sensitivity", ", ".join(words)

    def require_function(self) -> None:
        """Accept every problem: the value is a function of θ."""

    def members(self, theta: Sequence[float]) -> list[ScaledPlant]:
        return list(scaled_plant(self.problem, theta).members)

    def common_shifts(self) -> tuple[float, float]:
        shift = 0.0 if self.problem.robust is None else self.problem.robust.shift
        return -shift, shift

    def other_factors(self) -> tuple[Sequence[float], Sequence[float]]:
        robust = self.problem.robust
        return (1.0,) if robust is None else robust.damping, (1.0,)

    def gain_bounds(self, weights: Weights, gamma: float, bandwidth_hz: float) -> Bounded:
        """S, KS and T stay below γ/|W|."""

        def over(hz: Array) -> Array:
            return np.asarray(gamma / np.abs(weights.responses(HZ * hz)))

        inner = self.problem.inner
        words = ("its bound γ/|W|",) * 3
        return Bounded(inner.S_max, inner.S_low, inner.omega_low / HZ, over, words,
                       inner.compliance_max, False)  # fmt: skip


def kind_of(problem: CoDesignProblem) -> InnerKind:
    """Find the kind of inner problem of a co-design problem.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    InnerKind
        Of `KINDS`, by the class of `problem.controller`.
    """
    return KINDS[type(problem.controller)](problem)


def _fixed_structure(problem: CoDesignProblem) -> InnerKind:
    """Make the kind of a fixed structure; its search is imported where a problem has such a
    controller."""
    from ccd_casadi.inner_problem.structured_kind import FixedStructure

    return FixedStructure(problem)


# One entry for each class of `CoDesignProblem.controller`; another kind adds its own.
KINDS: dict[type[ControllerProblem], Callable[[CoDesignProblem], InnerKind]] = {
    MixedSensitivityProblem: MixedSensitivity,
    StructuredProblem: _fixed_structure,
}


def bandwidth_gradient(
    optimum: Sensitivities,
    active: tuple[str, ...],
    bounded: tuple[str, ...],
    *,
    most_residual: float = 1e-3,
) -> Array:
    """Find the gradient of ω_b*(θ) by the envelope theorem.

        dω_b*/dθ = ∂ω_b/∂θ - Σ μ_j ∂g_j/∂θ,   ∂ω_b/∂x = Σ μ_j ∂g_j/∂x,   x = (ln ω_S, ln ω_T)

    Parameters
    ----------
    optimum : Sensitivities
        At the optimum.
    active, bounded : tuple of str
        What binds there; the names of the rows 1 to -2 of the optimum's values, as
        `InnerBounds.bounds` has them.
    most_residual : float
        Relative: above it the point is not stationary.

    Returns
    -------
    array (n_θ,)
        rad/s per unit of θ, where the plant has slopes (else n_θ is 0); NaN where the optimality
        conditions do not hold.
    """
    x, theta, none = optimum.to_break_frequencies, optimum.to_theta, np.zeros_like(optimum.to_theta)
    rows = {name: (x[i], theta[i]) for i, name in enumerate(bounded, 1)}
    rows |= {name: (np.array(end), none[0]) for name, end in ENDS.items()}
    mu, residual = non_negative(np.reshape([rows[name][0] for name in active], (-1, 2)), x[0])
    if residual > most_residual:
        return np.full_like(none[0], np.nan)
    slopes = np.reshape([rows[name][1] for name in active], (len(mu), none.shape[1]))
    return np.asarray(theta[0] - mu @ slopes)


def loop_on(problem: CoDesignProblem, plant: StateSpace, controller: StateSpace) -> Loop:
    """Close the loop of a controller on a plant as it runs.

    Parameters
    ----------
    problem, plant, controller : CoDesignProblem, StateSpace, StateSpace
        SI; of several sensors on one actuator the loop of the one whose error counts. A plant of
        `with_ports` gives the loop its ports.

    Returns
    -------
    Loop
    """
    found = Loop(plant, controller, problem.sampling, kind_of(problem).bounds().places)
    p, m = controller.B.shape[1], len(controller.C)
    if plant.D.shape == (p, m):
        body = plant.mechanics if isinstance(plant, ForcedPlant) else plant
        beside = body.A.shape != plant.A.shape or np.array_equal(body.B, plant.B)
        return found if beside else replace(found, drive=body.B)
    own, counted, force = plant.C[:p], plant.C[p:], None
    if problem.source.wiring.actuator:
        counted, force = counted[:-m], counted[-m:]
    of_ports = plant_of(problem).ports
    if found.at and len(counted) and "performance" not in of_ports:
        counted = np.array([found.at[0].output]) @ counted  # positions that no sensor filters
    names = ("performance" if "performance" in of_ports else Loop.names[0],
             "disturbance" if "disturbance" in of_ports else Loop.names[1])  # fmt: skip
    return replace(
        found, plant=strictly_proper(plant.A, plant.B[:, :m], own), force=force,
        drive=plant.B[:, m:] if plant.B.shape[1] > m else None,
        counted=counted if len(counted) else None,
        names=names,
    )  # fmt: skip


def design_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """Make the loops that a controller is designed for.

    Parameters
    ----------
    problem, theta, controller : CoDesignProblem, sequence of float, StateSpace
        θ and K(s), e to force, in SI.

    Returns
    -------
    list of Loop
        As they run, the model's first.
    """
    plants = kind_of(with_ports(problem)).plants(theta)
    return [loop_on(problem, plant.plant_si(), controller) for plant in plants]


def member_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """Make the loops whose margins and steps are shown: as `design_loops`, with a robust set.

    Parameters
    ----------
    problem, theta, controller : CoDesignProblem, sequence of float, StateSpace

    Returns
    -------
    list of Loop
    """
    plants = kind_of(with_ports(problem)).members(theta)
    return [loop_on(problem, plant.plant_si(), controller) for plant in plants]


def design_view(
    problem: CoDesignProblem,
    theta: Sequence[float],
    controller: StateSpace,
    *,
    bandwidth_hz: float,
    weights: Weights | None = None,
    gamma: float = np.nan,
    label: str = "",
) -> LoopView:
    """Make the view of a design's loops for a page.

    Parameters
    ----------
    problem, theta, controller : CoDesignProblem, sequence of float, StateSpace
        θ and K(s) in SI.
    bandwidth_hz, label : float, str
        ω_b in Hz; the title.
    weights, gamma : Weights, float
        Of a mixed-sensitivity design.

    Returns
    -------
    LoopView
    """
    bounded = kind_of(problem).gain_bounds(weights or problem.weights, gamma, bandwidth_hz)
    loops = member_loops(problem, theta, controller)  # whose figures the result has
    return loop_view(loops, bounded, bandwidth_hz=bandwidth_hz, label=label)


@dataclass(frozen=True)
class LoopBudget:
    """The error budget of a controller.

    Attributes
    ----------
    model : BudgetFigures or None
        On the model; None where that loop is not stable.
    plants : int
    largest_error, largest_force : float
        RMS, m and N, on any of the plants; infinite where a loop is not stable.
    sampled : bool
    """

    model: "BudgetFigures | None"
    plants: int
    largest_error: float
    largest_force: float
    sampled: bool


def loop_budget(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> LoopBudget | None:
    """Evaluate the error budget of a controller.

    Parameters
    ----------
    problem, theta, controller : CoDesignProblem, sequence of float, StateSpace
        θ and K(s) in SI, as `controller.json` has it.

    Returns
    -------
    LoopBudget or None
        None for a problem without a budget.
    """
    if problem.budget is None:
        return None
    from ccd_casadi.budget.evaluation import evaluate_budget, variances

    loops = design_loops(problem, theta, controller)
    model = evaluate_budget(loops[0], problem.budget)
    if model is not None and model.by_integral:
        each = (evaluate_budget(loop, problem.budget) for loop in loops)
        found = [None if one is None else np.square([one.error, one.average, one.force])
                 for one in each]  # fmt: skip
    else:
        found = [variances(loop, problem.budget) for loop in loops]
    largest = np.max([np.full(3, np.inf) if item is None else item for item in found], axis=0)
    error, force = np.sqrt(largest[[0, 2]]).tolist()
    return LoopBudget(model, len(loops), error, force, problem.sampling is not None)
