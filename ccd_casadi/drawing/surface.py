"""A machine by its surface: sharp edges from above and the side, and moved shapes that turn."""

import json
from collections.abc import Mapping
from functools import cache

import numpy as np

from ccd_casadi.drawing.content import Curve, Figure, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLACK, COLOUR_MAP, ModeShape, ModeShapes, short_label
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import number, template

AZIMUTH, ELEVATION = -62.0, 44.0  # degrees, of the camera as seen from the object
WIDTH, HEIGHT = 320, 236  # of one picture, in its own units
MARGIN = 6.0
REACH = 0.08  # the largest displacement is drawn as this share of the object's width
UNITS = 3000  # coordinates are written as so many parts of the largest side
SHARES = 999  # displacements are written as so many parts of the largest
LIGHT = (-0.45, 0.75, 0.9)  # right, up, towards the viewer: it stays with the camera
SHADE = (0.66, 0.34)  # brightness of a quad: first + second · cosine to the light
STOPS = 17  # of the colour map, linear in between


def camera(points: Array, azimuth: float, elevation: float) -> Array:
    """(n, 3): right, up and towards the viewer, in the unit of the points; angles in degrees.

    >>> camera(np.array([[0.0, 0.0, 1.0]]), 30.0, 90.0).round(12).tolist()
    [[0.0, 0.0, 1.0]]
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    right = [-np.sin(a), np.cos(a), 0.0]
    up = [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]
    towards = [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]
    return points @ np.array([right, up, towards]).T


def box_scale(size: Array, reach: float, elevation: float) -> float:
    """Picture units per unit of length: a box of this size, moved by `reach`, fits at any azimuth.

    Depends on the elevation alone, so that turning about z keeps the size.
    """
    e = np.radians(elevation)
    across = float(np.hypot(size[0], size[1]))
    tall = across * abs(np.sin(e)) + (size[2] + 2.0 * reach) * abs(np.cos(e))
    return float(min((WIDTH - 2 * MARGIN) / across, (HEIGHT - 2 * MARGIN) / tall))


@cache
def colour_stops() -> Array:
    """(STOPS, 3) red, green and blue from 0 to 255 of the reports' colour map."""
    import matplotlib

    table = matplotlib.colormaps[COLOUR_MAP](np.linspace(0.0, 1.0, STOPS))[:, :3]
    return np.rint(255.0 * table)


def colours(shares: Array) -> Array:
    """(n, 3) colours from 0 to 255 of shares between 0 and 1."""
    at = np.linspace(0.0, 1.0, STOPS)
    return np.stack([np.interp(shares, at, channel) for channel in colour_stops().T], axis=1)


def still(shapes: ModeShapes, mode: ModeShape, words: str) -> str:
    """The mode as an <svg> element for inline use, far faces first; `words` are read out."""
    moves = np.linalg.norm(mode.displacement, axis=1)
    size, largest = np.ptp(shapes.points, axis=0), max(float(moves.max()), 1e-300)
    points = shapes.points + REACH * float(size[0]) / largest * mode.displacement
    seen = camera(points - middle_of(shapes), AZIMUTH, ELEVATION)
    scale = box_scale(size, REACH * float(size[0]), ELEVATION)
    corner = seen[shapes.faces]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    bright = normal @ light / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    shade = SHADE[0] + SHADE[1] * np.clip(bright, 0.0, 1.0)
    rgb = np.rint(colours(moves[shapes.faces].mean(axis=1) / largest) * shade[:, None]).astype(int)
    front = np.flatnonzero(normal[:, 2] > 0.0)
    order = front[np.argsort(corner[front, :, 2].mean(axis=1), kind="stable")]
    # tenths of a unit, as whole numbers: the group scales them back
    flat = np.rint(10.0 * scale * corner[:, :, :2] * [1.0, -1.0]).astype(int)
    steps = np.diff(flat[order], axis=1).reshape(len(order), -1)
    faces = [
        (rgb[q], f"M{x} {y}l" + " ".join(map(str, rest)).replace(" -", "-") + "z")
        for q, (x, y), rest in zip(order, flat[order, 0], steps, strict=True)
    ]
    made = template("drawing/assets/still.svg")
    return made.render(width=WIDTH, height=HEIGHT, words=words, faces=faces).strip()


def middle_of(shapes: ModeShapes) -> Array:
    """(3,) the middle of the surface's box in m, about which it turns."""
    return 0.5 * (shapes.points.min(axis=0) + shapes.points.max(axis=0))


def data(shapes: ModeShapes) -> str:
    """Write the data of the script as compact JSON of whole numbers, safe inside a script
    element."""
    size = np.ptp(shapes.points, axis=0)
    unit = float(size.max()) / UNITS
    fields = []
    for mode in shapes.modes:
        largest = max(float(np.linalg.norm(mode.displacement, axis=1).max()), 1e-300)
        fields.append(_whole(SHARES * mode.displacement / largest))
    content = {
        "points": _whole((shapes.points - middle_of(shapes)) / unit),
        "quads": shapes.faces.ravel().tolist(),
        "fields": fields,
        "shares": SHARES,
        "size": _whole(size / unit),
        "reach": round(REACH * float(size[0]) / unit),
        "view": [AZIMUTH, ELEVATION],
        "light": LIGHT,
        "shade": SHADE,
        "frame": [WIDTH, HEIGHT, MARGIN],
        "stops": colour_stops().astype(int).tolist(),
    }
    return json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")


def _whole(values: Array) -> list[int]:
    return [int(v) for v in np.rint(values).ravel()]


def legend(words: str) -> str:
    """The colour scale from 0 to 1 as an <svg> element, with words beside it."""
    shades = np.rint(colours(np.linspace(0.0, 1.0, 60))).astype(int)
    return template("drawing/assets/scale.svg").render(colours=shades, words=words).strip()


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
    """Draw machines by the edges of their surfaces, from above and from the side, at one scale.

    Parameters
    ----------
    surfaces : mapping
        Name -> points (n, 3), m.
    faces : int array (q, 4)
        Numbers of points, the same for all.
    masses : list of float
        kg.

    Returns
    -------
    Figure
    """
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
