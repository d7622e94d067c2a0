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
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.support.progress import Progress
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
    workers: Pool | None = None,
    quiet: bool = True,
) -> tuple[ReferenceCheck, ...]:
    """The design's controller on every reference of the plant (default: the problem's) at θ.

    `workers` share the references of the problem's own plant.
    """
    if plant is not None:
        return tuple(_checked(problem, theta, design, plant, name) for name in plant.references)
    names = tuple(plant_of(problem).references)
    tasks = [(problem, tuple(theta), design, name) for name in names]
    found = {}
    with Progress(len(tasks), "closer models", quiet=quiet) as progress:
        for check in (workers or Workers(1)).map_unordered(_unit, tasks):
            found[check.name] = check
            progress.advance()
    return tuple(found[name] for name in names)


def _unit(task: tuple[CoDesignProblem, tuple[float, ...], Design, str]) -> ReferenceCheck:
    problem, theta, design, name = task
    return _checked(problem, theta, design, plant_of(problem), name)


def _checked(
    problem: CoDesignProblem, theta: Sequence[float], design: Design, plant: Plant, name: str
) -> ReferenceCheck:
    modal = modal_plant(plant.references[name](theta), problem.suspension)
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
    return ReferenceCheck(name, outcome, figures)
