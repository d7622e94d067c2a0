"""A drawn solid in gmsh: meshed once, and which corner, edge and face is which on the next
drawing."""

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import splu
from scipy.spatial.distance import cdist

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, require


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
    """Read the boundary of the solid that gmsh has loaded."""
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
        pieces(1, lambda tag: edge_points(gmsh, tag, np.array([0.25, 0.5, 0.75]))),
        pieces(2, lambda tag: np.array([model.occ.getCenterOfMass(2, tag)])),
    )


def edge_points(gmsh: Any, tag: int, shares: Array) -> Array:
    """(k, 3) points of an edge at shares of its parameter, 0 to 1."""
    low, high = (bound[0] for bound in gmsh.model.getParametrizationBounds(1, tag))
    return np.reshape(gmsh.model.getValue(1, tag, low + shares * (high - low)), (-1, 3))


def match(old: Boundary, new: Boundary) -> tuple[dict[int, int], dict[int, int], dict[int, int]]:
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
    """Compute how far the points are from each other, and from those in the other order."""
    gaps = (one.points - points for points in (other.points, other.points[::-1]))
    straight, back = (float(np.linalg.norm(gap)) for gap in gaps)
    return straight, back


TRIANGLE, TETRAHEDRON = 2, 4  # gmsh's numbers of linear elements
MODEL = "ccd_casadi"
MILLIMETRE = 1e-3  # of a drawing's unit, for points that name faces


@dataclass(frozen=True)
class SolidMesh:
    """Linear tetrahedra (t, 4) on points (n, 3) in m, and what piece of the boundary a node is on.

    `corners` maps gmsh's number of a corner to its node, `edges` that of an edge to its inner nodes
    and their share of the edge's parameter, `faces` that of a face to its triangles (f, 3).
    """

    points: Array
    tets: np.ndarray
    corners: Mapping[int, int]
    edges: Mapping[int, tuple[np.ndarray, Array]]
    faces: Mapping[int, np.ndarray]
    boundary: Boundary


@contextmanager
def kernel() -> Iterator[Any]:
    """gmsh, quiet, with a model of its own; what a caller has open in it is left as it is."""
    gmsh = require("gmsh", "cad")
    own = not gmsh.isInitialized()
    if own:
        gmsh.initialize(interruptible=False, readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add(MODEL)
        yield gmsh
        gmsh.model.remove()
    finally:
        if own:
            gmsh.finalize()


def load(gmsh: Any, drawn: Any) -> None:
    """Put a solid in the place of the last one: a path of a STEP file, or a shape of build123d."""
    gmsh.model.setCurrent(MODEL)  # a drawing may have used gmsh itself
    gmsh.model.remove()
    gmsh.model.add(MODEL)
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    with tempfile.TemporaryDirectory() as folder:
        path = drawn
        if not isinstance(drawn, str | Path):
            path = Path(folder) / "solid.step"
            try:
                require("build123d", "cad").export_step(drawn, str(path))
            except (AttributeError, TypeError, ValueError):
                words = f"the solid is a {type(drawn).__name__}; return a shape of build123d"
                raise PlantError(f"{words}, or the path of a STEP file") from None
        try:
            gmsh.model.occ.importShapes(str(path))
        except Exception as error:
            raise PlantError(f"gmsh cannot read the solid: {error}") from None
    gmsh.model.occ.synchronize()
    solids = len(gmsh.model.getEntities(3))
    if solids != 1:
        raise PlantError(f"the drawing has {solids} solids; fuse its parts into one")


def mesh_solid(gmsh: Any, size: float, *, per_turn: int = 20) -> SolidMesh:
    """Mesh the solid that is loaded: edges of at most `size` in m, `per_turn` around a circle."""
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", per_turn)
    gmsh.model.mesh.generate(3)
    labels, coordinates, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(labels)
    known = labels[order]

    def nodes(numbers: Any) -> np.ndarray:
        return order[np.searchsorted(known, numbers)]

    edges = {}
    for _, tag in gmsh.model.getEntities(1):
        inner, _, parameter = gmsh.model.mesh.getNodes(1, tag)
        low, high = (bound[0] for bound in gmsh.model.getParametrizationBounds(1, tag))
        edges[tag] = nodes(inner), (np.asarray(parameter) - low) / (high - low)
    mesh = gmsh.model.mesh
    return SolidMesh(
        points=coordinates.reshape(-1, 3),
        tets=nodes(mesh.getElementsByType(TETRAHEDRON)[1]).reshape(-1, 4),
        corners={
            tag: int(nodes(mesh.getNodes(0, tag)[0])[0]) for _, tag in gmsh.model.getEntities(0)
        },
        edges=edges,
        faces={
            tag: nodes(mesh.getElementsByType(TRIANGLE, tag)[1]).reshape(-1, 3)
            for _, tag in gmsh.model.getEntities(2)
        },
        boundary=boundary_of(gmsh),
    )


def moved_points(gmsh: Any, mesh: SolidMesh) -> Array:
    """The mesh's points (n, 3) on the solid that is loaded.

    Raises PlantError where its boundary has other pieces, or where an element turns inside out.
    """
    corners, edges, faces = match(mesh.boundary, boundary_of(gmsh))
    old, new = mesh.points, mesh.points.copy()
    for tag, node in mesh.corners.items():
        new[node] = gmsh.model.getValue(0, corners[tag], [])
    for tag, (inner, share) in mesh.edges.items():
        here = 1.0 - share if edges[tag] < 0 else share
        new[inner] = edge_points(gmsh, abs(edges[tag]), here)
    placed = np.array([*mesh.corners.values(), *(n for e in mesh.edges.values() for n in e[0])])
    surface = [placed]
    for tag, triangles in mesh.faces.items():
        rim = np.intersect1d(triangles, placed)
        inner = np.setdiff1d(triangles, rim)
        if inner.size:
            step = extend(old, triangles, rim, new[rim] - old[rim])[inner]
            near, _ = gmsh.model.getClosestPoint(2, faces[tag], (old[inner] + step).ravel())
            new[inner] = near.reshape(-1, 3)
            surface.append(inner)
    boundary = np.concatenate(surface)
    new = old + extend(old, mesh.tets, boundary, new[boundary] - old[boundary])
    if volumes(new, mesh.tets).min() <= 0.0:
        raise PlantError(
            "an element of the moved mesh is inside out; narrow the bounds, or give a finer mesh"
        )
    return new


def face_at(gmsh: Any, name: str, point: Any) -> int:
    """The number of the one face through a point given in mm. Raises PlantError without one."""
    where = MILLIMETRE * np.array([float(value) for value in point])
    found = []
    for _, tag in gmsh.model.getEntities(2):
        near, parameters = gmsh.model.getClosestPoint(2, tag, where)
        inside = gmsh.model.isInside(2, tag, parameters, parametric=True)
        if inside and np.linalg.norm(near - where) < 1e-3 * MILLIMETRE:
            found.append(tag)
    if len(found) != 1:
        words = f"{len(found)} faces go through the point of {name!r}"
        raise PlantError(f"{words}, {tuple(map(float, point))} mm; give a point inside of one face")
    return int(found[0])


def volumes(points: Array, tets: np.ndarray) -> Array:
    """(t,) signed volumes in m³."""
    corners = points[tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0


def laplacian(points: Array, simplices: np.ndarray) -> sparse.csc_matrix:
    """∫ ∇φ_a·∇φ_b of linear elements on triangles or tetrahedra in space, (n, n).

    `points` (n, 3), `simplices` (e, 3) or (e, 4). With the edges E from a simplex' first corner
    and G = E Eᵀ, gradients in its own plane are G⁻¹ E, so that a triangle needs no coordinates
    of its surface.
    """
    corners, k = points[simplices], simplices.shape[1] - 1
    edges = corners[:, 1:] - corners[:, :1]
    metric = edges @ edges.transpose(0, 2, 1)
    volume = np.sqrt(np.linalg.det(metric)) / math.factorial(k)
    steps = np.vstack([-np.ones(k), np.eye(k)])  # of the corners' own functions along the edges
    local = volume[:, None, None] * (steps @ np.linalg.inv(metric) @ steps.T)
    rows = np.repeat(simplices, k + 1, axis=1).ravel()
    columns = np.tile(simplices, k + 1).ravel()
    size = len(points)
    return sparse.coo_matrix((local.ravel(), (rows, columns)), shape=(size, size)).tocsc()


def extend(points: Array, simplices: np.ndarray, known: np.ndarray, values: Array) -> Array:
    """Values (n, d), those at the nodes `known` as given (k, d), harmonic at the mesh's others.

    Nodes that the mesh does not touch are zero. A linear function of space is its own extension.
    """
    out = np.zeros((len(points), values.shape[1]))
    out[known] = values
    free = np.setdiff1d(simplices, known)
    if free.size:
        L = laplacian(points, simplices)[free]
        out[free] = splu(L[:, free].tocsc()).solve(-(L[:, known] @ values))
    return out
