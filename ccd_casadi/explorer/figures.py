"""The explorer's figures: empty once, then filled from curves as designs are looked at.

What a design changes is handed out as changes, which the page sends in one message.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.events import Reset
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    CrosshairTool,
    CustomJS,
    FixedTicker,
    HoverTool,
    Range1d,
    WheelZoomTool,
)
from bokeh.models.annotations import BoxAnnotation, Span
from bokeh.plotting import figure

from ccd_casadi.analysis.loop_view import frequency_and_damping, phase_deg
from ccd_casadi.drawing.svg import AMBER, BLUE, BROWN, GREEN, GREY, ORANGE, PURPLE, SKY
from ccd_casadi.explorer.curves import AsSampled, Curves
from ccd_casadi.explorer.designs import Look, Standing
from ccd_casadi.explorer.message import Change
from ccd_casadi.reporting.nyquist import FAR
from ccd_casadi.support.package_text import package_text

HEIGHT = 230
TOP = 1e12  # above every gain: a shaded region ends there
SLOWEST = 0.1  # of the least frequency shown: where slower poles are drawn
GAINS = (("S", "σ_max(S)"), ("KS", "σ_max(KS) (N/m)"), ("T", "σ_max(T)"))
BODE = ("size", "phase")
PIN_COLOURS = (ORANGE, GREEN, PURPLE, AMBER, BROWN)
DASHES = {Standing.KEPT: [], Standing.MISSED: [], Standing.NEAR: [2, 3], Standing.REFUSED: [6]}
PADDING = 0.1  # of the data, that an axis reaches beyond them
CENTRE, HALF = -0.8, (2.4, 2.0)  # of the Nyquist plot, and what it shows at least to both sides


@dataclass(frozen=True)
class Drawn:
    """A design with its curves (None: there are none) and the loop as sampled, if it was asked."""

    look: Look
    curves: Curves | None
    sampled: AsSampled | None = None


class Figures:
    """All figures and their sources; `show` fills in a design, `pin` the pinned ones."""

    def __init__(self, dark: bool) -> None:
        self.main = SKY if dark else BLUE
        self.ink = "#d0d0d0" if dark else "#333333"
        columns = ("hz", "S", "KS", "T", "bS", "bKS", "bT", "top")
        self.gains = ColumnDataSource({k: [] for k in columns}, name="gains")
        self.sampled = ColumnDataSource({"hz": [], "S": []})
        self.loci = ColumnDataSource({"xs": [], "ys": []})
        self.loop = ColumnDataSource({"hz": [], "size": [], "phase": []})
        self.poles = {
            name: ColumnDataSource({"hz": [], "damping": []}) for name in ("loop", "K", "G")
        }
        self.step = ColumnDataSource({"ms": [], "y": []})
        self.move = ColumnDataSource({"ms": [], "um": []})
        self.pinned = {
            name: ColumnDataSource({"xs": [], "ys": [], "colour": [], "name": []})
            for name in ("S", "KS", "T", "nyquist", *BODE, "step", "move")
        }
        self.lines: list[Any] = []  # those of the present design, whose look says its standing
        self.cursor = Span(dimension="height", line_color=GREY, line_dash="dotted")
        hz = Range1d(start=0.1, end=1e4)
        self.of_gain = [self._gain(name, label, hz) for name, label in GAINS]
        self.hz = hz
        self.loop_size, self.loop_phase = self._bode(hz)
        self.nyquist = self._nyquist()
        self.pole_map = self._poles()
        self.step_figure = self._time("step", "ms", "y after a step of r", self.step, "y")
        self.move_figure = self._time("move", "ms", "error of a move (µm)", self.move, "um")
        self.end = Span(dimension="height", line_color=GREY, line_dash="dashed")
        self.move_figure.add_layout(self.end)

    def all(self) -> dict[str, Any]:
        """Figures by the name of their place on the page."""
        names = [f"gain_{name}" for name, _ in GAINS]
        found = dict(zip(names, self.of_gain, strict=True))
        others = {
            "nyquist": self.nyquist, "loop": self.loop_size, "phase": self.loop_phase,
            "poles": self.pole_map, "step": self.step_figure, "move": self.move_figure,
        }  # fmt: skip
        return found | others

    def _figure(self, name: str, x: str, y: str, **options: Any) -> Any:
        made = figure(
            name=name, x_axis_label=x, y_axis_label=y, height=HEIGHT, sizing_mode="stretch_width",
            min_border_left=58, tools="pan,box_zoom,wheel_zoom,reset", toolbar_location="above",
            **options,
        )  # fmt: skip
        made.js_on_event(Reset, CustomJS(code=package_text("explorer/assets/follow.js")))
        made.toolbar.logo = None
        made.toolbar.autohide = True
        for axis in made.axis:
            axis.axis_label_text_font_style = "normal"
        return made

    def _line(self, on: Any, x: str, y: str, source: ColumnDataSource, **look: Any) -> Any:
        found = on.line(x, y, source=source, line_color=self.main, line_width=2.2, **look)
        self.lines.append(found.glyph)
        return found

    def _pins(self, on: Any, name: str) -> None:
        source = self.pinned[name]
        on.multi_line("xs", "ys", source=source, line_color="colour", line_width=1.3)

    def _gain(self, name: str, label: str, hz: Range1d) -> Any:
        made = self._figure(
            f"gain_{name}",
            "frequency (Hz)",
            label,
            x_axis_type="log",
            y_axis_type="log",
            x_range=hz,
            y_range=Range1d(start=1e-3, end=2.0),
        )
        made.varea("hz", f"b{name}", "top", source=self.gains, fill_color=ORANGE, fill_alpha=0.13)
        made.line("hz", f"b{name}", source=self.gains, line_color=ORANGE, line_dash="dashed")
        self._pins(made, name)
        line = self._line(made, "hz", name, self.gains)
        if name == "S":
            self.S_max = BoxAnnotation(
                bottom=2.0, fill_color=ORANGE, fill_alpha=0.28, level="underlay"
            )
            self.S_low = BoxAnnotation(fill_color=ORANGE, fill_alpha=0.28, level="underlay")
            self.bandwidth = Span(dimension="height", line_color=GREEN, line_width=1.2)
            for part in (self.S_max, self.S_low, self.bandwidth):
                made.add_layout(part)
            made.add_layout(
                Span(location=2**-0.5, dimension="width", line_color=GREY, line_dash="dotted")
            )
            made.line(
                "hz",
                "S",
                source=self.sampled,
                line_color=PURPLE,
                line_dash="dotdash",
                line_width=1.6,
            )
        made.add_tools(
            CrosshairTool(overlay=self.cursor),
            _hover(line, [("Hz", "@hz{0.00}"), (name, f"@{name}{{0.0000}}")]),
        )  # fmt: skip
        return made

    def _nyquist(self) -> Any:
        made = self._figure("nyquist", "Re L", "Im L", x_range=(-3.2, 1.6), y_range=(-2.0, 2.0))
        for tool in made.tools:  # what is zoomed keeps one scale too
            if isinstance(tool, BoxZoomTool):
                tool.match_aspect = True
            if isinstance(tool, WheelZoomTool):
                tool.zoom_on_axis = False
        fit = CustomJS(args={"figure": made, "centre": CENTRE, "half": list(HALF)},
                       code=package_text("explorer/assets/round.js"))  # fmt: skip
        for size in ("inner_width", "inner_height"):
            made.js_on_change(size, fit)
        # ellipses: true in both axes, whatever these do, where a circle would take that across
        made.ellipse(
            0.0, 0.0, width=2.0, height=2.0, fill_color=None, line_color=GREY, line_dash="dotted"
        )
        self.disk = made.ellipse(
            -1.0, 0.0, width=1.0, height=1.0, fill_color=ORANGE, fill_alpha=0.28, line_color=ORANGE
        )
        made.scatter([-1.0], [0.0], marker="cross", size=9, line_color=self.ink)
        self._pins(made, "nyquist")
        found = made.multi_line("xs", "ys", source=self.loci, line_color=self.main, line_width=2.0)
        self.lines.append(found.glyph)
        return made

    def _bode(self, hz: Range1d) -> tuple[Any, Any]:
        """|L| and its phase, with 1 and the odd multiples of 180° where the two decide."""
        made = []
        for name, label, axis, at in (
            ("size", "|L|", "log", [1.0]), ("phase", "phase of L (°)", "linear", [-540, -180, 180]),
        ):  # fmt: skip
            y_range = (
                Range1d(start=1e-3, end=1e3) if name == "size" else Range1d(start=-540, end=90)
            )
            on = self._figure(
                name, "frequency (Hz)", label, x_axis_type="log", y_axis_type=axis, x_range=hz,
                y_range=y_range,
            )  # fmt: skip
            for level in at:
                on.add_layout(
                    Span(location=level, dimension="width", line_color=GREY, line_dash="dotted")
                )
            self._pins(on, name)
            found = on.multi_line(
                "hz", name, source=self.loop, line_color=self.main, line_width=2.0
            )
            self.lines.append(found.glyph)
            on.add_tools(CrosshairTool(overlay=self.cursor))
            made.append(on)
        made[1].yaxis.ticker = FixedTicker(ticks=[*range(-1080, 1081, 180)])
        return made[0], made[1]

    def _poles(self) -> Any:
        ranges = {"x_range": Range1d(start=0.1, end=1e4), "y_range": Range1d(start=-0.08, end=1.08)}
        made = self._figure("poles", "|pole| (Hz)", "damping ratio", x_axis_type="log", **ranges)
        made.add_layout(
            BoxAnnotation(top=0.0, fill_color=ORANGE, fill_alpha=0.28, level="underlay")
        )
        looks = {"G": ("circle", GREY, "plant"), "K": ("triangle", GREEN, "controller"),
                 "loop": ("x", self.main, "closed loop")}  # fmt: skip
        for name, (marker, colour, words) in looks.items():
            found = made.scatter(
                "hz", "damping", source=self.poles[name], marker=marker, size=9, line_color=colour,
                fill_alpha=0.0, line_width=1.6,
            )  # fmt: skip
            tips = [(words, "@hz{0.000} Hz, ζ = @damping{0.0000}")]
            made.add_tools(HoverTool(renderers=[found], tooltips=tips))
        return made

    def _time(self, name: str, unit: str, label: str, source: ColumnDataSource, y: str) -> Any:
        ranges = {axis: Range1d(start=0.0, end=1.0) for axis in ("x_range", "y_range")}
        made = self._figure(name, f"time ({unit})", label, **ranges)
        self._pins(made, name)
        line = self._line(made, unit, y, source)
        made.add_tools(_hover(line, [("ms", f"@{unit}{{0.00}}"), (label, f"@{y}{{0.0000}}")]))
        return made

    def changes(self, drawn: Drawn, pinned: Sequence[Drawn] = ()) -> list[Change]:
        """What shows a design; where it has no controller nothing is drawn of it.

        The axes reach over it and over those `pinned`.
        """
        look, c, s = drawn.look, drawn.curves, drawn.sampled
        inner = look.problem.inner
        colour = {Standing.KEPT: self.main, Standing.MISSED: AMBER}.get(look.standing, GREY)
        line = {"line_color": colour, "line_dash": DASHES[look.standing]}
        certified = look.standing is not Standing.REFUSED
        found: list[Change] = [
            (self.S_max, {"bottom": inner.S_max}),
            (self.disk.glyph, dict.fromkeys(("width", "height"), 2.0 / inner.S_max)),
            (self.S_low, {"right": inner.omega_low / (2 * np.pi), "bottom": inner.S_low}),
            *((glyph, line) for glyph in self.lines),
            (self.bandwidth, {"location": look.bandwidth_hz if certified else None}),
            _data(self.sampled, hz=[], S=[]) if s is None
            else _data(self.sampled, hz=s.hz, S=s.gain),
        ]  # fmt: skip
        if c is None:
            sources = (self.gains, self.loci, self.loop, self.step, self.move, *self.poles.values())
            return found + [_data(source, **{key: [] for key in source.data}) for source in sources]
        columns = {"hz": c.view.hz, "top": np.full(len(c.view.hz), TOP)}
        bounds = c.view.bounds if certified else np.full_like(c.view.bounds, np.nan)
        for (name, _), gain, bound in zip(GAINS, c.view.gains, bounds, strict=True):
            columns |= {name: gain, f"b{name}": bound}
        lines = _lines(c)
        (hz, size), (_, phase) = (tuple(zip(*lines[name], strict=True)) for name in BODE)
        xs, ys = zip(*lines["nyquist"], strict=True)
        (ms, y), (end, um) = (lines[name][0] for name in ("step", "move"))
        found += [
            _data(self.gains, **columns), _data(self.loci, xs=list(xs), ys=list(ys)),
            _data(self.loop, hz=list(hz), size=list(size), phase=list(phase)),
            _data(self.step, ms=ms, y=y), _data(self.move, ms=end, um=um),
            (self.end, {"location": 1e3 * c.move.duration}),
        ]  # fmt: skip
        at_poles = []
        for name, roots in (("loop", c.poles), ("K", c.controller_poles), ("G", c.plant_poles)):
            at, damping = frequency_and_damping(roots)
            at = np.maximum(at, SLOWEST * c.view.hz[0])  # an integrator's has no place there
            at_poles.append(at)
            found.append(_data(self.poles[name], hz=at, damping=damping))
        spans: list[tuple[Range1d, Sequence[Any], bool]] = [
            *((made.y_range, [c.view.gains[i]], True) for i, made in enumerate(self.of_gain)),
            (self.pole_map.x_range, at_poles, True), (self.loop_size.y_range, size, True),
            (self.loop_phase.y_range, phase, False),
        ]  # fmt: skip
        known = [lines, *(_lines(pin.curves) for pin in pinned if pin.curves is not None)]
        for name, made in (("step", self.step_figure), ("move", self.move_figure)):
            x, y = zip(*(each[name][0] for each in known), strict=True)
            spans += [(made.x_range, x, False), (made.y_range, y, False)]
        return found + [_spanned(*span) for span in spans]

    def frame(self, drawn: Drawn) -> list[Change]:
        """What lets the frequency axis reach over the present design."""
        if drawn.curves is None:
            return []
        return [_ends(self.hz, float(drawn.curves.view.hz[0]), float(drawn.curves.view.hz[-1]))]

    def pin(self, pins: list[tuple[str, Drawn]]) -> None:
        """Draw the pinned designs beside the present one."""
        rows: dict[str, list[tuple[Any, Any, str, str]]] = {name: [] for name in self.pinned}
        for i, (name, drawn) in enumerate(pins):
            if drawn.curves is None:
                continue
            colour = PIN_COLOURS[i % len(PIN_COLOURS)]
            for place, lines in _lines(drawn.curves).items():
                rows[place] += [(x, y, colour, name) for x, y in lines]
        for name, source in self.pinned.items():
            keys = ("xs", "ys", "colour", "name")
            source.data = {key: [row[i] for row in rows[name]] for i, key in enumerate(keys)}


def _data(source: ColumnDataSource, **columns: Any) -> Change:
    return source, {"data": columns}


def _ends(axis: Range1d, start: float, end: float) -> Change:
    return axis, {"start": start, "end": end, "reset_start": start, "reset_end": end}


def _spanned(axis: Range1d, values: Sequence[np.ndarray], log: bool) -> Change:
    """An axis over finite values, a little wider; as it is where there are none."""
    known = np.concatenate([np.ravel(each) for each in values])
    known = known[np.isfinite(known) & ((known > 0.0) | (not log))]
    if not known.size:
        return axis, {}
    low, high = float(known.min()), float(known.max())
    if log:
        factor = max((high / low) ** PADDING, 1.1)
        return _ends(axis, low / factor, high * factor)
    margin = PADDING * (high - low) or 1.0
    return _ends(axis, low - margin, high + margin)


def _lines(c: Curves) -> dict[str, list[tuple[Any, Any]]]:
    """x and y of every line of a design, by the name of its figure."""
    hz = c.view.hz
    near = np.where(np.abs(c.loci) <= FAR, c.loci, np.nan)
    found = {name: [(hz, gain)] for (name, _), gain in zip(GAINS, c.view.gains, strict=True)}
    return found | {
        "nyquist": [(line.real, line.imag) for line in near.T],
        "size": [(hz, line) for line in np.abs(c.loci).T],
        "phase": [(hz, line) for line in phase_deg(c.loci).T],
        "step": [(1e3 * c.step_time, c.step)],
        "move": [(1e3 * c.move.time, 1e6 * c.move.error)],
    }


def _hover(line: Any, tips: list[tuple[str, str]]) -> HoverTool:
    return HoverTool(renderers=[line], mode="vline", tooltips=tips)
