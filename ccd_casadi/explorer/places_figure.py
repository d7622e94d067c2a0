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
SAME = 1e-9  # m


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
        self._groups, drawn = [], []
        looks = ((places.sensors, GREEN, "circle", 15), (places.actuators, ORANGE, "x", 11))
        for points, colour, marker, size in looks:
            if not points:
                continue
            group, source = Positions(points, known), ColumnDataSource(_columns(nodes[:0]))
            drawn.append(made.scatter("x", "y", source=source, size=size, marker=marker,
                                      line_color=colour, line_width=3, fill_alpha=0.1))  # fmt: skip
            source.on_change("data", self._heard(group))
            self._groups.append((group, source))
        tool = PointDrawTool(renderers=drawn, add=False)
        made.add_tools(tool)
        made.toolbar.active_tap = tool
        self.figure = made

    def marks(self, theta: Sequence[float]) -> list[Change]:
        """What shows them at θ."""
        self._shown = np.append(theta, self._held)
        groups = self._groups
        return [(source, {"data": _columns(group.at(self._shown))}) for group, source in groups]

    def _heard(self, group: Positions) -> Callable[[str, Any, Any], None]:
        def changed(attr: str, old: Any, new: Any) -> None:
            before, after = group.at(self._shown), np.transpose([new["x"], new["y"]]) / MM
            theta = self._shown[: self._free]
            if after.shape == before.shape:  # none was deleted
                off = after - before
                i = int(np.abs(off).sum(axis=1).argmax())
                if np.abs(off[i]).max() < SAME:  # all are told of when one was dragged
                    return
                theta = theta + np.linalg.pinv(group.slope[i][:, : self._free]) @ off[i]
            self._moved(theta)

        return changed


def _columns(points: Array) -> dict[str, list[float]]:
    """As lists: of an array that is a part of another the browser would send all of that back."""
    return {"x": (MM * points[:, 0]).tolist(), "y": (MM * points[:, 1]).tolist()}
