"""Words in a figure lie on no curve, as matplotlib itself measures them."""

from typing import Any

import numpy as np
import pytest

from ccd_casadi.drawing.content import Curve, Level, Panel
from ccd_casadi.drawing.lines import drawn_axes
from ccd_casadi.drawing.svg import NARROW, WIDTH, style

TIME = np.linspace(0.0, 300.0, 700)


def move(seed: int) -> Panel:
    """An error of a move: peaks on both sides, at rest from its end on."""
    rng = np.random.default_rng(seed)
    peaks = np.exp(-(((TIME[:, None] - np.linspace(5.0, 200.0, 9)) / 14.0) ** 2))
    curve = Curve(TIME, peaks @ rng.uniform(-1.0, 1.0, 9), "with mass feedforward")
    end = Level(rng.uniform(150.0, 220.0), "setpoint ends", vertical=True)
    return Panel("time (ms)", "error (nm)", (curve,), levels=(end,))


def inside(box: Any, points: np.ndarray) -> int:
    x, y = points.T
    return int(((box.x0 < x) & (x < box.x1) & (box.y0 < y) & (y < box.y1)).sum())


@pytest.mark.parametrize("width", [WIDTH, 0.5 * WIDTH, NARROW])
@pytest.mark.parametrize("seed", range(8))
def test_legend_and_words_lie_on_no_curve(seed: int, width: float) -> None:
    panel = move(seed)
    with style():
        figure, axes = drawn_axes(panel, width, 2.4)
        figure.draw_without_rendering()
        curve = axes.transData.transform(np.column_stack([panel.curves[0].x, panel.curves[0].y]))
        assert inside(axes.get_legend().get_window_extent(), curve) == 0
        assert [text.get_text() for text in axes.texts] == ["setpoint ends"]
        assert inside(axes.texts[0].get_window_extent(), curve) == 0
