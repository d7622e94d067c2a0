"""The move of a problem: at a θ, on every plant of its set, and on plants drawn from its box."""

from collections.abc import Sequence

from ccd_casadi.analysis.driven_plant import Moved
from ccd_casadi.analysis.motor import MotionAt
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.support.errors import PlantError

FREE = Suspension(0.0, 0.0)


def motion_of(problem: CoDesignProblem, theta: Sequence[float]) -> MotionAt:
    """The move at θ, of a problem that has one."""
    own = plant_of(problem).evaluate
    assert isinstance(own, Moved)
    return own.at(tuple(map(float, theta)), problem.sampling)


def require_motion(problem: CoDesignProblem) -> None:
    """Raise UserError where the plant does not make the problem's move."""
    plant, motion = plant_of(problem), problem.source.motion
    assert motion is not None
    if plant.inputs != plant.outputs:
        words = f"has {plant.inputs} inputs and {plant.outputs} outputs; [move] needs as many"
        raise PlantError(f"{words} of one as of the other")
    if motion.demand.axis >= plant.outputs:
        raise PlantError(f"has no output {motion.demand.axis + 1}, which move.axis names")
    motion_of(problem, problem.start)
