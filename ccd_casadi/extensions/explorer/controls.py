"""The controls of the page: sliders, places that are dragged, and the map over two parameters."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.layouts import column, row
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    CustomJSTickFormatter,
    LinearColorMapper,
    NumeralTickFormatter,
    PointDrawTool,
    Range1d,
)
from bokeh.models.widgets.buttons import Button
from bokeh.models.widgets.inputs import Checkbox, Select
from bokeh.models.widgets.markups import Div
from bokeh.models.widgets.sliders import RangeSlider, Slider
from bokeh.plotting import figure

from ccd_casadi.cases.tables import Case, Parameter
from ccd_casadi.drawing.charts import GROUND, RING
from ccd_casadi.drawing.content import Landscape
from ccd_casadi.drawing.paint import escape
from ccd_casadi.drawing.svg import GREEN, ORANGE
from ccd_casadi.extensions.explorer.knobs import Knobs
from ccd_casadi.extensions.explorer.painter import FEW, Change
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.plants.nodes import Positions, names_in
from ccd_casadi.reporting.landscape import bandwidth_process, landscape_data, read_truths
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import display_unit
from surrogates import GaussianProcess, SurrogateFileError, load

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
        # One source: of several the browser would tell one by one, as before the others' answer.
        self._points = Positions((*places.sensors, *places.actuators), known)
        a, b = len(places.sensors), len(places.actuators)
        self._looks = {"colour": [GREEN] * a + [ORANGE] * b, "marker": ["circle"] * a + ["x"] * b,
                       "size": [15] * a + [11] * b}  # fmt: skip
        self._source = ColumnDataSource({name: [] for name in ("x", "y", *self._looks)})
        self._source.on_change("data", self._heard)
        drawn = made.scatter("x", "y", source=self._source, size="size", marker="marker",
                             line_color="colour", line_width=3, fill_alpha=0.1)  # fmt: skip
        tool = PointDrawTool(renderers=[drawn], add=False)
        made.add_tools(tool)
        made.toolbar.active_tap = tool
        self.figure = made

    def marks(self, theta: Sequence[float]) -> Change:
        """What shows them at θ."""
        self._shown = np.append(theta, self._held)
        return self._source, {"data": _columns(self._points.at(self._shown)) | self._looks}

    def _heard(self, attr: str, old: Any, new: Any) -> None:
        before, after = self._points.at(self._shown), np.transpose([new["x"], new["y"]]) / MM
        theta = self._shown[: self._free]
        if after.shape == before.shape:  # none was deleted
            off = after - before
            i = int(np.abs(off).sum(axis=1).argmax())
            theta = theta + np.linalg.pinv(self._points.slope[i][:, : self._free]) @ off[i]
        self._moved(theta)


def _columns(points: Array) -> dict[str, list[float]]:
    """As lists: of an array that is a part of another the browser would send all of that back."""
    return {"x": (MM * points[:, 0]).tolist(), "y": (MM * points[:, 1]).tolist()}


STEPS = 1000  # of a slider of θ
WIDER = 10.0  # the ranges of ω_S and ω_T may be dragged so far beyond those of the case
DARK = ".bk-input { background-color: #2b3238; color: #e0e0e0; }"  # the theme is of figures only
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
            self._theta.append(_slider(
                f"theta_{p.name}", f"{p.name} ({unit})" if unit else p.name, k * p.lower,
                k * p.upper, k * (p.upper - p.lower) / STEPS, k * value, "0.000",
            ))  # fmt: skip
        high = max(3.0, 1.2 * start.S_max)
        self.S_max = _slider("S_max", "S_max", 1.05, high, 0.005, start.S_max, "0.000")
        self.omega_S = _frequencies("omega_S", "ω_S (Hz), range searched", start.omega_S_hz)
        self.omega_T = _frequencies("omega_T", "ω_T (Hz), range searched", start.omega_T_hz)
        self.shift = _slider("shift", "resonances known to ±", 0.0, 0.2, 0.005,
                             start.resonance_shift, "0.0%")  # fmt: skip
        self.sampled = Checkbox(name="sampled", label="as sampled: hold and delay",
                                active=start.sampled)  # fmt: skip
        self.rate = _slider("rate", "rate (Hz)", 3.0, 5.0, 0.01, float(np.log10(start.rate_hz)),
                            _power())  # fmt: skip
        self.delay = _slider("delay", "delay (µs)", 0.0, max(1000.0, start.delay_us), 5.0,
                             start.delay_us, "0")  # fmt: skip
        self.structure = Select(name="structure", title="controller", value=start.structure,
                                options=[*STRUCTURES],
                                stylesheets=[DARK] if dark else [])  # fmt: skip
        self.always = Checkbox(name="always", label="full search while dragging", active=False)
        of_search = (self.S_max, self.omega_S, self.omega_T)
        for slider in (*self._theta, *of_search, self.shift, self.rate, self.delay):
            self._heard(slider, changed, slider in of_search)
        for chosen, what in ((self.structure, "value"), (self.sampled, "active")):
            chosen.on_change(what, lambda attr, old, new: self._tell(changed, True, True))
        self._hide()

    def _heard(self, slider: Any, changed: Any, search: bool) -> None:
        slider.on_change("value", lambda attr, old, new: self._tell(changed, False, search))
        slider.on_change("value_throttled", lambda attr, old, new: self._tell(changed, True, True))

    def _tell(self, changed: Any, let_go: bool, search: bool) -> None:
        if let_go:
            self._hide()
        if not self.quiet:
            changed(let_go, search)

    def _hide(self) -> None:
        """What does nothing to this kind of controller, or to a loop that is not sampled."""
        structured = self.structure.value == "sections"
        for widget in (self.omega_S, self.omega_T, self.always):
            widget.visible = not structured
        self.rate.visible = self.delay.visible = bool(self.sampled.active)

    def all(self) -> list[Any]:
        """The widgets, from top to bottom."""
        return [*self._theta, self.S_max, self.omega_S, self.omega_T, self.structure, self.shift,
                self.sampled, self.rate, self.delay, self.always]  # fmt: skip

    def knobs(self) -> Knobs:
        """What they say."""
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
            for slider, k, value in zip(self._theta, self._scale, knobs.theta, strict=True):
                slider.value = k * value
            self.S_max.value, self.shift.value = knobs.S_max, knobs.resonance_shift
            self.omega_S.value = _logarithms(knobs.omega_S_hz)
            self.omega_T.value = _logarithms(knobs.omega_T_hz)
            self.structure.value, self.sampled.active = knobs.structure, knobs.sampled
            self.rate.value, self.delay.value = float(np.log10(knobs.rate_hz)), knobs.delay_us
            self._hide()
        finally:
            self.quiet = False


def _slider(
    name: str, title: str, low: float, high: float, step: float, value: float, form: Any
) -> Slider:
    return Slider(name=name, title=title, start=low, end=high, step=step, value=value, format=form,
                  tooltips=False)  # fmt: skip


def _power() -> CustomJSTickFormatter:
    """A slider of a logarithm shows the number itself."""
    return CustomJSTickFormatter(code="return Number(Math.pow(10, tick).toPrecision(4)).toString()")


def _frequencies(name: str, title: str, hz: tuple[float, float]) -> RangeSlider:
    low, high = _logarithms(hz)
    reach = float(np.log10(WIDER))
    return RangeSlider(
        name=name, title=title, start=low - reach, end=high + reach, step=0.01, value=(low, high),
        format=_power(), tooltips=False,
    )  # fmt: skip


def _hz(slider: RangeSlider, start: tuple[float, float]) -> tuple[float, float]:
    low, high = (10.0 ** float(v) for v in slider.value)
    low, high = _near(low, start[0]), _near(high, start[1])
    return low, max(high, 1.01 * low)


def _near(value: float, exact: float) -> float:
    """The case's own number where a logarithm and back is within rounding of it."""
    return exact if abs(value / exact - 1.0) < 1e-9 else value


def _logarithms(pair: tuple[float, float]) -> tuple[float, float]:
    return float(np.log10(pair[0])), float(np.log10(pair[1]))


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


def button(label: str, name: str, action: Callable[[], None]) -> Button:
    """One of the page, 132 px wide; `name` is for tests."""
    made = Button(label=label, name=name, width=132)
    made.on_click(action)
    return made
