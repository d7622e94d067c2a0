"""The map over two parameters: the landscape of ω_b*(θ)."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.drawing import svg
from ccd_casadi.drawing.content import Landscape
from ccd_casadi.drawing.labels import scales_of
from ccd_casadi.support.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
            # light and dark rings tell the dots from any colour of the map
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
