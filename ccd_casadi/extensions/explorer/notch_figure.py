"""The notch on the page: a handle on |L| that is dragged, and a slider for each of its numbers."""

from collections.abc import Callable
from typing import Any

import numpy as np
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, CustomJS
from bokeh.models.widgets.sliders import Slider

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.drawing.svg import PURPLE
from ccd_casadi.extensions.explorer import ASSETS
from ccd_casadi.extensions.explorer.controls import power, slider
from ccd_casadi.extensions.explorer.notch import Notch, Notched, NotchOptions, notched
from ccd_casadi.extensions.explorer.painter import ON_DARK, Change, PanelFigure
from ccd_casadi.reporting.nyquist import loci_of
from ccd_casadi.support.text import package_text


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
        """Of frequency, gain and damping."""
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
        return None if notch.depth > self._none else notched(view, notch)

    def mark(self, view: LoopView | None) -> Change:
        """What shows the handle, on |L| of the notched loop."""
        if view is None:
            return self._handle, {"data": {"x": [], "y": []}}
        hz, depth = (10.0 ** float(each.value) for each in self.sliders[:2])
        L = np.abs(loci_of(view.open[0], np.inf)).max(axis=1)
        at = float(np.exp(np.interp(np.log(hz), np.log(view.hz), np.log(L))))
        return self._handle, {"data": {"x": [hz], "y": [depth * at]}}
