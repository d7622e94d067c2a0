"""The controls of the page: sliders, buttons, places and a notch that are dragged."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, CustomJS, CustomJSTickFormatter, PointDrawTool
from bokeh.models.widgets.buttons import Button
from bokeh.models.widgets.inputs import Checkbox, Select
from bokeh.models.widgets.sliders import RangeSlider, Slider
from bokeh.plotting import figure

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.cases.tables import Case
from ccd_casadi.drawing.svg import GREEN, ORANGE, PURPLE
from ccd_casadi.extensions.explorer import ASSETS
from ccd_casadi.extensions.explorer.knobs import Knobs, Notch, Notched, NotchOptions, judge_notched
from ccd_casadi.extensions.explorer.painter import ON_DARK, Change, PanelFigure
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.plants.nodes import Positions, names_in
from ccd_casadi.reporting.nyquist import loci_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import display_unit, package_text

MM = 1e3  # a metre


def moves(problem: CoDesignProblem) -> bool:
    """Whether θ moves forces or sensors in a plane, so that they can be dragged."""
    places = problem.source.places
    if places is None or len(places.nodes[0]) != 2:
        return False
    return not set(problem.names).isdisjoint(names_in((*places.actuators, *places.sensors)))


class PlacesFigure:
    """`moved` is called with the new θ when a place was dragged."""

    name = "places"

    def __init__(self, problem: CoDesignProblem, moved: Callable[[Array], None]) -> None:
        places, held = problem.source.places, problem.source.held
        assert places is not None
        self._moved, self._held = moved, np.array([*held.values()])
        self._free, known = len(problem.names), (*problem.names, *held)
        nodes = np.array(places.nodes)
        made: Any = figure(
            name=self.name, height=280, sizing_mode="stretch_width", tools="reset",
            match_aspect=True, x_axis_label="x (mm)", y_axis_label="y (mm)",
        )  # fmt: skip
        made.toolbar.logo = None
        made.scatter(**_columns(nodes), size=4, color="#808080")
        # One source: of several the browser would report one by one, as before the others' answer.
        self._points = Positions((*places.sensors, *places.actuators), known)
        a, b = len(places.sensors), len(places.actuators)
        self._styles = {"colour": [GREEN] * a + [ORANGE] * b, "marker": ["circle"] * a + ["x"] * b,
                       "size": [15] * a + [11] * b}  # fmt: skip
        self._source = ColumnDataSource({name: [] for name in ("x", "y", *self._styles)})
        self._source.on_change("data", self._heard)
        drawn = made.scatter("x", "y", source=self._source, size="size", marker="marker",
                             line_color="colour", line_width=3, fill_alpha=0.1)  # fmt: skip
        tool = PointDrawTool(renderers=[drawn], add=False)
        made.add_tools(tool)
        made.toolbar.active_tap = tool
        self.figure = made

    def marks(self, theta: Sequence[float]) -> Change:
        """Return the change that shows the places at θ."""
        self._shown = np.append(theta, self._held)
        return self._source, {"data": _columns(self._points.at(self._shown)) | self._styles}

    def _heard(self, attr: str, old: Any, new: Any) -> None:
        before, after = self._points.at(self._shown), np.transpose([new["x"], new["y"]]) / MM
        theta = self._shown[: self._free]
        if after.shape == before.shape:  # none was deleted
            off = after - before
            i = int(np.abs(off).sum(axis=1).argmax())
            theta = theta + np.linalg.pinv(self._points.slope[i][:, : self._free]) @ off[i]
        self._moved(theta)


def _columns(points: Array) -> dict[str, list[float]]:
    """Write points as lists: of an array that is a part of another the browser would send all of
    that back."""
    return {"x": (MM * points[:, 0]).tolist(), "y": (MM * points[:, 1]).tolist()}


STEPS = 1000  # of a slider of θ
WIDER = 10.0  # the ranges of ω_S and ω_T may be dragged so far beyond those of the case
# the theme is of figures only
DARK = """.bk-input, .bk-btn { background-color: #2b3238; color: #e0e0e0; border-color: #6b7680; }
.bk-btn:hover { background-color: #3a444c; }
.bk-btn[disabled] { background-color: #20262b; color: #9aa0a5; }"""
STRUCTURES: tuple[Any, ...] = (
    ("h_infinity", "mixed sensitivity"),
    ("h_infinity_disturbance", "mixed sensitivity with a disturbance"),
    ("sections", "fixed structure (sections)"),
)


class Controls:
    """Widgets for all that `Knobs` says. `changed` is called with whether one was let go, and
    whether it is one that a search answers: S_max and the ranges do nothing to one synthesis."""

    def __init__(self, case: Case, start: Knobs, changed: Any, dark: bool) -> None:
        units = [display_unit(p.unit, p.upper) for p in case.theta]
        self._scale = [factor for _, factor in units]
        self._start, self._theta = start, []
        self.quiet = False  # while they are set from here
        for p, (unit, k), value in zip(case.theta, units, start.theta, strict=True):
            self._theta.append(slider(
                f"theta_{p.name}", f"{p.name} ({unit})" if unit else p.name, k * p.lower,
                k * p.upper, k * (p.upper - p.lower) / STEPS, k * value, "0.000",
            ))  # fmt: skip
        high = max(3.0, 1.2 * start.S_max)
        self.S_max = slider("S_max", "S_max", 1.05, high, 0.005, start.S_max, "0.000")
        self.omega_S = _frequencies("omega_S", "ω_S (Hz), range searched", start.omega_S_hz)
        self.omega_T = _frequencies("omega_T", "ω_T (Hz), range searched", start.omega_T_hz)
        self.shift = slider("shift", "resonances known to ±", 0.0, 0.2, 0.005,
                             start.resonance_shift, "0.0%")  # fmt: skip
        self.sampled = Checkbox(name="sampled", label="as sampled: hold and delay",
                                active=start.sampled)  # fmt: skip
        self.rate = slider("rate", "rate (Hz)", 3.0, 5.0, 0.01, float(np.log10(start.rate_hz)),
                            power())  # fmt: skip
        self.delay = slider("delay", "delay (µs)", 0.0, max(1000.0, start.delay_us), 5.0,
                             start.delay_us, "0")  # fmt: skip
        self.structure = Select(name="structure", title="controller", value=start.structure,
                                options=[*STRUCTURES],
                                stylesheets=[DARK] if dark else [])  # fmt: skip
        self.always = Checkbox(name="always", label="full search while dragging", active=False)
        of_search = (self.S_max, self.omega_S, self.omega_T)
        for each in (*self._theta, *of_search, self.shift, self.rate, self.delay):
            self._heard(each, changed, each in of_search)
        for chosen, what in ((self.structure, "value"), (self.sampled, "active")):
            chosen.on_change(what, lambda attr, old, new: self._report(changed, True, True))
        self._hide()

    def _heard(self, moved: Any, changed: Any, search: bool) -> None:
        moved.on_change("value", lambda attr, old, new: self._report(changed, False, search))
        moved.on_change("value_throttled", lambda attr, old, new: self._report(changed, True, True))

    def _report(self, changed: Any, let_go: bool, search: bool) -> None:
        if let_go:
            self._hide()
        if not self.quiet:
            changed(let_go, search)

    def _hide(self) -> None:
        """Hide the widgets that have no effect on this kind of controller, or on a loop that is not
        sampled."""
        structured = self.structure.value == "sections"
        for widget in (self.omega_S, self.omega_T, self.always):
            widget.visible = not structured
        self.rate.visible = self.delay.visible = bool(self.sampled.active)

    def all(self) -> list[Any]:
        """The widgets, from top to bottom."""
        return [*self._theta, self.S_max, self.omega_S, self.omega_T, self.structure, self.shift,
                self.sampled, self.rate, self.delay, self.always]  # fmt: skip

    def knobs(self) -> Knobs:
        """Read the knobs from the widgets."""
        sliders = zip(self._theta, self._scale, strict=True)
        return Knobs(
            theta=tuple(float(np.clip(s.value, s.start, s.end)) / k for s, k in sliders),
            S_max=float(self.S_max.value),
            omega_S_hz=_hz(self.omega_S, self._start.omega_S_hz),
            omega_T_hz=_hz(self.omega_T, self._start.omega_T_hz),
            structure=self.structure.value,
            resonance_shift=float(self.shift.value),
            sampled=bool(self.sampled.active),
            rate_hz=_near(10.0 ** float(self.rate.value), self._start.rate_hz),
            delay_us=float(self.delay.value),
        )

    def put(self, knobs: Knobs) -> None:
        """Move the sliders, without an answer to each."""
        self.quiet = True
        try:
            for each, k, value in zip(self._theta, self._scale, knobs.theta, strict=True):
                each.value = k * value
            self.S_max.value, self.shift.value = knobs.S_max, knobs.resonance_shift
            self.omega_S.value = _logarithms(knobs.omega_S_hz)
            self.omega_T.value = _logarithms(knobs.omega_T_hz)
            self.structure.value, self.sampled.active = knobs.structure, knobs.sampled
            self.rate.value, self.delay.value = float(np.log10(knobs.rate_hz)), knobs.delay_us
            self._hide()
        finally:
            self.quiet = False


def slider(
    name: str, title: str, low: float, high: float, step: float, value: float, form: Any
) -> Slider:
    """One that shows its number in a format, and no tooltip."""
    return Slider(name=name, title=title, start=low, end=high, step=step, value=value, format=form,
                  tooltips=False)  # fmt: skip


def power() -> CustomJSTickFormatter:
    """Make the formatter by which a slider of a logarithm shows the number itself."""
    return CustomJSTickFormatter(code="return Number(Math.pow(10, tick).toPrecision(4)).toString()")


def _frequencies(name: str, title: str, hz: tuple[float, float]) -> RangeSlider:
    low, high = _logarithms(hz)
    reach = float(np.log10(WIDER))
    return RangeSlider(
        name=name, title=title, start=low - reach, end=high + reach, step=0.01, value=(low, high),
        format=power(), tooltips=False,
    )  # fmt: skip


def _hz(ends: RangeSlider, start: tuple[float, float]) -> tuple[float, float]:
    low, high = (10.0 ** float(v) for v in ends.value)
    low, high = _near(low, start[0]), _near(high, start[1])
    return low, max(high, 1.01 * low)


def _near(value: float, exact: float) -> float:
    """The case's own number where a logarithm and back is within rounding of it."""
    return exact if abs(value / exact - 1.0) < 1e-9 else value


def _logarithms(pair: tuple[float, float]) -> tuple[float, float]:
    return float(np.log10(pair[0])), float(np.log10(pair[1]))


def button(label: str, name: str, action: Callable[[], None], dark: bool) -> Button:
    """One of the page, 132 px wide; `name` is for tests."""
    made = Button(label=label, name=name, width=132, stylesheets=[DARK] if dark else [])
    made.on_click(action)
    return made


class NotchFigure:
    """A handle on |L| that is dragged, and a slider for each number of the notch.

    It lies on the curve while there is no notch. `moved` is called when the notch is another.
    """

    def __init__(
        self, loop: PanelFigure, dark: bool, moved: Callable[[], None],
        options: NotchOptions = NotchOptions(),
    ) -> None:  # fmt: skip
        least, first, most = (float(np.log10(value)) for value in options.damping)
        self._none, deepest = options.none, float(np.log10(options.deepest))
        self._hz = slider("notch_hz", "frequency (Hz)", 0.0, 4.0, 0.002, 2.0, power())
        self._depth = slider("notch_depth", "gain there", deepest, 0.0, 0.01, 0.0, power())
        self._damping = slider("notch_damping", "damping of its poles", least, most, 0.01, first,
                               power())  # fmt: skip
        self._handle = ColumnDataSource({"x": [], "y": []}, name="notch")
        self._placed = False
        colour = ON_DARK.get(PURPLE, PURPLE) if dark else PURPLE
        made = loop.figure
        made.scatter("x", "y", source=self._handle, marker="diamond", size=15, fill_color=colour,
                     fill_alpha=0.4, line_color=colour, line_width=2)  # fmt: skip
        made.toolbar.active_drag = None  # it is the notch that is dragged
        drag = CustomJS(
            args={"handle": self._handle, "own": loop.own, "hz": self._hz, "depth": self._depth,
                  "figure": made}, code=package_text(f"{ASSETS}/notch.js"),
        )  # fmt: skip
        for event in ("panstart", "pan", "panend"):
            made.js_on_event(event, drag)
        for each in self.sliders:
            each.on_change("value", lambda attr, old, new: moved())

    @property
    def sliders(self) -> tuple[Slider, ...]:
        """The sliders of frequency, gain and damping."""
        return self._hz, self._depth, self._damping

    def root(self) -> Any:
        """The sliders, to be placed on the page."""
        return column(*self.sliders, sizing_mode="stretch_width")

    def of(self, view: LoopView) -> Notched | None:
        """The loop with the notch as it stands; None while there is none."""
        if not self._placed:  # where a notch is wanted first
            self._placed = True
            low, high = np.log10(view.ends)
            top = max(view.peaks, key=lambda peak: peak[1], default=(view.bandwidth_hz, 0.0))[0]
            self._hz.update(start=float(low), end=float(high), value=float(np.log10(top)))
        notch = Notch(*(10.0 ** float(each.value) for each in self.sliders))
        return None if notch.depth > self._none else judge_notched(view, notch)

    def mark(self, view: LoopView | None) -> Change:
        """Return the change that shows the handle, on |L| of the notched loop."""
        if view is None:
            return self._handle, {"data": {"x": [], "y": []}}
        hz, depth = (10.0 ** float(each.value) for each in self.sliders[:2])
        L = np.abs(loci_of(view.open[0], np.inf)).max(axis=1)
        at = float(np.exp(np.interp(np.log(hz), np.log(view.hz), np.log(L))))
        return self._handle, {"data": {"x": [hz], "y": [depth * at]}}
