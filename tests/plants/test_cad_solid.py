"""The mesh that follows a solid; gmsh's own CAD kernel draws, so that no other is needed."""

from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.extensions.cad.cad_stage import draw_morph
from ccd_casadi.extensions.cad.solid import (
    Boundary,
    Piece,
    face_at,
    kernel,
    load,
    match,
    mesh_solid,
    moved_points,
    volumes,
)
from ccd_casadi.support.errors import MissingPackage, PlantError, require


@pytest.fixture
def drawn_by_gmsh() -> None:
    """On Linux the test lock has it; it loads libraries of X11 that a bare machine may lack."""
    try:
        require("gmsh", "cad")
    except MissingPackage as missing:
        pytest.skip(str(missing))


def plate(path: Path, length: float, bore: float, aside: float = 0.0) -> Path:
    """A STEP file of a plate `length` x 60 x 10 mm with a bore of that radius, `aside` in y, mm."""
    with kernel() as gmsh:
        gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
        box = gmsh.model.occ.addBox(-0.5 * length, -30.0, 0.0, length, 60.0, 10.0)
        pin = gmsh.model.occ.addCylinder(0.1 * length, aside, -5.0, 0.0, 0.0, 20.0, bore)
        gmsh.model.occ.cut([(3, box)], [(3, pin)])
        gmsh.model.occ.synchronize()
        gmsh.write(str(path))
    return path


@pytest.mark.usefixtures("drawn_by_gmsh")
def test_nodes_stay_on_their_faces(tmp_path: Path) -> None:
    """The bore's nodes lie on the new bore, the end's on the new end, and none is inside out."""
    first = plate(tmp_path / "first.step", 100.0, 12.0)
    second = plate(tmp_path / "second.step", 130.0, 16.0)
    with kernel() as gmsh:
        load(gmsh, first)
        mesh = mesh_solid(gmsh, 15e-3)
        end = face_at(gmsh, "end", (-50.0, 0.0, 5.0))
        load(gmsh, second)
        points = moved_points(gmsh, mesh)
    radius = np.hypot(mesh.points[:, 0] - 0.01, mesh.points[:, 1])
    on_bore = np.abs(radius - 0.012) < 1e-9
    assert on_bore.sum() > 20
    np.testing.assert_allclose(
        np.hypot(points[on_bore, 0] - 0.013, points[on_bore, 1]), 0.016, atol=1e-9
    )
    np.testing.assert_allclose(points[np.unique(mesh.faces[end]), 0], -0.065, atol=1e-12)
    assert volumes(points, mesh.tets).min() > 0.0
    drawn = 1e-9 * (130.0 * 60.0 - np.pi * 16.0**2) * 10.0
    assert volumes(points, mesh.tets).sum() == pytest.approx(drawn, rel=5e-3)  # a polygon's bore


@pytest.mark.usefixtures("drawn_by_gmsh")
def test_another_topology_is_refused(tmp_path: Path) -> None:
    """A bore that cuts the plate's edge is a notch, and one that is wider than it makes two."""
    files = [
        plate(tmp_path / "bored.step", 100.0, 12.0),
        plate(tmp_path / "notched.step", 100.0, 12.0, 25.0),
        plate(tmp_path / "halves.step", 100.0, 31.0),
    ]
    with kernel() as gmsh:
        load(gmsh, files[0])
        mesh = mesh_solid(gmsh, 20e-3)
        load(gmsh, files[1])
        with pytest.raises(PlantError, match="corners where the meshed one has"):
            moved_points(gmsh, mesh)
        with pytest.raises(PlantError, match="2 solids; fuse"):
            load(gmsh, files[2])


@pytest.mark.usefixtures("drawn_by_gmsh")
def test_a_morph_is_the_plate_at_any_length(tmp_path: Path) -> None:
    def solid(theta: dict[str, float]) -> tuple[Path, dict[str, tuple[float, float, float]]]:
        length, bore = 1e3 * theta["length"], 1e3 * theta["bore"]
        path = plate(tmp_path / "plate.step", length, bore)
        return path, {"end": (-0.5 * length, 0.0, 5.0)}

    bounds = {"length": (0.09, 0.12), "bore": (0.008, 0.014)}
    morph = draw_morph(solid, bounds, tmp_path / "m.npz", size=20e-3, degree=2, quiet=True)
    assert morph.error < 1e-5
    assert np.ptp(morph.points((0.117, 0.009))[:, 0]) == pytest.approx(0.117, abs=1e-6)
    end = morph.points((0.117, 0.009))[np.unique(morph.faces["end"])]
    np.testing.assert_allclose(end[:, 0], -0.0585, atol=1e-6)
    step = 1e-6
    above, below = morph.points((0.1 + step, 0.01)), morph.points((0.1 - step, 0.01))
    velocity = morph.velocities((0.1, 0.01))[0]
    np.testing.assert_allclose((above - below) / (2.0 * step), velocity, atol=1e-8)


def bar(length: float, names: dict[int, int]) -> Boundary:
    """Two corners, the edge between them and a face around it, numbered by `names`."""
    ends = {names[1]: np.zeros(3), names[2]: np.array([length, 0.0, 0.0])}
    points = np.outer([0.25, 0.5, 0.75], [length, 0.0, 0.0])
    edge = Piece("Line", frozenset(ends), points)
    face = Piece("Plane", frozenset({names[3]}), points[1:2])
    return Boundary(ends, {names[3]: edge}, {names[4]: face})


def test_pieces_numbered_anew_are_found_again() -> None:
    found = match(bar(1.0, {1: 1, 2: 2, 3: 3, 4: 4}), bar(1.2, {1: 8, 2: 7, 3: 6, 4: 5}))
    assert found == ({1: 8, 2: 7}, {3: 6}, {4: 5})


def test_an_edge_that_runs_the_other_way_is_turned() -> None:
    one, other = (bar(1.0, {1: 1, 2: 2, 3: 3, 4: 4}) for _ in range(2))
    turned = Piece("Line", other.edges[3].rim, other.edges[3].points[::-1])
    _, edges, _ = match(one, Boundary(other.corners, {3: turned}, other.faces))
    assert edges == {3: -3}


def test_a_face_of_another_kind_is_refused() -> None:
    one, other = (bar(1.0, {1: 1, 2: 2, 3: 3, 4: 4}) for _ in range(2))
    bending = Piece("Cylinder", other.faces[4].rim, other.faces[4].points)
    with pytest.raises(PlantError, match=r"the face \(Plane\) at .* has no counterpart"):
        match(one, Boundary(other.corners, other.edges, {4: bending}))
