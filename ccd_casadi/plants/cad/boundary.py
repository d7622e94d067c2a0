"""Corners, edges and faces of a solid, and which of them are which on the solid of another θ.

A CAD kernel numbers them anew with every drawing. Corners are paired by the least sum of squared
distances, edges by the corners that they join, faces by the edges around them; where several would
do, the nearest is taken.
"""

from collections.abc import Mapping
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


@dataclass(frozen=True)
class Pairing:
    """The new numbers of a boundary's pieces; an edge in `reversed` runs the other way."""

    corners: Mapping[int, int]
    edges: Mapping[int, int]
    faces: Mapping[int, int]
    reversed: frozenset[int]


def boundary_of(gmsh: Any) -> Boundary:
    """That of the solid which gmsh has loaded."""
    model = gmsh.model

    def piece(dimension: int, tag: int, points: Array) -> Piece:
        rim = model.getBoundary([(dimension, tag)], oriented=False)
        return Piece(model.getType(dimension, tag), frozenset(n for _, n in rim), points)

    return Boundary(
        {tag: model.getValue(0, tag, []) for _, tag in model.getEntities(0)},
        {tag: piece(1, tag, edge_points(gmsh, tag, QUARTERS)) for _, tag in model.getEntities(1)},
        {
            tag: piece(2, tag, np.array([model.occ.getCenterOfMass(2, tag)]))
            for _, tag in model.getEntities(2)
        },
    )


def edge_points(gmsh: Any, tag: int, shares: Array) -> Array:
    """(k, 3) points of an edge at shares of its parameter, 0 to 1."""
    low, high = (bound[0] for bound in gmsh.model.getParametrizationBounds(1, tag))
    return np.reshape(gmsh.model.getValue(1, tag, low + shares * (high - low)), (-1, 3))


def matched(old: Boundary, new: Boundary) -> Pairing:
    """Which piece of `new` each piece of `old` is. Raises PlantError where they do not agree."""
    for word in ("corners", "edges", "faces"):
        before, now = len(getattr(old, word)), len(getattr(new, word))
        if before != now:
            raise PlantError(f"it has {now} {word} where the meshed one has {before}; {REMEDY}")
    rows, columns = linear_sum_assignment(
        cdist(_stack(old.corners), _stack(new.corners), "sqeuclidean")
    )
    numbers = list(old.corners), list(new.corners)
    corners = {numbers[0][i]: numbers[1][j] for i, j in zip(rows, columns, strict=True)}
    edges = _pieces("edge", old.edges, new.edges, corners)
    faces = _pieces("face", old.faces, new.faces, edges)
    away = {tag: _distances(old.edges[tag], new.edges[other]) for tag, other in edges.items()}
    turned = frozenset(tag for tag, (straight, back) in away.items() if back < straight)
    return Pairing(corners, edges, faces, turned)


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


def _stack(corners: Mapping[int, Array]) -> Array:
    return np.array(list(corners.values())).reshape(-1, 3)


def _distances(one: Piece, other: Piece) -> tuple[float, float]:
    """How far the points are from each other, and from those in the other order."""
    gaps = (one.points - points for points in (other.points, other.points[::-1]))
    straight, back = (float(np.linalg.norm(gap)) for gap in gaps)
    return straight, back
