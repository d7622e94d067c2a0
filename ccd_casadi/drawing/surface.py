"""A machine by the sharp edges of its surface, from above and from the side, at one scale."""

from collections.abc import Mapping

import numpy as np

from ccd_casadi.drawing.content import Curve, Figure, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLACK, short_label
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number

SHARP = np.cos(np.radians(30.0))  # of the angle between two faces: a flatter edge is not drawn
ROOM = 0.04  # of what is drawn, around it
HEIGHTS = (4.0, 1.9)  # inches


def sharp_edges(points: Array, faces: np.ndarray) -> Array:
    """(k, 2, 3) ends of the edges at which two faces meet at 30° or more, or that one face has.

    Points (n, 3), faces (q, 4) of their numbers; a triangle names its last corner twice.

    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> len(sharp_edges(square, np.array([[0, 1, 2, 2], [0, 2, 3, 3]])))  # not the diagonal
    4
    """
    corner = points[faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    face = np.repeat(np.arange(len(faces)), 4)[ends[:, 0] != ends[:, 1]]
    edges, edge, count = np.unique(
        ends[ends[:, 0] != ends[:, 1]], axis=0, return_inverse=True, return_counts=True
    )
    by_edge = face[np.argsort(edge.ravel(), kind="stable")]
    last = np.cumsum(count) - 1
    one, other = normal[by_edge[last - count + 1]], normal[by_edge[last]]
    sharp = (count < 2) | ((one * other).sum(axis=1) < SHARP)
    return points[edges[sharp]]


def surface_figure(surfaces: Mapping[str, Array], faces: np.ndarray, masses: list[float]) -> Figure:
    """Machines by name, points (n, 3) in m of the same faces, and their masses in kg in a table."""
    mm = [1e3 * points for points in surfaces.values()]
    low, high = (f([f(points, axis=0) for points in mm], axis=0) for f in (np.min, np.max))
    margin = ROOM * float((high - low).max())
    ends = [(float(a) - margin, float(b) + margin) for a, b in zip(low, high, strict=True)]
    drawn = [sharp_edges(points, faces) for points in mm]

    def view(edges: Array, name: str, up: int) -> Panel:
        broken = np.concatenate([edges, np.full((len(edges), 1, 3), np.nan)], axis=1).reshape(-1, 3)
        curve = Curve(broken[:, 0], broken[:, up], "", BLACK, width=0.7)
        return Panel("x (mm)", f"{'xyz'[up]} (mm)", (curve,), x_range=ends[0], y_range=ends[up],
                     title=short_label(name), equal=True)  # fmt: skip

    rows = tuple(
        tuple(view(edges, name, up) for edges, name in zip(drawn, surfaces, strict=True))
        for up in (1, 2)
    )
    sizes = [np.ptp(points, axis=0).tolist() for points in mm]
    table = Table.of(("design", "x (mm)", "y (mm)", "z (mm)", "mass (kg)"), surfaces,
                     *zip(*sizes, strict=True), masses)  # fmt: skip
    weights = ", ".join(f"{n} {number(kg, 4)} kg" for n, kg in zip(surfaces, masses, strict=True))
    words = f"The edges of its surface, from above and from the side, at one scale: {weights}."
    return Figure(Lines(rows, " and ".join(surfaces), HEIGHTS), words, (table,))
