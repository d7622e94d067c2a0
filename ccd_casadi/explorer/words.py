"""What the explorer says of a design, as text and as HTML, and its machine."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.drawing.content import Lines, Modes
from ccd_casadi.drawing.page import escape
from ccd_casadi.drawing.paint import block_html
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
        look=look, beside=beside if known else None,
        survival="" if curves is None else survival_words(curves),
        sampled="" if sampled is None else sampled_words(sampled, look.problem.inner.S_max),
    )  # fmt: skip


def survival_words(curves: Curves) -> str:
    """The margins of the loop that is drawn, and whether its controller is stable by itself."""
    m, unstable = curves.view.margins, curves.poles[1]
    unstable = unstable[(unstable.real > 1e-9 * np.abs(unstable)) & (unstable.imag >= 0.0)]
    gain = f"gain × {number(m.gain_down, 3)} to {number(m.gain_up, 3)}"
    margins = "the loop drawn is unstable: no margins" if curves.unstable else (
        f"the loop drawn is stable for {gain}; phase margin {number(m.phase_deg, 3)}°, delay "
        f"margin {number(1e6 * m.delay, 3)} µs"
    )  # fmt: skip
    if not unstable.size:
        return f"{margins}; K by itself is stable"
    at = ", ".join(number(float(hz), 4) for hz in np.sort(np.abs(unstable))[:3])
    return f"{margins}; K by itself is UNSTABLE (poles at {at} Hz)"


def move_words(curves: Curves | None) -> str:
    """What the figure of the move shows."""
    if curves is None or curves.unstable:
        return ""
    return f"the default one of robustness, {curves.move.words}"


def sampled_words(sampled: AsSampled, S_max: float) -> str:
    """What hold and delay make of the loop; they are no part of an H∞ synthesis."""
    if not sampled.stable:
        return "Run at this rate and delay the loop is NOT stable (hold and delay exact)."
    over = 100.0 * (sampled.peak / S_max - 1.0)
    return (
        "Run at this rate and delay (exact, dash-dotted, not designed for it): ω_b = "
        f"{number(sampled.bandwidth_hz, 4)} Hz, ‖S‖∞ = {number(sampled.peak, 4)}, {over:+.2g} % of "
        "S_max."
    )


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
