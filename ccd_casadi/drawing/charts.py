"""Figures with axes as SVG: panels of curves, and the map over two parameters."""

import json
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ccd_casadi.drawing import svg
from ccd_casadi.drawing.content import Landscape, Panel
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
from ccd_casadi.support.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST_SPAN = 1e-4  # of a value: an axis of less shows digits that nobody reads
LEADER = {"arrowstyle": "-", "color": "#444444", "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": POINT}
BEHIND = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
LEFT, RIGHT, BOTTOM, TOP = 0.82, 0.2, 0.52, 0.22  # inches around the axes of a panel


def panel_html(panel: Panel, beside: int, height: float, key: str, title: str) -> str:
    """Draw a panel as inline SVG.

    Parameters
    ----------
    panel : Panel
    beside : int
        Panels in its row.
    height : float
        Inches.
    key : str
        Unique in the page.
    title : str
        Read out before the panel's own.

    Returns
    -------
    str
    """

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
    """Write the data by which the page's scripts read values off the drawn curves and enlarge a
    part."""
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
            _raise_top(axes, legend_height(names), panel.log_y)
            labels = _labels(axes, panel)
            where, _ = labels.corner(names)
        alone = len(names) == 1  # its name is enough
        bare = {"handlelength": 0.0, "handletextpad": 0.0, "frameon": False} if alone else {}
        made = axes.legend(loc=cast(Any, where), borderaxespad=0.2, **bare)
        for handle in made.legend_handles if alone else ():
            if handle is not None:
                handle.set_visible(False)
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


def _raise_top(axes: "Axes", strip: float, log: bool) -> None:
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


MAP_WIDTH = 8.4  # inches
RING, GROUND = "#fdfdfd", "#121212"  # of markers on a map: in both themes, unlike the page's own


def figure_landscape(land: Landscape, key: str) -> str:
    """Filled contours of ω_b*(θ) with true samples, paths and the optimum."""
    return svg.at_both_widths(lambda own, inches: _landscape(land, own, inches), key, MAP_WIDTH)


def _landscape(land: Landscape, key: str, width: float) -> str:
    from matplotlib.patches import Rectangle

    with svg.style():
        figure, low = svg.new_figure(5.4, width), 1.1 if width == MAP_WIDTH else 1.5
        axes = svg.place(figure, 0.75, low, width - 2.05, 5.25 - low)  # room for bar and legend
        axes.grid(False)
        axes.set_facecolor("#eeeeee")
        truths = land.truths.reshape(-1, 3)
        shown = land.bandwidth_hz if land.bandwidth_hz.size else truths[:, 2]
        filled, norm = _contours(axes, land.first, land.second, land.bandwidth_hz, shown)
        if land.outside.any():
            axes.contourf(land.first, land.second, land.outside.T.astype(float), levels=[0.5, 1.5],
                          colors=["white"], alpha=0.72).set_gid("area-outside")  # fmt: skip
        if land.forbidden is not None and land.forbidden.any():
            _shade(axes, land.first, land.second, land.forbidden.astype(float) - 0.5)
        if len(land.designs):
            axes.plot(*land.designs.T, ".", color=RING, markersize=5.0, markeredgecolor=GROUND,
                      markeredgewidth=0.6, label="sampled designs", linestyle="none",
                      gid="mark-designs")  # fmt: skip
        if len(truths):
            x, y, hz = truths[np.isfinite(truths[:, 2])].T
            # light and dark rings set the dots apart from any colour of the map
            axes.scatter(x, y, s=62, color=GROUND, zorder=2.9, clip_on=False, gid="mark-grounds")
            dots = axes.scatter(x, y, c=hz, cmap=svg.COLOUR_MAP, norm=norm, s=34, edgecolors=RING,
                                linewidths=1.1, label=land.truth_label, zorder=3, clip_on=False,
                                gid="mark-truths")  # fmt: skip
            filled = filled or dots
            lost = truths[~np.isfinite(truths[:, 2])]
            if len(lost):
                axes.plot(lost[:, 0], lost[:, 1], "x", color=svg.GREY, label="infeasible θ",
                          gid="mark-lost")  # fmt: skip
        if land.region is not None:
            a, b, c, d = land.region
            axes.add_patch(Rectangle((a, c), b - a, d - c, fill=False, edgecolor=svg.BLACK,
                                     linestyle=(0, (4, 3)), linewidth=0.8, clip_on=False,
                                     label="last trust region", gid="level-region"))  # fmt: skip
        for i, path in enumerate(land.paths):
            colour = path.colour or svg.CYCLE[(i + 1) % len(svg.CYCLE)]
            axes.plot(*path.theta.T, "-o", color=colour, linewidth=1.2, markersize=6, clip_on=False,
                      markerfacecolor="white", markeredgewidth=1.3, label=path.label, zorder=5,
                      gid=f"curve{i}")  # fmt: skip
        if land.optimum is not None:
            a, b = land.optimum
            axes.plot([a], [b], "*", color=svg.ORANGE, markersize=15, clip_on=False, zorder=7,
                      markeredgecolor=RING, markeredgewidth=0.9, linestyle="none",
                      label="verified optimum", gid="mark-optimum")  # fmt: skip
        axes.set_xlim(land.first[0], land.first[-1])
        axes.set_ylim(land.second[0], land.second[-1])
        axes.set_xlabel(svg.axis_label(land.names[0], land.units[0]))
        axes.set_ylabel(svg.axis_label(land.names[1], land.units[1]))
        which = "largest bandwidth ω_b*" if land.bandwidth_hz.size else "bandwidth ω_b"
        _colour_bar(figure, filled, svg.axis_label(which, "Hz"))
        _legend(figure, axes)
        title = "Landscape of the largest bandwidth over the two parameters"
        share = 100.0 if width == svg.NARROW else 100.0 * width / svg.WIDTH
        return svg.to_svg(figure, key, title, json.dumps({"scales": scales_of(axes)}), share)


def _contours(axes: "Axes", x: Array, y: Array, field: Array, shown: Array) -> tuple[Any, Any]:
    """Filled contours of a field (len(x), len(y)), if any, and the colours' norm."""
    from matplotlib.colors import BoundaryNorm
    from matplotlib.ticker import MaxNLocator

    known = shown[np.isfinite(shown)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    if high - low < 1e-9 * max(abs(high), 1.0):
        low, high = low - 0.5, high + 0.5
    levels = MaxNLocator(nbins=14).tick_values(low, high)
    norm = BoundaryNorm(levels, 256)
    if not field.size or not np.isfinite(field).any():
        return None, norm
    filled = axes.contourf(x, y, field.T, levels=levels, cmap=svg.COLOUR_MAP, norm=norm)
    filled.set_gid("area-field")
    lines = axes.contour(x, y, field.T, levels=levels, colors="white", linewidths=0.35)
    lines.set_gid("level-field")
    return filled, norm


def _shade(axes: "Axes", x: Array, y: Array, excess: Array) -> None:
    """Veil and hatch where the field is positive."""
    if np.nanmax(excess) <= 0.0:
        return
    veil = axes.contourf(x, y, excess.T, levels=[0.0, np.inf], colors=["white"], alpha=0.55,
                         hatches=["////"])  # fmt: skip
    veil.set_gid("area-forbidden")
    veil.set_edgecolor("#777777")
    veil.set_linewidth(0.0)
    axes.fill([], [], facecolor="white", edgecolor="#777777", hatch="////", linewidth=0.5,
              label="infeasible")  # fmt: skip


def _colour_bar(figure: "Figure", filled: Any, label: str) -> None:
    if filled is not None:
        width, height = figure.get_size_inches()
        low, tall = (height * v for v in figure.axes[0].get_position().bounds[1::2])
        beside = svg.place(figure, width - 1.15, low, 0.17, tall)
        bar = figure.colorbar(filled, cax=beside)
        bar.set_label(label)
        bar.outline.set_linewidth(0.5)
        bar.ax.grid(False)


def _legend(figure: "Figure", axes: "Axes") -> None:
    from matplotlib.collections import PathCollection

    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if figure.get_figwidth() == svg.NARROW else 3 if len(labels) > 4 else 4
    made = figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False)
    for handle in made.legend_handles:
        if isinstance(handle, PathCollection):  # its light ring is not seen on paper
            handle.set_edgecolor(GROUND)
