"""Corners, edges and faces of a solid, and which of them are which on the solid of another θ.

A CAD kernel numbers them anew with every drawing. Corners are paired by the least sum of squared
distances, edges by the corners that they join, faces by the edges around them; where several would
do, the nearest is taken.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

QUARTERS = np.array([0.25, 0.5, 0.75])


@dataclass(frozen=True)
class Piece:
    """An edge or a face: its kind (line, plane, …), the numbers around it, and points (k, 3)."""

    kind: str
    rim: frozenset[int]
    points: Array


@dataclass(frozen=True)
class Boundary:
    """Corners' positions, edges with their points at quarters, faces with a centre, by number."""

    corners: Mapping[int, Array]
    edges: Mapping[int, Piece]
    faces: Mapping[int, Piece]


def boundary_of(gmsh: Any) -> Boundary:
    """That of the solid which gmsh has loaded."""
    model = gmsh.model

    def pieces(dimension: int, points: Callable[[int], Array]) -> dict[int, Piece]:
        found = {}
        for _, tag in model.getEntities(dimension):
            rim = model.getBoundary([(dimension, tag)], oriented=False)
            kind = model.getType(dimension, tag)
            found[tag] = Piece(kind, frozenset(n for _, n in rim), points(tag))
        return found

    return Boundary(
        {tag: model.getValue(0, tag, []) for _, tag in model.getEntities(0)},
        pieces(1, lambda tag: edge_points(gmsh, tag, QUARTERS)),
        pieces(2, lambda tag: np.array([model.occ.getCenterOfMass(2, tag)])),
    )


def edge_points(gmsh: Any, tag: int, shares: Array) -> Array:
    """(k, 3) points of an edge at shares of its parameter, 0 to 1."""
    low, high = (bound[0] for bound in gmsh.model.getParametrizationBounds(1, tag))
    return np.reshape(gmsh.model.getValue(1, tag, low + shares * (high - low)), (-1, 3))


def matched(old: Boundary, new: Boundary) -> tuple[dict[int, int], dict[int, int], dict[int, int]]:
    """The number in `new` of each corner, edge and face of `old`, less than 0 of an edge that runs
    the other way, as gmsh has it. Raises PlantError where they do not agree."""
    for word in ("corners", "edges", "faces"):
        before, now = len(getattr(old, word)), len(getattr(new, word))
        if before != now:
            raise PlantError(f"it has {now} {word} where the meshed one has {before}; {REMEDY}")
    at = (np.array(list(one.corners.values())).reshape(-1, 3) for one in (old, new))
    rows, columns = linear_sum_assignment(cdist(*at, "sqeuclidean"))
    numbers = list(old.corners), list(new.corners)
    corners = {numbers[0][i]: numbers[1][j] for i, j in zip(rows, columns, strict=True)}
    edges = _pieces("edge", old.edges, new.edges, corners)
    faces = _pieces("face", old.faces, new.faces, edges)
    for tag, other in edges.items():
        straight, back = _distances(old.edges[tag], new.edges[other])
        edges[tag] = -other if back < straight else other
    return corners, edges, faces


REMEDY = "narrow the bounds so that no face or edge appears, vanishes or merges"


def _pieces(
    word: str, old: Mapping[int, Piece], new: Mapping[int, Piece], rims: Mapping[int, int]
) -> dict[int, int]:
    found: dict[int, int] = {}
    for tag, piece in old.items():
        rim = frozenset(rims[n] for n in piece.rim)
        alike = [
            other
            for other, candidate in new.items()
            if candidate.rim == rim and candidate.kind == piece.kind
        ]
        if not alike:
            x, y, z = 1e3 * piece.points.mean(axis=0)
            words = f"the {word} ({piece.kind}) at ({x:.1f}, {y:.1f}, {z:.1f}) mm of the meshed one"
            raise PlantError(f"{words} has no counterpart with the same neighbours; {REMEDY}")
        found[tag] = min(alike, key=lambda other: min(_distances(piece, new[other])))
    if len(set(found.values())) != len(old):
        raise PlantError(f"two {word}s of the meshed solid are one here; {REMEDY}")
    return found


def _distances(one: Piece, other: Piece) -> tuple[float, float]:
    """How far the points are from each other, and from those in the other order."""
    gaps = (one.points - points for points in (other.points, other.points[::-1]))
    straight, back = (float(np.linalg.norm(gap)) for gap in gaps)
    return straight, back
