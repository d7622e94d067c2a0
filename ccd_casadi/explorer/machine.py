"""The machine at the sliders' place, as HTML."""

from collections.abc import Sequence

from ccd_casadi.drawing.content import Modes
from ccd_casadi.drawing.paint import block_html
from ccd_casadi.drawing.turntable import modes_html
from ccd_casadi.explorer.designs import Look
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.machine import SHOWN_MODES, lumped_machine


def machine_html(look: Look, start: Sequence[float], reference: float) -> str:
    """Its drawing beside that of the start, masses and springs, or its modes."""
    plant = plant_of(look.problem)
    if plant.drawing is not None:
        drawn = plant.drawing({"this design": look.theta, "the start": start})
        return f'<div style="background:#fff;color:#1a1a1a">{drawn.svg}</div>'
    return block_html(lumped_machine(look.elements.system, look.modal, reference), "machine")


def surface_modes_html(problem: CoDesignProblem, theta: Sequence[float]) -> str:
    """The first flexible modes on the plant's surface; empty for a plant that has none."""
    plant = plant_of(problem)
    return "" if plant.shapes is None else modes_html(Modes(plant.shapes(theta, SHOWN_MODES)))
