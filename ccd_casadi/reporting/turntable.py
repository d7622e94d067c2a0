"""Surfaces of quads as small 3D pictures: drawn in Python for paper, turned by a script on screen.

Both draw alike: orthographic projection, back faces left out, far quads first, one colour a quad.
Camera coordinates are right, up and towards the viewer.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from ccd_casadi.reporting.page import escape
from ccd_casadi.reporting.svg import COLOUR_MAP
from ccd_casadi.support.arrays import Array

AZIMUTH, ELEVATION = -62.0, 44.0  # degrees, of the camera as seen from the object
WIDTH, HEIGHT = 320, 236  # of one picture, in its own units
MARGIN = 6.0
REACH = 0.08  # the largest displacement is drawn as this share of the object's width
UNIT = 1e-4  # m; coordinates are written as whole multiples of it
SHARES = 999  # displacements are written as so many parts of the largest
LIGHT = (-0.45, 0.75, 0.9)  # right, up, towards the viewer: it stays with the camera
SHADE = (0.66, 0.34)  # brightness of a quad: first + second · cosine to the light
STOPS = 17  # of the colour map, linear in between

# corners of a cell's six faces, counter-clockwise from outside, by (axis, side)
FACES = {
    (0, 1): ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
    (0, -1): ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
    (1, 1): ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
    (1, -1): ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
    (2, 1): ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
    (2, -1): ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
}


@dataclass(frozen=True)
class Surface:
    """Points (n, 3) in m, quads (q, 4) wound counter-clockwise, and each point's first source."""

    points: Array
    quads: np.ndarray
    source: np.ndarray


@dataclass(frozen=True)
class Picture:
    """A surface moved by displacements (n, 3) of any unit; the words are read out."""

    displacement: Array
    words: str


def coarse_surface(points: Array, quads: np.ndarray, lines: Sequence[Array]) -> Surface:
    """The quads of an axis-aligned surface merged between grid lines in m, along x, y and z.

    Edges of the surface must lie on lines, and grid points of lines on points.
    """
    near = [np.searchsorted(0.5 * (line[1:] + line[:-1]), axis)
            for line, axis in zip(lines, points.T, strict=True)]  # fmt: skip
    on = np.all([np.abs(line[i] - axis) < UNIT * 1e-4
                 for i, line, axis in zip(near, lines, points.T, strict=True)], axis=0)  # fmt: skip
    shape = [len(line) for line in lines]
    place = np.ravel_multi_index(near, shape)
    found, first = np.unique(place[on], return_index=True)
    source = np.flatnonzero(on)[first]

    corner = points[quads]
    middle = corner.mean(axis=1)
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    merged = []
    for (axis, side), offsets in FACES.items():
        facing = normal[:, axis] * side > 0.5 * np.linalg.norm(normal, axis=1)
        cell = []
        for k, line in enumerate(lines):
            if k == axis:  # the cell behind the face
                plane = np.argmin(np.abs(line - middle[facing, k, None]), axis=1)
                cell.append(plane - (side > 0))
            else:
                cell.append(np.searchsorted(line, middle[facing, k]) - 1)
        cells = np.unique(np.stack(cell, axis=1), axis=0)
        at_corners = [np.ravel_multi_index((cells + np.array(o)).T, shape) for o in offsets]
        merged.append(np.stack(at_corners, axis=1))
    every = np.searchsorted(found, np.concatenate(merged))
    used, every = np.unique(every, return_inverse=True)
    source = source[used]
    return Surface(points[source], every.reshape(-1, 4), source)


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


def moved(surface: Surface, displacement: Array) -> tuple[Array, Array]:
    """The points moved as drawn, in m, and each quad's share of the largest displacement."""
    size = np.linalg.norm(displacement, axis=1)
    largest = max(float(size.max()), 1e-300)
    reach = REACH * float(np.ptp(surface.points[:, 0]))
    return (
        surface.points + reach / largest * displacement,
        size[surface.quads].mean(axis=1) / largest,
    )


def still(surface: Surface, picture: Picture) -> str:
    """The picture as an <svg> element for inline use, far quads first."""
    points, shares = moved(surface, picture.displacement)
    seen = camera(points - middle_of(surface), AZIMUTH, ELEVATION)
    size = np.ptp(surface.points, axis=0)
    scale = box_scale(size, REACH * float(size[0]), ELEVATION)
    corner = seen[surface.quads]
    normal = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    bright = normal @ light / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    shade = SHADE[0] + SHADE[1] * np.clip(bright, 0.0, 1.0)
    rgb = np.rint(colours(shares) * shade[:, None]).astype(int)
    front = np.flatnonzero(normal[:, 2] > 0.0)
    order = front[np.argsort(corner[front, :, 2].mean(axis=1), kind="stable")]
    # tenths of a unit, as whole numbers: the group scales them back
    flat = np.rint(10.0 * scale * corner[:, :, :2] * [1.0, -1.0]).astype(int)
    paths = []
    for q in order:
        steps = np.diff(flat[q], axis=0).ravel()
        start, rest = flat[q][0], " ".join(map(str, steps)).replace(" -", "-")
        red, green, blue = rgb[q]
        paths.append(
            f'<path color="#{red:02x}{green:02x}{blue:02x}" d="M{start[0]} {start[1]}l{rest}z"/>'
        )
    # a hairline of the quad's own colour closes the seams between neighbours
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(picture.words)}">'
        f'<g transform="translate({WIDTH / 2:g} {HEIGHT / 2:g}) scale(.1)" fill="currentColor" '
        f'stroke="currentColor" stroke-width="8">' + "".join(paths) + "</g></svg>"
    )


def middle_of(surface: Surface) -> Array:
    """(3,) the middle of the surface's box in m, about which it turns."""
    return 0.5 * (surface.points.min(axis=0) + surface.points.max(axis=0))


def data(surface: Surface, pictures: Sequence[Picture]) -> str:
    """What the script needs, as compact JSON of whole numbers, safe inside a script element."""
    size = np.ptp(surface.points, axis=0)
    fields = []
    for picture in pictures:
        largest = max(float(np.linalg.norm(picture.displacement, axis=1).max()), 1e-300)
        fields.append(_whole(SHARES * picture.displacement / largest))
    content = {
        "points": _whole((surface.points - middle_of(surface)) / UNIT),
        "quads": surface.quads.ravel().tolist(),
        "fields": fields,
        "shares": SHARES,
        "size": _whole(size / UNIT),
        "reach": round(REACH * float(size[0]) / UNIT),
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
    bars = "".join(
        f'<rect x="{16 + 4 * i}" y="4" width="4.5" height="12" fill="rgb({r},{g},{b})"/>'
        for i, (r, g, b) in enumerate(shades)
    )
    return (
        f'<svg viewBox="0 0 960 22" role="img" aria-label="{escape(words)}">{bars}'
        '<g font-size="13"><text x="0" y="15">0</text><text x="264" y="15">1</text>'
        f'<text x="292" y="15">{escape(words)}</text></g></svg>'
    )
