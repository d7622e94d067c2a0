"""The loops of a problem's design: on which plants, as they run, and what bounds them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ccd_casadi.analysis.loop import Loop
from ccd_casadi.analysis.loop_view import Bounded, LoopView, loop_view
from ccd_casadi.fixed_structure import ShapeEnd
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.sections_plant_set import plants_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.weights import Weights

OF_SECTIONS = ("its shape", "weighted_level/|W_KS|", "weighted_level/|W_T|")


def design_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """The loops that a controller (SI) is designed for at θ: the model's first, as they run."""
    plants = [scaled_plant(problem, theta)]
    if problem.sections is not None:
        plants = plants_of(problem, theta)
    return [Loop(plant.plant_si(), controller, problem.sampling) for plant in plants]


def free_loops(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Loop]:
    """The same without the suspension of rigid bodies."""
    return design_loops(replace(problem, suspension=Suspension(0.0, 0.0)), theta, controller)


def bounds_of_loop(
    problem: CoDesignProblem, weights: Weights, gamma: float, bandwidth_hz: float
) -> Bounded:
    """What S, KS and T may not exceed: γ/|W|, or what is asked of a fixed structure."""
    inner = problem.inner
    if problem.sections is None:
        over, words = partial(_of_weights, weights, gamma), ("its bound γ/|W|",) * 3
        most = inner.compliance_max
    else:
        over, words = partial(_of_sections, problem, bandwidth_hz), OF_SECTIONS
        most = problem.sections.compliance_max
    return Bounded(inner.S_max, inner.S_low, inner.omega_low / HZ, over, words, most,
                   problem.sections is not None)  # fmt: skip


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
    bounded = bounds_of_loop(problem, weights or problem.weights, gamma, bandwidth_hz)
    loops = design_loops(problem, theta, controller)
    return loop_view(loops, bounded, bandwidth_hz=bandwidth_hz, label=label)


def _of_weights(weights: Weights, gamma: float, hz: Array) -> Array:
    return np.asarray(gamma / np.abs(weights.responses(HZ * hz)))


def _of_sections(problem: CoDesignProblem, bandwidth_hz: float, hz: Array) -> Array:
    """The shape, and weighted_level/|W| of KS (N/m) and T."""
    sections = problem.sections
    assert sections is not None
    size = np.abs(problem.weights.responses(HZ * hz))
    level = np.nan if sections.weighted_level is None else sections.weighted_level
    shape = np.nan if sections.shape is None else sections.shape
    below = hz <= bandwidth_hz
    rising = shape * hz / bandwidth_hz * 2.0**-0.5
    most = np.where(below, np.fmin(rising, 2.0**-0.5), rising)
    bounded = (below | (sections.shape_ends is ShapeEnd.S_MAX)) & (most <= problem.inner.S_max)
    return np.array([np.where(bounded, most, np.nan), *(level / size[1:])])
