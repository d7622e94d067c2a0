"""Line figures from plain data: panels of curves with bands, reference lines and marked points."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ccd_casadi.reporting.svg import (
    BLACK,
    BLUE,
    GREY,
    WIDTH,
    log_axis,
    new_figure,
    place,
    style,
    to_svg,
)
from ccd_casadi.support.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Corner = Literal["best", "lower left", "lower right", "upper left", "upper right"]

_BEHIND = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
LEFT, RIGHT, BOTTOM, TOP = 0.82, 0.12, 0.52, 0.22  # inches around the axes of a panel


@dataclass(frozen=True)
class Curve:
    """y over x; `line` and `marker` as in matplotlib, either may be empty."""

    x: Array
    y: Array
    label: str = ""
    colour: str = BLUE
    line: str = "-"
    marker: str = ""
    width: float = 1.3


@dataclass(frozen=True)
class Band:
    """The area between low and high over x."""

    x: Array
    low: Array
    high: Array
    label: str = ""
    colour: str = BLUE


@dataclass(frozen=True)
class Mark:
    """A marked point and its words, beside it in points (dx, dy)."""

    x: float
    y: float
    text: str = ""
    marker: str = "o"
    colour: str = BLACK
    offset: tuple[float, float] = (0.0, 7.0)


@dataclass(frozen=True)
class Level:
    """A thin line across the panel at `value`, with its words at the end."""

    value: float
    text: str
    vertical: bool = False
    colour: str = GREY


@dataclass(frozen=True)
class Panel:
    """One pair of axes. Labels carry the unit; ranges default to the data."""

    x_label: str
    y_label: str
    curves: tuple[Curve, ...] = ()
    bands: tuple[Band, ...] = ()
    marks: tuple[Mark, ...] = ()
    levels: tuple[Level, ...] = ()
    log_x: bool = False
    log_y: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    whole_x: bool = False
    y_step: float | None = None
    legend: Corner = "best"
    title: str = ""


def figure_lines(
    rows: Sequence[Sequence[Panel | None]],
    *,
    key: str,
    title: str,
    heights: Sequence[float] | None = None,
) -> str:
    """Rows of panels as SVG, each row as wide as the figure, None an empty place; inches."""
    tall = list(heights) if heights is not None else [2.9] * len(rows)
    with style():
        figure = new_figure(sum(tall))
        bottom = sum(tall)
        for row, height in zip(rows, tall, strict=True):
            bottom -= height
            width = WIDTH / len(row)
            for j, panel in enumerate(row):
                if panel is not None:
                    left = j * width + LEFT
                    inside = (width - LEFT - RIGHT, height - BOTTOM - TOP)
                    _draw(place(figure, left, bottom + BOTTOM, *inside), panel)
        return to_svg(figure, key, title)


def _draw(axes: "Axes", panel: Panel) -> None:
    for band in panel.bands:
        axes.fill_between(
            band.x, band.low, band.high, color=band.colour, alpha=0.18, linewidth=0.0,
            label=band.label or None,
        )  # fmt: skip
    for curve in panel.curves:
        axes.plot(
            curve.x, curve.y, color=curve.colour, linestyle=curve.line or "none",
            marker=curve.marker or None, linewidth=curve.width, label=curve.label or None,
            markerfacecolor="white" if curve.line else curve.colour, clip_on=not curve.marker,
        )  # fmt: skip
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.title:
        axes.set_title(panel.title, loc="left")
    _ranges(axes, panel)
    for level in panel.levels:
        _level(axes, level)
    for mark in panel.marks:
        axes.plot(
            [mark.x], [mark.y], mark.marker, color=mark.colour, markersize=5.0, zorder=5,
        )  # fmt: skip
        side = "center" if mark.offset[0] == 0 else ("left" if mark.offset[0] > 0 else "right")
        axes.annotate(
            mark.text, (mark.x, mark.y), xytext=mark.offset, textcoords="offset points",
            ha=side, va="bottom" if mark.offset[1] >= 0 else "top", fontsize=9,
            annotation_clip=True, zorder=6, bbox=_BEHIND,
        )  # fmt: skip
    if any(curve.label for curve in panel.curves) or any(band.label for band in panel.bands):
        axes.legend(loc=panel.legend)


def _ranges(axes: "Axes", panel: Panel) -> None:
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    if panel.log_x:
        log_axis(axes.xaxis, *(panel.x_range or positive_range(c.x for c in panel.curves)))
    elif panel.x_range:
        axes.set_xlim(*panel.x_range)
    if panel.whole_x:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if panel.log_y:
        log_axis(axes.yaxis, *(panel.y_range or positive_range(c.y for c in panel.curves)))
    elif panel.y_range:
        axes.set_ylim(*panel.y_range)
    if panel.y_step:
        axes.yaxis.set_major_locator(MultipleLocator(panel.y_step))
    if not panel.log_y:
        axes.ticklabel_format(axis="y", useOffset=False)


def _level(axes: "Axes", level: Level) -> None:
    if level.vertical:
        axes.axvline(level.value, color=level.colour, linewidth=0.8, linestyle=(0, (4, 3)))
        transform = axes.get_xaxis_transform()
        axes.annotate(
            level.text, (level.value, 0.02), xycoords=transform, xytext=(3, 0),
            textcoords="offset points", fontsize=9, rotation=90, va="bottom", ha="left",
        )  # fmt: skip
        return
    axes.axhline(level.value, color=level.colour, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.annotate(
        level.text, (0.006, level.value), xycoords=axes.get_yaxis_transform(), xytext=(0, 2),
        textcoords="offset points", fontsize=9, va="bottom", ha="left",
    )  # fmt: skip


def positive_range(arrays: Iterable[Any]) -> tuple[float, float]:
    """A range for a logarithmic axis around all positive finite values, a little wider."""
    values = np.concatenate([np.ravel(np.asarray(a, float)) for a in arrays])
    values = values[np.isfinite(values) & (values > 0.0)]
    if not values.size:
        return 0.1, 10.0
    low, high = float(values.min()), float(values.max())
    margin = max((high / low) ** 0.06, 1.1)
    return low / margin, high * margin
