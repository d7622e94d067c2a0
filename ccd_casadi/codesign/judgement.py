"""The final judgement of a design: its loop on the plants as their function returned them.

M, D, K, B and C at θ and at each plant of the set, free bodies free, in the person's own
coordinates (`plants.as_written`), the loop rebuilt from controller and plant
(`fixed_structure.certificate`). No modes, suspension, reduction or scaling of a search takes part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ccd_casadi.fixed_structure import SetCertificate, certify
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import NOMINAL
from ccd_casadi.plants.plant import mechanics

ENGINE = "NumPy, on the matrices as the plant function returned them, free bodies free"


@dataclass(frozen=True)
class Judgement:
    """What was found on so many `plants`: the largest figures over their bounds, by name."""

    plants: int
    figures: Mapping[str, float]
    passed: bool
    words: str

    @property
    def entry(self) -> dict[str, Any]:
        """Of result.json."""
        return {"engine": ENGINE, **vars(self)}


def judgement_of(certificate: SetCertificate, plants: int) -> Judgement:
    """Of a certificate on plants as they were written."""
    return Judgement(plants, certificate.worst, certificate.passed, certificate.words)


def written_plants(problem: CoDesignProblem, theta: Sequence[float]) -> list[StateSpace]:
    """The model at θ and the plants of a mixed-sensitivity design's set, as they were written."""
    system, robust = mechanics(plant_of(problem), theta, derivatives=False), problem.robust
    others = [] if robust is None else [off for off in robust.perturbations() if off != NOMINAL]
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
