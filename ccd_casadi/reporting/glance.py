"""What an engineer looks at first: the machine, S with what is forbidden to it, Nyquist, a move."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.drawing.content import Chapter, Figure, Lines, Modes, Picture, Place, Table
from ccd_casadi.drawing.numbers import tables_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.reporting.loops import S_panel
from ccd_casadi.reporting.machine import SHOWN_MODES, lumped_machine
from ccd_casadi.reporting.nyquist import loci_of, nyquist_panel

HEIGHT = 3.0  # inches of a row


def glance(
    problem: CoDesignProblem, theta: Sequence[float], view: LoopView, move: Figure
) -> Chapter:
    """Of a design on the plants that it is made for."""
    assert isinstance(move.drawing, Lines)
    S_max = problem.inner.S_max
    names = ("an eigenvalue of L", "the others")
    if view.scalar:
        names = ("the model", "plant 2 (and the others)")
    rows: tuple[tuple[Place, ...], ...] = (
        (machine(problem, theta), S_panel(view)),
        (
            nyquist_panel(view.hz, loci(view), problem.inner.S_max, HEIGHT, names),
            move.drawing.rows[-2][0],
        ),
    )
    peak = float(view.sizes[0].max())
    table = isinstance(rows[0][0], Table)
    words = paragraph("report.glance", view, peak, S_max, move.caption, table)
    lines = Lines(rows, "At a glance", (HEIGHT, HEIGHT))
    return Chapter("At a glance", (Figure(lines, words, (*tables_of(lines), move.tables[0])),))


def loci(view: LoopView) -> list[np.ndarray]:
    """L of one channel on every plant, of several its eigenvalues on the model."""
    return [line for L in view.open for line in loci_of(L).T]


def machine(problem: CoDesignProblem, theta: Sequence[float]) -> Modes | Picture | Table:
    """Masses and springs with their modes, the first modes of a surface, or a table of modes."""
    plant = plant_of(problem)
    if plant.shapes is not None:
        return Modes(plant.shapes(theta, SHOWN_MODES))
    system = mechanics(plant, theta)
    return lumped_machine(system, modal_plant(system, problem.suspension.free))
