"""The final judgement of a design: its loop on the plants as their function returned them.

M, D, K, B and C at θ and at each plant of the set, free bodies free, in the person's own
coordinates (`plants.as_written`), the loop rebuilt from controller and plant
(`fixed_structure.certificate`). No modes, suspension, reduction or scaling of a search takes part.
"""

from collections.abc import Sequence

from ccd_casadi.fixed_structure import certify
from ccd_casadi.fixed_structure.judgement import Judgement, judgement_of
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import NOMINAL
from ccd_casadi.plants.plant import mechanics


def written_plants(
    problem: CoDesignProblem, theta: Sequence[float], shifts: int | None = None
) -> list[StateSpace]:
    """The model at θ and the plants of a mixed-sensitivity design's set, as they were written;
    with so many `shifts` of its resonances."""
    system, robust = mechanics(plant_of(problem), theta, derivatives=False), problem.robust
    places = () if robust is None else robust.perturbations(shifts)
    others = [off for off in places if off != NOMINAL]
    count = problem.suspension.rigid_modes
    return [
        as_written(system, shift=off.shift, damping=off.damping, rigid_modes=count)
        for off in (NOMINAL, *others)
    ]


def judge_on_model(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> Judgement:
    """A mixed-sensitivity design (e in, u out, SI) on the model at θ: S_max, S_low, stability.

    Its set is of the check that `robust` is.
    """
    model = written_plants(problem, theta)[:1]
    return judgement_of(certify(model, controller, kind_of(problem).bounds()), 1)
