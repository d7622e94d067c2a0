"""Words in a figure lie on no curve, as matplotlib itself measures them."""

from typing import Any

import numpy as np
import pytest

from ccd_casadi.drawing.charts import drawn_axes
from ccd_casadi.drawing.content import Curve, Level, Mark, Panel
from ccd_casadi.drawing.labels import LETTER, LINE
from ccd_casadi.drawing.svg import NARROW, WIDTH, style

TIME = np.linspace(0.0, 300.0, 700)


def move(seed: int) -> Panel:
    """An error of a move: peaks on both sides, at rest from its end on."""
    rng = np.random.default_rng(seed)
    peaks = np.exp(-(((TIME[:, None] - np.linspace(5.0, 200.0, 9)) / 14.0) ** 2))
    curve = Curve(TIME, peaks @ rng.uniform(-1.0, 1.0, 9), "with feedforward")
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


@pytest.mark.parametrize("names", [("alone",), ("one", "other")])
def test_a_single_curve_has_its_name_and_no_box(names: tuple[str, ...]) -> None:
    curves = tuple(Curve(TIME, np.sin(TIME / (9.0 + i)), name) for i, name in enumerate(names))
    with style():
        _, axes = drawn_axes(Panel("time (ms)", "error (nm)", curves), WIDTH, 2.4)
    made, several = axes.get_legend(), len(names) > 1
    assert [text.get_text() for text in made.get_texts()] == list(names)
    assert made.get_frame_on() == several
    assert [handle.get_visible() for handle in made.legend_handles] == [several] * len(names)


@pytest.mark.parametrize("size", [(500, 150), (253, 127), (180, 120)])
def test_words_of_the_explorer_are_inside_and_apart(size: tuple[int, int]) -> None:
    pytest.importorskip("bokeh", reason="bokeh is not installed")
    from ccd_casadi.extensions.explorer import painter

    angle = np.linspace(0.3, 6.0, 200)
    near = [Mark(-0.3 + 0.05 * i, -0.4 - 0.08 * i, f"{78.9 + 9 * i:.3g} Hz", ".") for i in range(4)]
    panel = Panel("", "", (Curve(np.cos(angle), np.sin(angle)),), marks=tuple(near))
    figure = painter.PanelFigure("nyquist", "", False, whole_circles=True, inside=size)
    data = figure._place_words(panel, [(0.0, 1.0), (0.0, 1.0)])[1]["data"]
    assert len(data["text"]) >= 2
    scale = max(2 * half / v for half, v in zip(painter.HALF, size, strict=True))
    boxes = []
    for x, y, text, dx, dy, align, baseline in zip(
        *(data[key] for key in ("x", "y", "text", "dx", "dy", "align", "baseline")), strict=True
    ):
        wide, tall = painter.PX * LETTER * len(text), painter.PX * LINE
        left = (x - painter.CENTRE) / scale + 0.5 * size[0] + dx
        left -= {"left": 0.0, "center": 0.5 * wide, "right": wide}[align]
        low = y / scale + 0.5 * size[1] - dy - {"bottom": 0.0, "top": tall}[baseline]
        boxes.append((left, low, left + wide, low + tall))
    for i, one in enumerate(boxes):
        assert 0.0 <= one[0] < one[2] <= size[0] + 1e-9
        assert 0.0 <= one[1] < one[3] <= size[1] + 1e-9
        for other in boxes[:i]:
            assert (one[2] <= other[0] or other[2] <= one[0]
                    or one[3] <= other[1] or other[3] <= one[1])  # fmt: skip
