"""A design's move: exact times on its set of plants, on a lattice of its box, on fresh plants.

What a design is told to need is the largest of v, the smooth time that its search made small, and
of the exact times on the set and on the lattice; plants that no search has seen are held against
that.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.analysis.driven_plant import DrivenMechanics
from ccd_casadi.analysis.motor import MotionAt
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.fixed_structure.worst_plant import lattice
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_plant_set import plants_of, structured_of, uncertain_plant
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

CHECKED, FRESH = 100, 500  # plants of the lattice, and drawn afresh
FRESH_SEED = 3000  # apart from those of other draws
PER_MOVE = 10.0  # a continuous loop is stepped 50 times in this share of the setpoint


def motion_of(problem: CoDesignProblem, theta: Sequence[float]) -> MotionAt:
    """The move at θ, of a problem that has one."""
    own = plant_of(problem).evaluate
    assert isinstance(own, DrivenMechanics)
    return own.at(tuple(map(float, theta)), problem.sampling)


def require_motion(problem: CoDesignProblem) -> None:
    """Raise UserError where the plant does not make its move."""
    plant = plant_of(problem)
    if plant.inputs != plant.outputs:
        words = f"has {plant.inputs} inputs and {plant.outputs} outputs; [move] needs as many"
        raise PlantError(f"{words} of one as of the other")
    motion_of(problem, problem.start)


def exact_times(
    problem: CoDesignProblem, motion: MotionAt, plants: Sequence[ScaledPlant], K: StateSpace
) -> Array:
    """From the start of the move until the error stays within the window, s; its end at least."""
    profile = motion.cycle.profile
    found = [
        simulate(
            Loop(plant.plant_si(), K, problem.sampling), profile, axis=0,
            forces=motion.forward, window=motion.motion.window,
            bandwidth_hz=PER_MOVE / profile.duration,
        ).settled
        for plant in plants
    ]  # fmt: skip
    return np.maximum(found, profile.duration)


def latest_plant(
    problem: CoDesignProblem, theta: Sequence[float], K: StateSpace, seed: int
) -> tuple[float, int, Array]:
    """The exact time on the latest plant of a lattice of the box, its option and its point."""
    uncertain = uncertain_plant(problem, theta)
    points = lattice(uncertain, CHECKED, seed)
    times = exact_times(problem, motion_of(problem, theta), uncertain.plants(points), K)
    return float(times.max()), *points[int(times.argmax())]


def stated_time(
    problem: CoDesignProblem, theta: Sequence[float], K: StateSpace, value: float
) -> tuple[float, Yield | None]:
    """The time that a design is told to need (s), whose smooth time on the set is `value`, and how
    many fresh plants need no longer."""
    seed = structured_of(problem).seed
    uncertain, motion = uncertain_plant(problem, theta), motion_of(problem, theta)
    on_set = exact_times(problem, motion, plants_of(problem, theta), K)
    told = max(value, float(on_set.max()), latest_plant(problem, theta, K, seed + FRESH_SEED)[0])
    if not uncertain.names:
        return told, None
    fresh = uncertain.drawn(np.random.default_rng((seed, FRESH_SEED)), FRESH)
    times = exact_times(problem, motion, uncertain.plants(fresh), K)
    return told, Yield(int((times <= told).sum()), FRESH)
