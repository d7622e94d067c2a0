"""Designs that were pinned: their table, their curves, and the map of ω_b over two parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
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
from bokeh.models.widgets.tables import (
    CellEditor,
    DataTable,
    HTMLTemplateFormatter,
    NumberFormatter,
    StringEditor,
    TableColumn,
)
from bokeh.plotting import figure

from ccd_casadi.cases.tables import Parameter
from ccd_casadi.drawing.charts import GROUND, RING
from ccd_casadi.drawing.content import Landscape
from ccd_casadi.drawing.paint import escape
from ccd_casadi.drawing.svg import AMBER, BROWN, GREEN, ORANGE, PURPLE
from ccd_casadi.extensions.explorer.controls import DARK
from ccd_casadi.extensions.explorer.curves import EMPTY, Drawn
from ccd_casadi.extensions.explorer.designs import ExploredDesign
from ccd_casadi.extensions.explorer.knobs import Knobs
from ccd_casadi.extensions.explorer.painter import FEW, ON_DARK, Change, PanelFigure
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.landscape import bandwidth_process, landscape_data, read_truths
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import display_unit
from surrogates import GaussianProcess, SurrogateFileError, load


def run_surrogate(folder: Path) -> GaussianProcess | None:
    """The newest surrogate of ω_b*(θ) in a run folder; None where there is none to be read."""
    try:
        return bandwidth_process(load(folder / "surrogate.json")[0])
    except (OSError, SurrogateFileError):
        return None


def steepest_axes(
    known: Mapping[tuple[float, ...], float], lower: Sequence[float], upper: Sequence[float]
) -> tuple[int, ...]:
    """The two parameters over whose ranges the samples θ -> ω_b* rise or fall most, in their order.

    By the plane of least squares; of no samples the first two. NaN: infeasible.
    """
    rows = [(1.0, *np.subtract(theta, lower), hz) for theta, hz in known.items() if hz == hz]
    table = np.array(rows).reshape(-1, len(lower) + 2)
    plane = np.linalg.lstsq(table[:, :-1], table[:, -1])[0]
    changes = np.abs(plane[1:] * np.subtract(upper, lower))
    return tuple(sorted(np.argsort(-changes)[:2].tolist()))


def landscape_of(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made_for: CoDesignProblem | None,
    process: GaussianProcess | None,
    store: Path,
    axes: tuple[int, int],
) -> tuple[Landscape, str]:
    """The landscape over the parameters `axes`, the others as at θ, and what it shows.

    `made_for`: the problem that the surrogate is of; of another one it says nothing.
    """
    if process is None or made_for is None:
        process, words = None, "no surrogate: the dots are the best designs looked at"
    elif (made_for.identity(), made_for.inner_identity()) == (
        problem.identity(), problem.inner_identity()
    ):  # fmt: skip
        words = (
            f"colours: ω_b*(θ) by the run's surrogate of {len(process.X)} samples; large "
            "dots: the true ω_b*(θ); small ones: single designs"
        )
    else:
        process = None
        words = "the run's surrogate is of another S_max, range or plant set: not shown"
    truths = read_truths(store, problem)
    return landscape_data(problem, process, truths, theta=theta, axes=axes), words


OF_MAP = 200  # height, px
MARGIN = 0.03  # of the box


class MapFigure:
    """Two choices of a parameter, the map over them, what it shows; `asked` when one is chosen."""

    def __init__(
        self, parameters: Sequence[Parameter], chosen: Callable[[], None], dark: bool
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
            select.on_change("value", lambda attr, old, new: chosen())
        self._colours = LinearColorMapper(palette="Viridis256", nan_color="#80808050")
        self._image = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
        self._dots = ColumnDataSource({"x": [], "y": [], "hz": []})
        self._designs = ColumnDataSource({"x": [], "y": []})
        self._here = ColumnDataSource({"x": [], "y": []})
        self._pins = ColumnDataSource({"x": [], "y": [], "colour": [], "name": []}, name="pinned")
        self._pinned: list[tuple[str, str, Sequence[float]]] = []
        self._x, self._y = Range1d(start=0.0, end=1.0), Range1d(start=0.0, end=1.0)
        made: Any = figure(
            name="landscape", height=OF_MAP, sizing_mode="stretch_width", toolbar_inner=True,
            tools="pan,wheel_zoom,reset,hover", tooltips=[("ω_b (Hz)", "@hz{0.00}")],
            x_range=self._x, y_range=self._y,
        )  # fmt: skip
        made.toolbar.update(logo=None, autohide=True)
        for axis in made.axis:
            axis.update(axis_label_text_font_style="normal", axis_label_text_font_size="12px")
        made.xaxis[0].ticker.desired_num_ticks = FEW
        made.image("image", "x", "y", "dw", "dh", source=self._image, color_mapper=self._colours)
        by_value = {"field": "hz", "transform": self._colours}
        made.scatter("x", "y", source=self._designs, size=4, fill_color=RING, line_color=GROUND)
        made.scatter("x", "y", source=self._dots, size=11, fill_color=GROUND, line_color=GROUND)
        made.scatter("x", "y", source=self._dots, size=8, fill_color=by_value, line_color=RING)
        made.scatter("x", "y", source=self._pins, marker="square_pin", size=15, fill_color="colour",
                     line_color=GROUND, line_width=1.5)  # fmt: skip
        made.text("x", "y", "name", source=self._pins, x_offset=9, y_offset=-5,
                  text_color=RING if dark else GROUND, text_font_size="12px")  # fmt: skip
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
        """The two parameters that are chosen."""
        i, j = (self.names.index(select.value) for select in self._selects)
        return i, j

    def mark(self, theta: Sequence[float]) -> Change:
        """Return the change that shows the present design."""
        (i, j), (k, m) = self.axes, self._scales()
        return self._here, {"data": {"x": [k * theta[i]], "y": [m * theta[j]]}}

    def pin(self, pinned: Sequence[tuple[str, str, Sequence[float]]]) -> None:
        """Draw the pinned designs: colour, name and θ of each."""
        self._pinned = [*pinned]
        (i, j), (k, m) = self.axes, self._scales()
        rows = [(k * theta[i], m * theta[j], colour, name) for colour, name, theta in self._pinned]
        columns = map(list, zip(*rows, strict=True)) if rows else ([] for _ in self._pins.data)
        self._pins.data = dict(zip(self._pins.data, columns, strict=True))

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
        self.pin(self._pinned)
        self._words.text = f"<p>{escape(words)}</p>"


OF_TABLE = 150  # height, px
COLOURS = (ORANGE, GREEN, PURPLE, AMBER, BROWN)
CELLS = """.slick-cell, .slick-header-column { background: #20262b !important; color: #e0e0e0; }
.slick-cell.selected { background: #2f4a5e !important; }"""
# Of a pinned design: field, title, format, width in px, and what it reads.
FIGURES: tuple[tuple[str, str, str, int, Callable[[ExploredDesign], Any]], ...] = (
    ("S_max", "S_max", "0.000", 70, lambda design: design.knobs.S_max),
    ("bandwidth", "ω_b (Hz)", "0.0000", 90, lambda design: design.bandwidth_hz),
    ("peak", "‖S‖∞", "0.0000", 80, lambda design: design.figures.sensitivity_peak),
    ("cost", "hardware cost", "0.0000", 130, lambda design: design.cost),
    ("objective", "J", "0.0000", 110, lambda design: design.objective),
    ("standing", "standing", "", 260, lambda design: design.standing.value),
)
LINE = '<span style="color:<%= value %>">▬▬</span>'


@dataclass
class Kept:
    """The state that outlives a reload of a tab: the values of its sliders, and its pins by
    name."""

    knobs: Knobs | None = None
    pinned: list[tuple[str, Drawn]] = field(default_factory=list)
    count: int = 0


class Pins:
    """Pinned designs, in the order in which they were pinned; a name may be changed in its cell."""

    def __init__(
        self, parameters: Sequence[Parameter], figures: Sequence[PanelFigure], land: MapFigure,
        kept: Kept, dark: bool, cost_unit: str,
    ) -> None:  # fmt: skip
        self.names = [p.name for p in parameters]
        self.figures, self.land, self.kept, self._dark = figures, land, kept, dark
        units = [display_unit(p.unit, p.upper) for p in parameters]
        self._scales = [scale for _, scale in units]
        self.source = ColumnDataSource(self._columns([]))
        self.source.on_change("data", lambda attr, old, new: self._rename(new["design"]))
        thetas = [
            (f"theta_{name}", f"{name} ({unit})" if unit else name, "0.0000", 90)
            for name, (unit, _) in zip(self.names, units, strict=True)
        ]
        cost = f" ({cost_unit})" if cost_unit else ""
        heads = [("colour", "", LINE, 40), ("design", "design", "", 90), *thetas]
        heads += [(name, title + cost * (name == "cost"), form, width)
                  for name, title, form, width, _ in FIGURES]  # fmt: skip
        self.table = DataTable(
            name="pins", source=self.source, height=OF_TABLE, index_position=None, editable=True,
            sizing_mode="stretch_width", autosize_mode="none", reorderable=False,
            columns=[_column(*head) for head in heads], stylesheets=[CELLS] if dark else [],
        )  # fmt: skip
        self._show()

    @property
    def pinned(self) -> list[tuple[str, Drawn]]:
        """Name and design of each."""
        return self.kept.pinned

    def add(self, drawn: Drawn) -> None:
        """Pin a design."""
        self.kept.count += 1
        self.pinned.append((f"pin {self.kept.count}", drawn))
        self._show()

    def drop(self) -> None:
        """Take the selected ones away, the last one where none is selected."""
        chosen = set(self._list_selected()) or {len(self.pinned) - 1}
        self.pinned[:] = [pin for i, pin in enumerate(self.pinned) if i not in chosen]
        self._show()

    def first_selected(self) -> Drawn | None:
        """The first of those selected, the last one where none is; None without a pin."""
        chosen = self._list_selected() or ([len(self.pinned) - 1] if self.pinned else [])
        return self.pinned[chosen[0]][1] if chosen else None

    def _list_selected(self) -> list[int]:
        return [i for i in self.source.selected.indices if i < len(self.pinned)]

    def _rename(self, names: Sequence[str]) -> None:
        if len(names) == len(self.pinned):
            pairs = zip(names, self.pinned, strict=True)
            self.pinned[:] = [(str(name), drawn) for name, (_, drawn) in pairs]
            self._on_map()

    def _columns(self, colours: Sequence[str]) -> dict[str, list[Any]]:
        """The table, a list a column; θ in the units of the sliders."""
        drawn_designs = [drawn.design for _, drawn in self.pinned[: len(colours)]]
        found: dict[str, list[Any]] = {
            "colour": [*colours], "design": [name for name, _ in self.pinned[: len(colours)]]
        }  # fmt: skip
        for i, (name, scale) in enumerate(zip(self.names, self._scales, strict=True)):
            found[f"theta_{name}"] = [scale * design.theta[i] for design in drawn_designs]
        return found | {
            name: json_values([read(design) for design in drawn_designs])
            for name, *_, read in FIGURES
        }

    def _on_map(self) -> None:
        """Whoever looks at the table finds each there by colour and name."""
        rows = enumerate(self.pinned)
        self.land.pin([(COLOURS[i % len(COLOURS)], name, drawn.design.theta)
                       for i, (name, drawn) in rows])  # fmt: skip

    def _show(self) -> None:
        self._on_map()
        self.source.selected.indices = []
        colours = [COLOURS[i % len(COLOURS)] for i in range(len(self.pinned))]
        shown = [ON_DARK[colour] if self._dark else colour for colour in colours]
        self.source.data = self._columns(shown)
        pinned = list(zip(colours, (drawn.panels for _, drawn in self.pinned), strict=True))
        for made in self.figures:
            made.pin([(colour, panels.get(made.name, EMPTY)) for colour, panels in pinned])


def _column(name: str, title: str, form: str, width: int) -> TableColumn:
    design: dict[str, Any] = {"editor": StringEditor() if name == "design" else CellEditor()}
    if form:
        made = HTMLTemplateFormatter(template=form) if "<" in form else NumberFormatter(format=form)
        design["formatter"] = made
    return TableColumn(field=name, title=title, width=width, **design)
