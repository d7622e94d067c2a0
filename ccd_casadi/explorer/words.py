"""What the explorer says of a design, as text and as HTML, and its machine."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.drawing.content import Lines, Modes
from ccd_casadi.drawing.paint import block_html, escape
from ccd_casadi.explorer.curves import AsSampled, Curves
from ccd_casadi.explorer.designs import Look
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.machine import SHOWN_MODES, lumped_machine
from ccd_casadi.support.package_text import template
from ccd_casadi.support.units import HZ, number, with_unit


def standing_html(
    look: Look, curves: Curves | None, sampled: AsSampled | None,
    beside: tuple[str, float] | None = None,
) -> str:  # fmt: skip
    """The verdict, ω_b and the figures, what it survives, how it was chosen and on which plant.

    `beside`: another design's name and its ω_b in Hz, which the bandwidth is compared with.
    """
    known = beside is not None and np.isfinite(beside[1])
    return template("explorer/assets/standing.html", number=number, HZ=HZ).render(
        look=look, beside=beside if known else None, curves=curves, sampled=sampled,
    )  # fmt: skip


def move_words(curves: Curves | None) -> str:
    """What the figure of the move shows."""
    if curves is None or curves.unstable:
        return ""
    return f"the default one of robustness, {curves.move.words}"


def machine_html(look: Look, start: Sequence[float], reference: float) -> str:
    """Its drawing beside that of the start, masses and springs, or its modes."""
    plant = plant_of(look.problem)
    if plant.drawing is not None:
        drawn = plant.drawing({"this design": look.theta, "the start": start}).drawing
        if isinstance(drawn, Lines):  # the first row alone: it is drawn while one drags
            drawn = replace(drawn, rows=drawn.rows[:1], heights=drawn.heights[:1])
        return f'<div class="drawn">{block_html(drawn, "machine")}</div>'
    return block_html(lumped_machine(look.elements.system, look.modal, reference), "machine")


def surface_modes_html(problem: CoDesignProblem, theta: Sequence[float]) -> str:
    """The first flexible modes on the plant's surface; empty for a plant that has none."""
    plant = plant_of(problem)
    if plant.shapes is None:
        return ""
    pairs = zip(problem.names, problem.units, theta, strict=True)
    shown = ", ".join(f"{name} = {with_unit(value, unit, 4)}" for name, unit, value in pairs)
    modes = block_html(Modes(plant.shapes(theta, SHOWN_MODES)))
    return f"<p>modes of the last θ solved: {escape(shown)}</p>{modes}"
