"""The landscape of ω_b* on the page, with the present design in it."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    LinearColorMapper,
    NumeralTickFormatter,
    Range1d,
)
from bokeh.models.widgets.inputs import Select
from bokeh.models.widgets.markups import Div
from bokeh.plotting import figure

from ccd_casadi.cases.tables import Parameter
from ccd_casadi.drawing.content import Landscape
from ccd_casadi.drawing.maps import GROUND, RING
from ccd_casadi.drawing.paint import escape
from ccd_casadi.drawing.svg import ORANGE
from ccd_casadi.explorer.controls import DARK
from ccd_casadi.explorer.message import Change
from ccd_casadi.explorer.painter import FEW
from ccd_casadi.support.units import display_unit

HEIGHT = 280
MARGIN = 0.03  # of the box


class MapFigure:
    """Two choices of a parameter, the map over them, what it shows; `asked` when one is chosen."""

    def __init__(
        self, parameters: Sequence[Parameter], asked: Callable[[], None], dark: bool
    ) -> None:
        self.names: list[Any] = [parameter.name for parameter in parameters]
        self._units = [display_unit(item.unit, item.upper) for item in parameters]
        self._selects = [
            Select(name=f"axis_{i}", title=title, options=self.names, width=105,
                   stylesheets=[DARK] if dark else [],
                   value=self.names[min(i, len(self.names) - 1)])
            for i, title in enumerate(("across", "up"))
        ]  # fmt: skip
        for select in self._selects:
            select.on_change("value", lambda attr, old, new: asked())
        self._colours = LinearColorMapper(palette="Viridis256", nan_color="#80808050")
        self._image = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
        self._dots = ColumnDataSource({"x": [], "y": [], "hz": []})
        self._designs = ColumnDataSource({"x": [], "y": []})
        self._here = ColumnDataSource({"x": [], "y": []})
        self._x, self._y = Range1d(start=0.0, end=1.0), Range1d(start=0.0, end=1.0)
        made: Any = figure(
            name="landscape", height=HEIGHT, sizing_mode="stretch_width", toolbar_location="above",
            tools="pan,wheel_zoom,reset,hover", tooltips=[("ω_b (Hz)", "@hz{0.00}")],
            x_range=self._x, y_range=self._y,
        )  # fmt: skip
        made.toolbar.logo = None
        made.xaxis[0].ticker.desired_num_ticks = FEW
        made.image("image", "x", "y", "dw", "dh", source=self._image, color_mapper=self._colours)
        by_value = {"field": "hz", "transform": self._colours}
        made.scatter("x", "y", source=self._designs, size=4, fill_color=RING, line_color=GROUND)
        made.scatter("x", "y", source=self._dots, size=11, fill_color=GROUND, line_color=GROUND)
        made.scatter("x", "y", source=self._dots, size=8, fill_color=by_value, line_color=RING)
        made.scatter("x", "y", source=self._here, marker="star", size=18, fill_color=ORANGE,
                     line_color=GROUND)  # fmt: skip
        self._bar = ColorBar(color_mapper=self._colours, title="ω_b (Hz)", width=10, visible=False,
                             formatter=NumeralTickFormatter(format="0.[00]"))  # fmt: skip
        made.add_layout(self._bar, "right")
        self._figure, self._words = made, Div()

    def root(self) -> Any:
        """All of it, to be placed on the page."""
        fill: Any = "stretch_width"
        return column(row(*self._selects), self._figure, self._words, sizing_mode=fill)

    def choose(self, axes: Sequence[int]) -> None:
        """The parameters across and up."""
        for select, i in zip(self._selects, axes, strict=False):
            select.value = self.names[i]

    @property
    def axes(self) -> tuple[int, int]:
        """The parameters chosen."""
        i, j = (self.names.index(select.value) for select in self._selects)
        return i, j

    def mark(self, theta: Sequence[float]) -> Change:
        """What shows the present design."""
        (i, j), (k, m) = self.axes, self._scales()
        return self._here, {"data": {"x": [k * theta[i]], "y": [m * theta[j]]}}

    def _scales(self) -> tuple[float, float]:
        i, j = self.axes
        return self._units[i][1], self._units[j][1]

    def show(self, land: Landscape, words: str) -> None:
        """The landscape over the parameters chosen."""
        x, y, hz = land.truths.T
        known = np.concatenate([land.bandwidth_hz.ravel(), hz])
        known = known[np.isfinite(known)]
        if known.size:
            low, high = float(known.min()), float(known.max())
            more = 0.5 if high - low < 1e-6 * high else 0.0
            self._colours.update(low=low - more, high=high + more)
            self._bar.visible = True  # laid out when its numbers are known, which need room
        k, m = self._scales()
        first, second = k * land.first, m * land.second
        image: dict[str, list[Any]] = {name: [] for name in self._image.data}
        if land.bandwidth_hz.size:
            places = ([land.bandwidth_hz.T], [first[0]], [second[0]], [np.ptp(first)],
                      [np.ptp(second)])  # fmt: skip
            image = dict(zip(("image", "x", "y", "dw", "dh"), places, strict=True))
        self._image.data = image
        self._dots.data = {"x": k * x, "y": m * y, "hz": hz}
        a, b = land.designs.T
        self._designs.data = {"x": k * a, "y": m * b}
        for axis, ends in ((self._x, first), (self._y, second)):
            margin = MARGIN * float(ends[-1] - ends[0])
            axis.update(start=float(ends[0]) - margin, end=float(ends[-1]) + margin)
        labels = [f"{self.names[i]} ({self._units[i][0]})".replace(" ()", "") for i in self.axes]
        self._figure.xaxis.axis_label, self._figure.yaxis.axis_label = labels
        self._words.text = f"<p>{escape(words)}</p>"
