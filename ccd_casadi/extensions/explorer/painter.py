"""Panels in the browser, and all that an answer changes on the page as one message."""

import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from bokeh import models
from bokeh.core.properties import Any as Anything
from bokeh.core.property.descriptors import UnsetValueError
from bokeh.document import Document
from bokeh.events import DocumentReady, Reset
from bokeh.model import DataModel, Model
from bokeh.models import CustomJS
from bokeh.models.annotations import Span
from bokeh.plotting import figure

from ccd_casadi.drawing.charts import positive_range
from ccd_casadi.drawing.content import Curve, Panel
from ccd_casadi.drawing.labels import LINE as TALL
from ccd_casadi.drawing.labels import SIZE, Labels
from ccd_casadi.drawing.svg import BLACK, BLUE, GREY, THEME, VARIABLES
from ccd_casadi.extensions.explorer import ASSETS
from ccd_casadi.support.text import package_text

Change = tuple[Model, dict[str, Any]]  # a model, and new values of its properties


class Message(DataModel):
    """A message whose content reaches every figure in one piece.

    Models are identified by their ids: references would make the server walk through the whole
    document.
    Each array by itself would be two more frames on the socket. All else is one text: lists would
    be walked through twice, 3 ms a drag.
    """

    content: Any = Anything(default=None)

    def apply_in(self, document: Document) -> None:
        """Have the browser apply what comes, and what came before the page was there."""
        apply = CustomJS(args={"message": self}, code=package_text(f"{ASSETS}/apply.js"))
        self.js_on_change("content", apply)
        document.js_on_event(DocumentReady, apply)

    def send(self, words: Mapping[str, str], changes: Sequence[Change]) -> None:
        """Set the HTML of elements of the page by their ids, and properties of models."""
        found, numbers = pack(changes)
        self.content = [json.dumps([dict(words), found], allow_nan=False), numbers]


def pack(changes: Sequence[Change]) -> tuple[list[Any], np.ndarray]:
    """Changes by the models' ids, where an array has its place in the one of all numbers."""
    arrays: list[np.ndarray] = []
    taken = 0

    def place(value: Any) -> Any:
        nonlocal taken
        if isinstance(value, list) and value and all(isinstance(each, float) for each in value):
            value = np.array(value)  # NaN is no JSON
        if isinstance(value, list):
            return [place(each) for each in value]
        if not isinstance(value, np.ndarray):
            return value
        arrays.append(np.asarray(value, float))
        taken += len(value)
        return {"from": taken - len(value), "count": len(value)}

    found = []
    for model, values in changes:
        if "data" in values:
            columns = {name: place(column) for name, column in values["data"].items()}
            values = values | {"data": columns}
        found.append([model.id, values])
    return found, np.concatenate([np.empty(0), *arrays])


HEIGHT = 200
FEW = 4  # ticks of a linear axis across: a figure may be 240 px wide
PX = 11.0 / SIZE  # of a pt of its words
PADDING = 0.1  # of the data, that a linear axis reaches beyond them
CENTRE, HALF = -0.8, (2.4, 2.0)  # of a round plot, and what it shows at least to both sides
DASHES = {"-": "solid", "--": "dashed", ":": "dotted", "-.": "dotdash"}
MARKERS = {"o": "circle", "x": "x", "^": "triangle", "v": "inverted_triangle", "+": "cross",
           ".": "dot"}  # fmt: skip
SIGNS = {"o": "○", "x": "×", "^": "△", "-": "—", "--": "– –", ":": "···", "-.": "–·"}
ON_DARK = dict(THEME.values())
LINE = ("xs", "ys", "colour", "dash", "width", "label")
SPOT = ("x", "y", "colour", "marker")
WORD = ("x", "y", "text", "colour", "dx", "dy", "angle", "align", "baseline")
AREA = ("xs", "ys", "colour", "alpha")


class PanelFigure:
    """One pair of axes on the page; `changes` paints a panel of the same kind of axes."""

    def __init__(
        self, name: str, heading: str, dark: bool, *, log_x: bool = False, log_y: bool = False,
        x_range: models.Range1d | None = None, cursor: Span | None = None,
        whole_circles: bool = False, inside: tuple[int, int] = (240, 150),
    ) -> None:  # fmt: skip
        self.name, self.heading, self._inside = name, heading, inside  # px of the axes, at first
        self._dark, self._log_x, self._log_y, self._round = dark, log_x, log_y, whole_circles
        self._shared = x_range is not None
        self.own, self._lines, self._pins = (_source(LINE, f"own_{name}"), _source(LINE),
                                             _source(LINE))  # fmt: skip
        self._areas, self._spots, self._words = _source(AREA), _source(SPOT), _source(WORD)
        self._ends: list[tuple[float, float]] = []  # of both axes, as they are shown
        self._sent: dict[str, dict[str, Any]] = {}  # by the model's id, what was last
        self._beside: list[Curve] = []
        self.figure = self._figure(x_range or models.Range1d(start=0.1, end=1e4))
        self._paint(cursor)

    def _figure(self, x_range: models.Range1d) -> Any:
        made: Any = figure(
            name=self.name, height=HEIGHT, sizing_mode="stretch_width", min_border_left=58,
            tools="pan,box_zoom,wheel_zoom,reset", toolbar_inner=True, x_range=x_range,
            y_range=models.Range1d(start=1e-3 if self._log_y else -2.0, end=2.0),
            x_axis_type="log" if self._log_x else "linear",
            y_axis_type="log" if self._log_y else "linear",
        )  # fmt: skip
        made.js_on_event(Reset, models.CustomJS(code=package_text(f"{ASSETS}/follow.js")))
        made.toolbar.logo = None
        made.toolbar.autohide = True
        for axis in made.axis:
            axis.update(axis_label_text_font_style="normal", axis_label_text_font_size="12px")
        if not self._log_x:
            made.xaxis[0].ticker.desired_num_ticks = FEW
        if self._round:
            for tool in made.tools:  # what is zoomed keeps one scale too
                if isinstance(tool, models.BoxZoomTool):
                    tool.match_aspect = True
                if isinstance(tool, models.WheelZoomTool):
                    tool.zoom_on_axis = False
            fit = models.CustomJS(args={"figure": made, "centre": CENTRE, "half": list(HALF)},
                           code=package_text(f"{ASSETS}/round.js"))  # fmt: skip
            for size in ("inner_width", "inner_height"):
                made.js_on_change(size, fit)
        return made

    def _paint(self, cursor: Span | None) -> None:
        made = self.figure
        made.patches("xs", "ys", source=self._areas, fill_color="colour", fill_alpha="alpha",
                     line_color=None)  # fmt: skip
        design = {"line_color": "colour", "line_dash": "dash", "line_width": "width"}
        for source in (self._lines, self._pins):
            made.multi_line("xs", "ys", source=source, **design)
        own = made.multi_line("xs", "ys", source=self.own, **design)
        made.scatter("x", "y", source=self._spots, marker="marker", size=8, line_color="colour",
                     fill_alpha=0.0, line_width=1.6)  # fmt: skip
        made.text("x", "y", "text", source=self._words, text_color="colour", x_offset="dx",
                  y_offset="dy", angle="angle", text_align="align", text_baseline="baseline",
                  text_font_size="11px")  # fmt: skip
        if not self._round:
            digits = models.CustomJSHover(code="return Number(value.toPrecision(5)).toString()")
            tips = models.HoverTool(
                renderers=[own], mode="vline", line_policy="nearest",
                tooltips=[("@x_label", "$snap_x{custom}"), ("@y_label", "$snap_y{custom}")],
                formatters={"$snap_x": digits, "$snap_y": digits},
            )  # fmt: skip
            self._tips = tips
            made.add_tools(tips)
        if cursor is not None:
            made.add_tools(models.CrosshairTool(overlay=cursor))

    def changes(self, panel: Panel, colour: str, dash: str, frame: bool) -> list[Change]:
        """List the changes that paint a panel; `colour` and `dash` of the present design's curves,
        nothing for a dash that is its own. `frame`: the axes are set anew; else they only widen, an
        axis that is shared not even that: while one drags they stand still, and cost nothing."""
        own = [c for c in panel.curves if _is_own(c)]
        others = [c for c in panel.curves if c.line and not _is_own(c)]
        drawn = [
            Curve(c.x, c.y, c.label, colour, dash or c.line, width=max(c.width, 2.0)) for c in own
        ]
        spots = [(x, y, self._on(colour if c.colour == BLUE else c.colour), MARKERS[c.marker])
                 for c in panel.curves if c.marker
                 for x, y in zip(c.x, c.y, strict=True)]  # fmt: skip
        spots += [(m.x, m.y, self._on(m.colour), MARKERS[m.marker])
                  for m in panel.marks if m.marker]  # fmt: skip
        areas = [(a.x, a.y, self._on(a.colour), 0.2) for a in panel.forbidden]
        areas += [(np.append(b.x, b.x[::-1]), np.append(b.low, b.high[::-1]), self._on(b.colour),
                   0.18) for b in panel.bands]  # fmt: skip
        ends = [self._range(panel, axis) for axis in (0, 1)]
        if not panel.curves:  # the axes stay as they are
            ends = self._ends or [(0.1, 1e3), (1e-3, 10.0)]
        elif self._ends and not frame:
            ends = [(min(old[0], new[0]), max(old[1], new[1]))
                    for old, new in zip(self._ends, ends, strict=True)]  # fmt: skip
            ends = [self._ends[0], ends[1]] if self._shared else ends
        wider = [new != old for new, old in zip(ends, self._ends or (None, None), strict=True)]
        self._ends, (x, y) = ends, ends
        for v in panel.levels:
            at = np.array([v.value, v.value])
            line = (at, np.array(y)) if v.vertical else (np.array(x), at)
            others.append(Curve(*line, "", v.colour, "--", width=0.9))
        found = [
            _rows(self.own, map(self._line, drawn)), _rows(self._lines, map(self._line, others)),
            _rows(self._areas, areas), _rows(self._spots, spots), self._place_words(panel, ends),
        ]  # fmt: skip
        for axis, label in ((self.figure.xaxis, panel.x_label), (self.figure.yaxis, panel.y_label)):
            found.append((axis[0], {"axis_label": label}))
        if not self._round:
            tips = [[panel.x_label, "$snap_x{custom}"], [panel.y_label, "$snap_y{custom}"]]
            found.append((self._tips, {"tooltips": tips}))
            axes = zip((self.figure.x_range, self.figure.y_range), ends, wider, strict=True)
            found += [_ends(axis, *place) for axis, place, new in axes if new]
        new = [(model, values) for model, values in found
               if not _same(self._sent.get(model.id), values)]  # fmt: skip
        self._sent |= {model.id: values for model, values in new}
        return new

    def pin(self, pinned: Sequence[tuple[str, Panel]]) -> None:
        """Draw the present curves of other panels beside, each in its colour."""
        self._beside = [Curve(c.x, c.y, c.label, colour) for colour, panel in pinned
                        for c in panel.curves if _is_own(c)]  # fmt: skip
        source, values = _rows(self._pins, map(self._line, self._beside))
        source.update(**values)

    def _on(self, colour: str) -> str:
        return ON_DARK.get(colour, colour) if self._dark else colour

    def _line(self, c: Curve) -> tuple[Any, ...]:
        return (np.asarray(c.x, float), np.asarray(c.y, float), self._on(c.colour), DASHES[c.line],
                c.width, c.label)  # fmt: skip

    def _place_words(self, panel: Panel, ranges: list[tuple[float, float]]) -> Change:
        """The words of marks and levels where they do not meet, in the size that the browser gave
        last: of a figure that was not laid out yet, a usual one."""
        if not any([m.text for m in panel.marks] + [v.text for v in panel.levels]):
            return _rows(self._words, ())
        try:
            wide, tall = self.figure.inner_width, self.figure.inner_height
        except UnsetValueError:
            wide, tall = self._inside
        logs = self._log_x, self._log_y
        if self._round:  # as round.js has them
            scale = max(2.0 * HALF[0] / wide, 2.0 * HALF[1] / tall)
            ranges = [(middle - 0.5 * scale * size, middle + 0.5 * scale * size)
                      for middle, size in ((CENTRE, wide), (0.0, tall))]  # fmt: skip

        def points(x: Any, y: Any) -> np.ndarray:
            found = []
            for v, log, ends, size in zip((x, y), logs, ranges, (wide, tall), strict=True):
                values, low, high = np.asarray(v, float), *ends
                if log:
                    with np.errstate(divide="ignore", invalid="ignore"):
                        values, low, high = np.log(values), np.log(low), np.log(high)
                found.append((values - low) / (high - low) * size / PX)
            return np.column_stack(found)

        words = []
        box = (0.0, 0.0, wide / PX, tall / PX - TALL)  # what is above the axes is cut off
        for w in Labels(panel, box, points, ranges).words():
            sides = w.across, w.up
            if w.upright:  # turned about its place, and so are its sides
                sides = "left", "top" if w.dx > 0 else "bottom"
            turn = 0.5 * np.pi * w.upright
            off = PX * w.dx, -PX * w.dy
            words.append((w.x, w.y, w.text, self._on(w.colour), *off, turn, *sides))
        return _rows(self._words, words)

    def _range(self, panel: Panel, axis: int) -> tuple[float, float]:
        """Return the range that the panel gives, or the one over its curves and those beside it."""
        log = (self._log_x, self._log_y)[axis]
        given = (panel.x_range, panel.y_range)[axis]
        if given is not None:
            return given
        values = [np.ravel((c.x, c.y)[axis]) for c in (*panel.curves, *self._beside)]
        if log:
            return positive_range([np.empty(0), *values])
        known = np.concatenate([np.empty(0), *values])
        known = known[np.isfinite(known)]
        if not known.size:
            return 0.0, 1.0
        low, high = float(known.min()), float(known.max())
        margin = PADDING * (high - low) or 1.0
        return (low - margin if axis else low), high + margin


def legend_html(panel: Panel, own: str = BLUE) -> str:
    """Write the legend of a panel's curves, each in its colour: `own` of the present design's."""
    items = [(SIGNS.get(c.marker) or SIGNS[c.line], own if c.colour == BLUE else c.colour, c.label)
             for c in panel.curves]  # fmt: skip
    items += [("▬", band.colour, band.label) for band in panel.bands]
    parts = [
        f'<span aria-hidden="true" style="color:{VARIABLES.get(colour, VARIABLES[BLACK])}">{sign}'
        f"</span> {escape(label)}"
        for sign, colour, label in items
        if label
    ]
    return " · ".join(parts + (["shaded: beyond a bound"] if panel.forbidden else []))


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return all(_same(value, other[key]) for key, value in one.items())
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other)


def _is_own(curve: Curve) -> bool:
    """Decide whether a curve is of the present design itself, not of what bounds it."""
    return curve.colour == BLUE and curve.line == "-"


def _source(columns: Sequence[str], name: str = "") -> models.ColumnDataSource:
    return models.ColumnDataSource({column: [] for column in columns}, name=name or None)


def _rows(source: models.ColumnDataSource, rows: Any) -> Change:
    """Rows as the columns of a source."""
    names, rows = list(source.data), list(rows)
    columns: list[Any] = [[row[i] for row in rows] for i in range(len(names))]
    return source, {"data": dict(zip(names, columns, strict=True))}


def _ends(axis: models.Range1d, start: float, end: float) -> Change:
    return axis, {"start": start, "end": end, "reset_start": start, "reset_end": end}


def cursor() -> Span:
    """One line through all figures over frequency."""
    return Span(dimension="height", line_color=GREY, line_dash="dotted")
