"""The error budget of a problem's loop at θ: on the model, and the largest error of its plants."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.budget import BudgetFigures, evaluate_budget
from ccd_casadi.budget.derivatives import variance_slopes
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace


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
    hold: Sampling | None


def loop_budget(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> LoopBudget | None:
    """None for a problem without a budget; the controller in SI, as `controller.json` has it."""
    if problem.budget is None:
        return None
    plants, hold = kind_of(problem).plants(theta), problem.sampling
    model = evaluate_budget(plants[0].plant_si(), controller, problem.budget, hold)
    found = [
        variance_slopes(Loop(plant.plant_si(), controller, hold), problem.budget, ())
        for plant in plants
    ]
    largest = np.max([np.full(3, np.inf) if item is None else item.value for item in found], axis=0)
    return LoopBudget(
        model, len(plants), float(np.sqrt(largest[0])), float(np.sqrt(largest[2])), hold
    )
