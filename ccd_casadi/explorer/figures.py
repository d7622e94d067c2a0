"""The explorer's figures: empty once, then filled from curves as designs are looked at."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, CrosshairTool, DataRange1d, HoverTool, Range1d
from bokeh.models.annotations import BoxAnnotation, Span
from bokeh.plotting import figure

from ccd_casadi.explorer.curves import AsSampled, Curves
from ccd_casadi.explorer.designs import Look, Standing
from ccd_casadi.reporting.svg import AMBER, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY

HEIGHT = 230
TOP = 1e12  # above every gain: a shaded region ends there
SLOWEST = 0.1  # of the least frequency shown: where slower poles are drawn
GAINS = (("S", "σ_max(S)"), ("KS", "σ_max(KS) (N/m)"), ("T", "σ_max(T)"))
PIN_COLOURS = (ORANGE, GREEN, PURPLE, AMBER, SKY)
DASHES = {Standing.KEPT: "solid", Standing.MISSED: "solid", Standing.REFUSED: "dashed"}


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
        self.gains = ColumnDataSource(
            {k: [] for k in ("hz", "S", "KS", "T", "bS", "bKS", "bT", "top")}
        )
        self.sampled = ColumnDataSource({"hz": [], "S": []})
        self.loci = ColumnDataSource({"xs": [], "ys": []})
        self.poles = {
            name: ColumnDataSource({"hz": [], "damping": []}) for name in ("loop", "K", "G")
        }
        self.step = ColumnDataSource({"ms": [], "y": []})
        self.move = ColumnDataSource({"ms": [], "um": []})
        self.pinned = {
            name: ColumnDataSource({"xs": [], "ys": [], "colour": [], "name": []})
            for name in ("S", "KS", "T", "nyquist", "step", "move")
        }
        self.lines: list[Any] = []  # those of the present design, whose look says its standing
        self.cursor = Span(dimension="height", line_color=GREY, line_dash="dotted")
        hz = Range1d(start=0.1, end=1e4)
        self.of_gain = [self._gain(name, label, hz) for name, label in GAINS]
        self.hz = hz
        self.nyquist = self._nyquist()
        self.pole_map = self._poles()
        self.step_figure = self._time("step", "ms", "y after a step of r", self.step, "y")
        self.move_figure = self._time("move", "ms", "error of a move (µm)", self.move, "um")
        self.end = Span(dimension="height", line_color=GREY, line_dash="dashed")
        self.move_figure.add_layout(self.end)
        self._curves = list(self.all().values())

    def all(self) -> dict[str, Any]:
        """Figures by the name of their place on the page."""
        names = [f"gain_{name}" for name, _ in GAINS]
        found = dict(zip(names, self.of_gain, strict=True))
        others = (self.nyquist, self.pole_map, self.step_figure, self.move_figure)
        return found | dict(zip(("nyquist", "poles", "step", "move"), others, strict=True))

    def _figure(self, name: str, x: str, y: str, **options: Any) -> Any:
        made = figure(
            name=name, x_axis_label=x, y_axis_label=y, height=HEIGHT, sizing_mode="stretch_width",
            min_border_left=58, tools="pan,box_zoom,wheel_zoom,reset", toolbar_location="above",
            **options,
        )  # fmt: skip
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
        )
        made.varea("hz", f"b{name}", "top", source=self.gains, fill_color=ORANGE, fill_alpha=0.13)
        made.line("hz", f"b{name}", source=self.gains, line_color=ORANGE, line_dash="dashed")
        self._pins(made, name)
        line = self._line(made, "hz", name, self.gains)
        renderers = [line]
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
        made.y_range = DataRange1d(renderers=renderers, range_padding=0.12)
        made.add_tools(
            CrosshairTool(overlay=self.cursor),
            _hover(line, [("Hz", "@hz{0.00}"), (name, f"@{name}{{0.0000}}")]),
        )  # fmt: skip
        return made

    def _nyquist(self) -> Any:
        made = self._figure(
            "nyquist", "Re L", "Im L", x_range=(-3.2, 1.6), y_range=(-2.0, 2.0), match_aspect=True
        )
        made.circle(0.0, 0.0, radius=1.0, fill_color=None, line_color=GREY, line_dash="dotted")
        self.disk = made.circle(
            -1.0, 0.0, radius=0.5, fill_color=ORANGE, fill_alpha=0.28, line_color=ORANGE
        )
        made.scatter([-1.0], [0.0], marker="cross", size=9, line_color=self.ink)
        self._pins(made, "nyquist")
        found = made.multi_line("xs", "ys", source=self.loci, line_color=self.main, line_width=2.0)
        self.lines.append(found.glyph)
        return made

    def _poles(self) -> Any:
        made = self._figure("poles", "|pole| (Hz)", "damping ratio", x_axis_type="log")
        made.y_range = Range1d(start=-0.08, end=1.08)
        made.add_layout(
            BoxAnnotation(top=0.0, fill_color=ORANGE, fill_alpha=0.28, level="underlay")
        )
        looks = {"G": ("circle", GREY, "plant"), "K": ("triangle", GREEN, "controller"),
                 "loop": ("x", self.main, "closed loop")}  # fmt: skip
        for name, (marker, colour, words) in looks.items():
            found = made.scatter(
                "hz", "damping", source=self.poles[name], marker=marker, size=9, line_color=colour,
                fill_alpha=0.0, line_width=1.6, legend_label=words,
            )  # fmt: skip
            tips = [(words, "@hz{0.000} Hz, ζ = @damping{0.0000}")]
            made.add_tools(HoverTool(renderers=[found], tooltips=tips))
        made.add_layout(made.legend[0], "above")  # it would lie over poles
        made.legend.orientation = "horizontal"
        made.legend.label_text_font_size = "11px"
        made.legend.background_fill_alpha = 0.4
        return made

    def _time(self, name: str, unit: str, label: str, source: ColumnDataSource, y: str) -> Any:
        made = self._figure(name, f"time ({unit})", label)
        self._pins(made, name)
        line = self._line(made, unit, y, source)
        made.add_tools(_hover(line, [("ms", f"@{unit}{{0.00}}"), (label, f"@{y}{{0.0000}}")]))
        return made

    def show(self, drawn: Drawn) -> None:
        """Fill in a design; where it has no controller nothing is drawn of it.

        Each figure is painted once, when all of it has arrived.
        """
        for made in self._curves:
            made.hold_render = True
        self._fill(drawn)
        for made in self._curves:
            made.hold_render = False

    def _fill(self, drawn: Drawn) -> None:
        look, c = drawn.look, drawn.curves
        inner = look.problem.inner
        self.S_max.bottom, self.disk.glyph.radius = inner.S_max, 1.0 / inner.S_max
        self.S_low.right, self.S_low.bottom = inner.omega_low / (2 * np.pi), inner.S_low
        colour = {Standing.KEPT: self.main, Standing.MISSED: AMBER, Standing.REFUSED: GREY}
        for glyph in self.lines:
            glyph.line_color = colour[look.standing]
            glyph.line_dash = DASHES[look.standing]
        certified = look.standing is not Standing.REFUSED
        self.bandwidth.location = look.bandwidth_hz if certified else None
        s = drawn.sampled
        self.sampled.data = {"hz": [], "S": []} if s is None else {"hz": s.hz, "S": s.gain}
        if c is None:
            self._clear()
            return
        columns = {"hz": c.hz, "top": np.full(len(c.hz), TOP)}
        for i, (name, _) in enumerate(GAINS):
            columns |= {
                name: c.gains[i],
                f"b{name}": c.bounds[i] if certified else np.full(len(c.hz), np.nan),
            }
        self.gains.data = columns
        self.loci.data = dict(zip(("xs", "ys"), _lines(c.loci), strict=True))
        for name, roots in (("loop", c.poles), ("K", c.controller_poles), ("G", c.plant_poles)):
            upper = roots[roots.imag >= 0.0]
            size = np.maximum(np.abs(upper), 1e-300)
            at = np.maximum(size, SLOWEST * c.hz[0])  # an integrator's has no place on the axis
            self.poles[name].data = {"hz": at, "damping": -upper.real / size}
        self.step.data = {"ms": 1e3 * c.step_time, "y": c.step}
        self.move.data = {"ms": 1e3 * c.move.time, "um": 1e6 * c.move.error}
        self.end.location = 1e3 * c.move.end

    def _clear(self) -> None:
        for source in (self.gains, self.loci, self.step, self.move, *self.poles.values()):
            source.data = {name: [] for name in source.data}

    def frame(self, drawn: Drawn) -> None:
        """Let the frequency axis reach over the present design."""
        if drawn.curves is not None:
            self.hz.start, self.hz.end = float(drawn.curves.hz[0]), float(drawn.curves.hz[-1])

    def pin(self, pins: list[tuple[str, Drawn]]) -> None:
        """Draw the pinned designs beside the present one."""
        rows: dict[str, list[tuple[Any, Any, str, str]]] = {name: [] for name in self.pinned}
        for i, (name, drawn) in enumerate(pins):
            c, colour = drawn.curves, PIN_COLOURS[i % len(PIN_COLOURS)]
            if c is None:
                continue
            for k, (gain, _) in enumerate(GAINS):
                rows[gain].append((c.hz, c.gains[k], colour, name))
            for x, y in zip(*_lines(c.loci), strict=True):
                rows["nyquist"].append((x, y, colour, name))
            rows["step"].append((1e3 * c.step_time, c.step, colour, name))
            rows["move"].append((1e3 * c.move.time, 1e6 * c.move.error, colour, name))
        for name, source in self.pinned.items():
            keys = ("xs", "ys", "colour", "name")
            source.data = {key: [row[i] for row in rows[name]] for i, key in enumerate(keys)}


def _lines(loci: np.ndarray) -> tuple[list[Any], list[Any]]:
    return [line.real for line in loci.T], [line.imag for line in loci.T]


def _hover(line: Any, tips: list[tuple[str, str]]) -> HoverTool:
    return HoverTool(renderers=[line], mode="vline", tooltips=tips)
