"""The first flexible modes of a plant as pictures to turn, whatever builder has its surface."""

import numpy as np

from ccd_casadi.drawing.page import Table, escape, figure_html, number
from ccd_casadi.drawing.pictures import ModeShape, ModeShapes
from ccd_casadi.drawing.turntable import REACH, data, legend, still

SHOWN = 6


def mode_shape_figure(shapes: ModeShapes) -> str:
    """The modes with their frequencies in Hz, as a figure's HTML.

    Without the page's script, and on paper, the pictures stand still.
    """
    views = "\n".join(
        f'<div class="view"><p>{escape(_title(mode))}</p>'
        f'<div class="drawn">{still(shapes, mode, _title(mode))}</div></div>'
        for mode in shapes.modes
    )
    scale = legend("displacement as a share of each mode's largest (–)")
    body = (
        f'<div class="turntable">\n<div class="views">\n{views}\n</div>\n{scale}\n'
        f'<script type="application/json">{data(shapes)}</script>\n</div>'
    )
    return figure_html(body, _caption(shapes), table_modes(shapes))


def _title(mode: ModeShape) -> str:
    pair = ", a pair" if len(mode.numbers) > 1 else ""
    words = f": {mode.words}" if mode.words else ""
    return f"{_places(mode)}{words}{pair}, {number(mode.frequency, 4)} Hz"


def _places(mode: ModeShape) -> str:
    return " and ".join(map(str, mode.numbers))


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
            _places(mode), mode.words, mode.frequency,
            float(np.linalg.norm(mode.displacement, axis=1).max()), *mode.more.values(),
        )
        for mode in shapes.modes
    ]  # fmt: skip
    return Table((*head, *shapes.modes[0].more), tuple(rows))
