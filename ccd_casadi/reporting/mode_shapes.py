"""The first flexible modes of a plant as pictures to turn, whatever builder has its surface."""

import numpy as np

from ccd_casadi.drawing.content import Figure, Modes, Table
from ccd_casadi.drawing.pictures import ModeShapes
from ccd_casadi.drawing.turntable import REACH
from ccd_casadi.support.units import number

SHOWN = 6


def mode_shape_figure(shapes: ModeShapes) -> Figure:
    """The modes with their frequencies in Hz, to be turned."""
    return Figure(Modes(shapes, turning=True), _caption(shapes), (table_modes(shapes),))


def _caption(shapes: ModeShapes) -> str:
    """Which modes are shown, what limits the loop first, and how to turn them."""
    first, last = shapes.modes[0], shapes.modes[-1]
    words = (
        f"The first {last.numbers[-1]} flexible modes, {number(first.frequency)} to "
        f"{number(last.frequency)} Hz"
    )
    words += f", seen from {shapes.view}" if shapes.view else ""
    named = any(mode.words != first.words for mode in shapes.modes)
    more = [f"the {first.words}"] if named else []
    if len(shapes.modes) > 1:
        factor = number(shapes.modes[1].frequency / first.frequency, 3)
        more.append(f"a factor {factor} below the next")
    words += f". The lowest is {', '.join(more)}" if more else ""
    if any(len(mode.numbers) > 1 for mode in shapes.modes):
        words += "; a pair has one frequency and two shapes, the other a quarter turn of this one"
    return words + (
        f". Displacements are exaggerated: the largest is drawn as {100 * REACH:.0f} % of the side."
        " On screen, drag a picture or use the sliders to turn all of them."
    )


def table_modes(shapes: ModeShapes) -> Table:
    """Every mode's frequency, largest displacement, and what else its plant says of it."""
    head = ("mode", "shape", "frequency (Hz)", "largest displacement (1/√kg)")
    rows = [
        (
            mode.places, mode.words, mode.frequency,
            float(np.linalg.norm(mode.displacement, axis=1).max()), *mode.more.values(),
        )
        for mode in shapes.modes
    ]  # fmt: skip
    return Table((*head, *shapes.modes[0].more), tuple(rows))
