"""The mesh that follows a solid, on a block whose kernel is exact: where gmsh is not installed."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.block_kernel import CELLS, Block, draw
from oracles.helpers import few

from ccd_casadi.extensions.cad import solid
from ccd_casadi.extensions.cad.cad_stage import draw_morph
from ccd_casadi.extensions.cad.solid import face_at, kernel, load, mesh_solid, moved_points, volumes
from ccd_casadi.support.errors import PlantError

lengths = st.floats(20.0, 200.0)
sizes = st.tuples(lengths, lengths, lengths)


@pytest.fixture(autouse=True)
def block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solid, "require", lambda package, extra: Block())


@few(10)
@given(first=sizes, second=sizes, shear=st.floats(-15.0, 15.0), turn=st.integers(0, 11))
def test_a_linear_change_of_the_solid_is_that_of_its_mesh(
    tmp_path_factory: pytest.TempPathFactory,
    first: tuple[float, ...],
    second: tuple[float, ...],
    shear: float,
    turn: int,
) -> None:
    """What is linear on the boundary is its own harmonic extension, however pieces are numbered."""
    folder: Path = tmp_path_factory.mktemp("drawn")
    # little enough that every piece's nearest counterpart is its own
    second = tuple(a + 0.2 * (b - a) * min(1.0, a / b) for a, b in zip(first, second, strict=True))
    shear *= min(first) / 200.0
    with kernel() as gmsh:
        load(gmsh, draw(folder / "first.json", first))
        mesh = mesh_solid(gmsh, 1.0)
        before = gmsh.axes
        load(gmsh, draw(folder / "second.json", second, shear, turn))
        points = moved_points(gmsh, mesh)
        linear = gmsh.axes @ np.linalg.inv(before)
    np.testing.assert_allclose(points, mesh.points @ linear.T, atol=1e-12)
    assert volumes(points, mesh.tets).sum() == pytest.approx(1e-9 * np.prod(second), rel=1e-9)


def test_faces_are_found_by_their_points(tmp_path: Path) -> None:
    with kernel() as gmsh:
        load(gmsh, draw(tmp_path / "one.json", (100.0, 60.0, 10.0), turn=2))
        mesh = mesh_solid(gmsh, 1.0)
        top = face_at(gmsh, "top", (50.0, 30.0, 10.0))
        np.testing.assert_allclose(mesh.points[np.unique(mesh.faces[top]), 2], 0.01)
        assert len(mesh.faces[top]) == 2 * CELLS**2
        with pytest.raises(PlantError, match="0 faces go through the point of 'air'"):
            face_at(gmsh, "air", (50.0, 30.0, 20.0))
        with pytest.raises(PlantError, match="2 faces go through the point of 'edge'"):
            face_at(gmsh, "edge", (100.0, 30.0, 10.0))
        with pytest.raises(PlantError, match="2 solids; fuse"):
            load(gmsh, draw(tmp_path / "two.json", (1.0, 1.0, 1.0), solids=2))
        with pytest.raises(PlantError, match="the solid is a int; return a shape"):
            load(gmsh, 3)


def test_a_morph_is_the_block_at_any_length(tmp_path: Path) -> None:
    def drawing(theta: dict[str, float]) -> tuple[Path, dict[str, tuple[float, float, float]]]:
        length = 1e3 * theta["length"]
        path = draw(tmp_path / "block.json", (length, 60.0, 10.0), turn=int(length) % 6)
        return path, {"end": (length, 30.0, 5.0)}

    bounds = {"length": (0.09, 0.12)}
    morph = draw_morph(drawing, bounds, tmp_path / "m.npz", size=20e-3, degree=2, quiet=True)
    assert morph.error < 1e-9
    assert np.ptp(morph.points((0.117,))[:, 0]) == pytest.approx(0.117, abs=1e-12)
    ends = morph.points((0.117,))[np.unique(morph.faces["end"])]
    np.testing.assert_allclose(ends[:, 0], 0.117, atol=1e-12)
    velocity = morph.velocities((0.1,))[0]
    np.testing.assert_allclose(velocity[:, 0], morph.points((0.1,))[:, 0] / 0.1, atol=1e-9)
