"""The loops of a problem's design: on which plants, as they run, and what bounds them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ccd_casadi.analysis.loop_view import Bounded, LoopView, loop_view
from ccd_casadi.fixed_structure import Bounds, ShapeEnd
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.loop import Loop
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
    plants = kind_of(problem).plants(theta)
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
    inner, kind = problem.inner, kind_of(problem)
    asked = kind.bounds()
    if kind.as_designed:
        over, words = partial(_asked, asked, bandwidth_hz), OF_SECTIONS
    else:
        over, words = partial(_of_weights, weights, gamma), ("its bound γ/|W|",) * 3
    most = asked.compliance_max or inner.compliance_max
    return Bounded(asked.S_max, asked.S_low, asked.omega_low / HZ, over, words, most,
                   kind.as_designed)  # fmt: skip


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


def _asked(asked: Bounds, bandwidth_hz: float, hz: Array) -> Array:
    """The shape, and weighted_level/|W| of KS (N/m) and T."""
    none = np.full_like(hz, np.nan)
    weighted = [none, none]
    if asked.weights is not None and asked.weighted_level is not None:
        weighted = list(asked.weighted_level / np.abs(asked.weights.responses(HZ * hz)[1:]))
    if asked.shape is None:
        return np.array([none, *weighted])
    below = hz <= bandwidth_hz
    rising = asked.shape * hz / bandwidth_hz * 2.0**-0.5
    most = np.where(below, np.fmin(rising, 2.0**-0.5), rising)
    kept = (below | (asked.shape_ends is ShapeEnd.S_MAX)) & (most <= asked.S_max)
    return np.array([np.where(kept, most, np.nan), *weighted])
