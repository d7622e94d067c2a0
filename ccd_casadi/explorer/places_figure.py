"""Forces and sensors between the nodes of the plant: one that is dragged moves the θ it names."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, PointDrawTool
from bokeh.plotting import figure

from ccd_casadi.drawing.svg import GREEN, ORANGE
from ccd_casadi.explorer.message import Change
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.plants.nodes import Positions, names_in
from ccd_casadi.support.arrays import Array

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
