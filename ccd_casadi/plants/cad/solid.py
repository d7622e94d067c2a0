"""A drawn solid in gmsh: meshed once, and the same mesh on the solid drawn with another θ.

A boundary node keeps its place on its own piece of the boundary: a corner is the corner, a node on
an edge keeps its share of the edge's parameter, a node on a face follows the face's edges by
harmonic extension and is put back on the face by the nearest point. Nodes within follow by
harmonic extension too. So faces may grow, tilt and curve; their number and neighbours stay.
"""

import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ccd_casadi.plants.cad.boundary import Boundary, boundary_of, edge_points, matched
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, require

TRIANGLE, TETRAHEDRON = 2, 4  # gmsh's numbers of linear elements
MODEL = "ccd_casadi"
MILLIMETRE = 1e-3  # of a drawing's unit, for points that name faces
PER_TURN = 20  # elements around a full circle, at least


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


def meshed(gmsh: Any, size: float) -> SolidMesh:
    """The mesh of the solid that is loaded, edges of at most `size` in m."""
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", PER_TURN)
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
    corners, edges, faces = matched(mesh.boundary, boundary_of(gmsh))
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
            step = extended(old, triangles, rim, new[rim] - old[rim])[inner]
            near, _ = gmsh.model.getClosestPoint(2, faces[tag], (old[inner] + step).ravel())
            new[inner] = near.reshape(-1, 3)
            surface.append(inner)
    boundary = np.concatenate(surface)
    new = old + extended(old, mesh.tets, boundary, new[boundary] - old[boundary])
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


def extended(points: Array, simplices: np.ndarray, known: np.ndarray, values: Array) -> Array:
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
