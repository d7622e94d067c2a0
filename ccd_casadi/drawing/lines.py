"""Line figures: panels of curves with bands, reference lines and marked points."""

import json
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ccd_casadi.drawing.content import Panel
from ccd_casadi.drawing.labels import (
    POINT,
    SIZE,
    Labels,
    Put,
    in_points,
    inside,
    legend_height,
    scales_of,
)
from ccd_casadi.drawing.svg import WIDTH, at_both_widths, log_axis, new_figure, place, style, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST_SPAN = 1e-4  # of a value: an axis of less shows digits that nobody reads
LEADER = {"arrowstyle": "-", "color": "#444444", "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": POINT}
BEHIND = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
LEFT, RIGHT, BOTTOM, TOP = 0.82, 0.2, 0.52, 0.22  # inches around the axes of a panel


def panel_html(panel: Panel, beside: int, height: float, key: str, title: str) -> str:
    """A panel of a row of `beside` ones as a picture, height in inches; `key` is unique in the
    page."""

    def picture(own: str, inches: float) -> str:
        with style():
            figure, axes = drawn_axes(panel, inches, height)
            words = f"{title}: {panel.title or panel.y_label}"
            return to_svg(figure, own, words, _for_cursor(axes, panel, height), 100.0)

    return picture(key, WIDTH / beside) if beside > 1 else at_both_widths(picture, key, WIDTH)


def drawn_axes(panel: Panel, width: float, height: float) -> tuple["Figure", "Axes"]:
    """A panel in a figure of its own, size in inches."""
    figure = new_figure(height, width)
    axes = place(figure, LEFT, BOTTOM, width - LEFT - RIGHT, height - BOTTOM - TOP)
    _draw(axes, panel)
    return figure, axes


def _for_cursor(axes: "Axes", panel: Panel, height: float) -> str:
    """What the page's scripts need to read values off the drawn curves and to enlarge a part."""
    names = {i: curve.label for i, curve in enumerate(panel.curves) if curve.readable}
    scales = scales_of(axes, panel.log_x, panel.log_y)
    found = {"x": panel.x_label, "y": panel.y_label, "scales": scales, "names": names}
    found |= {"locus": points} if (points := _locus(axes, panel, 72.0 * height)) else {}
    return json.dumps(found, separators=(",", ":"), ensure_ascii=False)


def _locus(axes: "Axes", panel: Panel, tall: float) -> list[list[float]]:
    """Points (pt, pt, Hz) of the loci over frequency, as far as they are shown and lie apart."""
    left, low, right, high = inside(axes)
    found: list[list[float]] = []
    for curve in panel.curves:
        if curve.hz is None:
            continue
        for (x, y), hz in zip(in_points(axes, curve.x, curve.y), curve.hz, strict=True):
            shown = left <= x <= right and low <= y <= high
            if shown and not (found and abs(x - found[-1][0]) + abs(tall - y - found[-1][1]) < 1.0):
                found.append([round(x, 1), round(tall - y, 1), float(f"{hz:.4g}")])
    return found


def _draw(axes: "Axes", panel: Panel) -> None:
    for i, band in enumerate(panel.bands):
        axes.fill_between(
            band.x, band.low, band.high, color=band.colour, alpha=0.4, linewidth=0.6,
            label=band.label or None, gid=f"band{i}",
        )  # fmt: skip
    for i, area in enumerate(panel.forbidden):
        axes.fill(area.x, area.y, color=area.colour, alpha=0.2, linewidth=0.0, gid=f"area{i}")
    top = np.inf if panel.y_range is None else panel.y_range[1]
    for i, curve in enumerate(panel.curves):
        axes.plot(
            curve.x, curve.y, color=curve.colour, linestyle=curve.line or "none",
            marker=curve.marker or None, linewidth=curve.width, label=curve.label or None,
            markerfacecolor="white" if curve.line else curve.colour,
            clip_on=not curve.marker or bool(np.nanmax(curve.y, initial=0.0) > top),
            gid=f"curve{i}",
        )  # fmt: skip
    for i, mark in enumerate(panel.marks):
        axes.plot(
            [mark.x], [mark.y], mark.marker, color=mark.colour, markersize=5.0, zorder=5,
            gid=f"mark{i}",
        )  # fmt: skip
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.title:
        axes.set_title(panel.title, loc="left")
    _ranges(axes, panel)
    for i, level in enumerate(panel.levels):
        line = axes.axvline if level.vertical else axes.axhline
        line(level.value, color=level.colour, linewidth=0.8, linestyle=(0, (4, 3)), gid=f"level{i}")
    labels = _labels(axes, panel)
    if panel.legend is not None and (names := axes.get_legend_handles_labels()[1]):
        where, covered = labels.corner(names)
        if covered and panel.y_range is None:  # a strip above the curves is the legend's
            _raised(axes, legend_height(names), panel.log_y)
            labels = _labels(axes, panel)
            where, _ = labels.corner(names)
        axes.legend(loc=cast(Any, where), borderaxespad=0.2)
    for put in labels.words():
        _write(axes, put)


def _write(axes: "Axes", put: Put) -> None:
    """Words, with the point or the line that they belong to in pt of the picture for its script."""
    tall = 72.0 * axes.figure.bbox.height / axes.figure.dpi
    a, b = in_points(axes, put.x, put.y)[0]
    ends = (f"{v:.1f}" if held else "" for v, held in zip((a, tall - b), put.held, strict=True))
    at = f"at:{','.join(ends)}"
    made = axes.annotate(
        put.text, (put.x, put.y), xytext=(put.dx, put.dy), textcoords="offset points",
        fontsize=SIZE, annotation_clip=False, zorder=6, gid=at, ha=put.across, va=put.up,
        rotation=90 * put.upright, bbox=BEHIND if all(put.held) else None,
        arrowprops=LEADER if put.far else None,
    )  # fmt: skip
    if made.arrow_patch is not None:
        made.arrow_patch.set_gid(f"leader-{at}")


def _raised(axes: "Axes", strip: float, log: bool) -> None:
    """Moves the top of the axes up by a strip, in pt of their height."""
    _, bottom, _, top = inside(axes)
    low, high = np.log(axes.get_ylim()) if log else np.array(axes.get_ylim())
    high = low + (high - low) / (1.0 - min(strip / (top - bottom), 0.5))
    axes.set_ylim(*(np.exp([low, high]) if log else (low, high)))


def _labels(axes: "Axes", panel: Panel) -> Labels:
    ranges = axes.get_xlim(), axes.get_ylim()  # where they follow the data: settled now
    return Labels(panel, inside(axes), partial(in_points, axes), ranges)


def _ranges(axes: "Axes", panel: Panel) -> None:
    from matplotlib.ticker import MultipleLocator

    if panel.log_x:
        log_axis(axes.xaxis, *(panel.x_range or positive_range(c.x for c in panel.curves)))
    elif panel.x_range:
        axes.set_xlim(*panel.x_range)
    if panel.log_y:
        log_axis(axes.yaxis, *(panel.y_range or positive_range(c.y for c in panel.curves)))
    elif panel.y_range:
        axes.set_ylim(*panel.y_range)
    if panel.y_step:
        axes.yaxis.set_major_locator(MultipleLocator(panel.y_step))
    for name, log in (("x", panel.log_x), ("y", panel.log_y)):
        low, high = getattr(axes, f"get_{name}lim")()
        if not log and high - low < LEAST_SPAN * abs(low):  # one value, rounded
            getattr(axes, f"set_{name}lim")(0.99 * low, 1.01 * high)
    if not panel.log_y:
        axes.ticklabel_format(axis="y", useOffset=False)
    if panel.equal:
        axes.set_aspect("equal")
        axes.apply_aspect()


def positive_range(arrays: Iterable[Any]) -> tuple[float, float]:
    """Find a range for a logarithmic axis around all positive finite values, a little wider.

    Parameters
    ----------
    arrays : iterable of arrays

    Returns
    -------
    low, high : float
    """
    values = np.concatenate([np.ravel(np.asarray(a, float)) for a in arrays])
    values = values[np.isfinite(values) & (values > 0.0)]
    if not values.size:
        return 0.1, 10.0
    low, high = float(values.min()), float(values.max())
    margin = max((high / low) ** 0.06, 1.1)
    return low / margin, high * margin
