"""The loops of a problem's design: on which plants, as they run, what bounds them, and their error
budget: on the model, and the largest error of the plants.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, loop_view
from ccd_casadi.budget import BudgetFigures, evaluate_budget
from ccd_casadi.budget.derivatives import variances
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.synthesis.weights import Weights


def design_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """The loops that a controller (SI) is designed for at θ: the model's first, as they run."""
    plants = kind_of(problem).plants(theta)
    return [Loop(plant.plant_si(), controller, problem.sampling) for plant in plants]


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
    """The view of a design; `weights` and γ of a mixed-sensitivity one."""
    bounded = kind_of(problem).bounded(weights or problem.weights, gamma, bandwidth_hz)
    plants = kind_of(problem).members(theta)  # whose figures the result has
    loops = [Loop(plant.plant_si(), controller, problem.sampling) for plant in plants]
    return loop_view(loops, bounded, bandwidth_hz=bandwidth_hz, label=label)


@dataclass(frozen=True)
class LoopBudget:
    """The budget on the model, and the largest RMS error (m) and force (N) on `plants` of them.

    None where the loop with the model is not stable; a plant with which it is not counts as
    infinite.
    """

    model: BudgetFigures | None
    plants: int
    largest_error: float
    largest_force: float
    sampled: bool


def loop_budget(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> LoopBudget | None:
    """None for a problem without a budget; the controller in SI, as `controller.json` has it."""
    if problem.budget is None:
        return None
    loops = design_loops(problem, theta, controller)
    model = evaluate_budget(loops[0], problem.budget)
    found = [variances(loop, problem.budget) for loop in loops]
    largest = np.max([np.full(3, np.inf) if item is None else item for item in found], axis=0)
    error, force = np.sqrt(largest[[0, 2]]).tolist()
    return LoopBudget(model, len(loops), error, force, problem.sampling is not None)
