"""The loops of a problem's design: on which plants, as they run, and what bounds them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, loop_view
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.synthesis.weights import Weights


def design_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """The loops that a controller (SI) is designed for at θ: the model's first, as they run."""
    plants = kind_of(problem).plants(theta)
    return [Loop(plant.plant_si(), controller, problem.sampling) for plant in plants]


def free_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """The same without the suspension of rigid bodies."""
    return design_loops(replace(problem, suspension=Suspension(0.0, 0.0)), theta, controller)


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
    loops = design_loops(problem, theta, controller)
    return loop_view(loops, bounded, bandwidth_hz=bandwidth_hz, label=label)
