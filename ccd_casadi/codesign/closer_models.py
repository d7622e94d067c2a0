"""The design on closer models of the same plant: a finer mesh, more modes (spill-over).

Nothing is designed anew: the controller is measured on each reference of the plant, and has to
certify there at the γ that it was certified at, or is reported as not robust to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Plant
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED, Design, DesignFigures, Outcome


@dataclass(frozen=True)
class ReferenceCheck:
    """One reference: whether the design is certified there again, why not, and its figures."""

    name: str
    outcome: Outcome
    figures: DesignFigures

    @property
    def certified(self) -> bool:
        """Certified on the reference at the design's own γ."""
        return self.outcome is Outcome.CERTIFIED


def check_references(
    problem: CoDesignProblem,
    theta: Sequence[float],
    design: Design,
    plant: Plant | None = None,
) -> tuple[ReferenceCheck, ...]:
    """The design's controller on every reference of the plant (default: the problem's) at θ."""
    found = []
    model = plant_of(problem) if plant is None else plant
    for name, evaluate in model.references.items():
        modal = modal_plant(evaluate(theta), problem.suspension)
        closer = scale_plant(modal, problem.weights.M_K)
        outcome = Outcome.CERTIFIED
        for gamma in (design.figures.certificate.norm_bound, UNBOUNDED):
            figures = measure(
                closer,
                design.controller,
                design.weights,
                gamma=gamma,
                omega_low=problem.inner.omega_low,
            )
            if gamma != UNBOUNDED:
                outcome = figures.outcome
            if figures.certified:
                break
        found.append(ReferenceCheck(name, outcome, figures))
    return tuple(found)
