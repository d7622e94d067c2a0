"""The elements of `cad_stage` and their slopes, on a small block: scikit-fem alone is needed."""

import numpy as np
import pytest

from ccd_casadi.drawing.content import Lines
from ccd_casadi.extensions.cad.cad_stage import (
    CadStage,
    Morph,
    plant_of_stage,
    read_morph,
    write_morph,
)
from ccd_casadi.extensions.cad.elastic_body import Body, Material, reduce_body
from ccd_casadi.extensions.cad.solid import extend, volumes
from ccd_casadi.plants.plant import constraint_values, hardware_cost, mechanics
from ccd_casadi.support.errors import PlantError

skfem = pytest.importorskip("skfem", reason="scikit-fem is not installed (the extra `cad`)")

MATERIAL = Material(70e9, 0.3, 2700.0)
LENGTH, SIDE = 0.3, 0.02
STEP = 1e-5


def block(cells: tuple[int, int, int] = (3, 2, 2)) -> tuple[np.ndarray, np.ndarray]:
    """A bar of LENGTH along x and of square section, points (n, 3) and tetrahedra (t, 4)."""
    x, y, z = (np.linspace(0.0, 1.0, n + 1) for n in cells)
    mesh = skfem.MeshTet.init_tensor(LENGTH * x, SIDE * y, SIDE * z)
    points, tets = mesh.p.T.copy(), mesh.t.T.copy()
    left_handed = volumes(points, tets) < 0.0
    tets[left_handed] = tets[left_handed][:, [1, 0, 2, 3]]
    return points, tets


def face(points: np.ndarray, tets: np.ndarray, x: float) -> np.ndarray:
    """The triangles of the end at x."""
    mesh = skfem.MeshTet(points.T.copy(), tets.T.copy())
    return mesh.facets[:, mesh.facets_satisfying(lambda p: np.abs(p[0] - x) < 1e-9)].T


def bent_velocity(points: np.ndarray) -> np.ndarray:
    """A velocity of the nodes that is no motion and no scaling."""
    draws = np.random.default_rng(3)
    smooth = 0.1 * points @ draws.standard_normal((3, 3))
    return smooth + 1e-3 * draws.standard_normal(points.shape)


def test_stiffness_is_that_of_scikit_fem() -> None:
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    points, tets = block()
    K, M = Body(points, tets, MATERIAL).matrices()
    mesh = skfem.MeshTet(points.T.copy(), tets.T.copy())
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=4)
    expected = linear_elasticity(*lame_parameters(70e9, 0.3)).assemble(basis).tocsr()
    order = np.argsort(_axis_and_node(basis), kind="stable")
    gap = K - expected[order][:, order]
    assert abs(gap).max() < 1e-12 * abs(K).max()
    count = M.shape[0] // 3
    assert M[:count, :count].sum() == pytest.approx(2700.0 * LENGTH * SIDE**2, rel=1e-12)


def _axis_and_node(basis: "skfem.Basis") -> np.ndarray:
    """Rank of each unknown of a vector basis in the order of all x, all y, all z."""
    scalar = skfem.Basis(basis.mesh, skfem.ElementTetP2())
    rank = np.zeros(basis.N, dtype=int)
    for node_dofs, vector_dofs in (
        (scalar.nodal_dofs, basis.nodal_dofs), (scalar.edge_dofs, basis.edge_dofs),
    ):  # fmt: skip
        for axis in range(3):
            rank[vector_dofs[axis]] = axis * scalar.N + node_dofs[0]
    return rank


def test_slopes_of_the_matrices_are_those_of_differences() -> None:
    points, tets = block()
    velocity = bent_velocity(points)
    exact = Body(points, tets, MATERIAL).slopes(velocity)
    above, below = (
        Body(points + sign * STEP * velocity, tets, MATERIAL).matrices() for sign in (1.0, -1.0)
    )
    for one, plus, minus in zip(exact, above, below, strict=True):
        gap = (plus - minus) / (2.0 * STEP) - one
        assert abs(gap).max() < 1e-6 * abs(one).max()  # measured 1e-8


def test_mean_over_a_face_and_its_slope() -> None:
    points, tets = block()
    end = face(points, tets, LENGTH)
    body, velocity = Body(points, tets, MATERIAL), bent_velocity(points)
    weights, slopes = body.mean(end, velocity[None])
    assert weights @ body.places == pytest.approx([LENGTH, SIDE / 2.0, SIDE / 2.0])
    above, below = (
        Body(points + sign * STEP * velocity, tets, MATERIAL).mean(end, velocity[None][:0])[0]
        for sign in (1.0, -1.0)
    )
    gap = (above - below) / (2.0 * STEP) - slopes[0]
    assert np.abs(gap).max() < 1e-6 * np.abs(slopes).max()
    assert np.abs(slopes).max() > 1e-3


def test_a_held_bar_bends_at_the_frequency_of_a_beam() -> None:
    """Cantilever: 1.8751² √(E I/(ρ A L⁴)) rad/s, 15 to 1, so shear is worth half a per cent."""
    points, tets = block((12, 2, 2))
    body = Body(points, tets, MATERIAL)
    count = len(body.places)
    held = np.zeros((3, count), dtype=bool)
    held[:, body.on(face(points, tets, 0.0))] = True
    none = np.zeros((0, *points.shape))
    F = np.zeros((3 * count, 1))
    found = reduce_body(body, none, F, np.zeros((0, *F.shape)), 2, held.ravel())
    beam = 1.8751**2 * np.sqrt(70e9 * SIDE**2 / 12.0 / 2700.0) / LENGTH**2
    assert found.M.shape == (2, 2)
    assert np.sqrt(np.diag(found.K)) == pytest.approx([beam, beam], rel=1e-2)


def stretched(held: tuple[str, ...] = ()) -> CadStage:
    """The block with θ = (length, thickness), its far end driven and read; a morph made by hand."""
    points, tets = block((6, 2, 2))
    tapered = points.copy()
    tapered[:, 1] *= 1.0 - 0.4 * points[:, 0] / LENGTH  # no symmetry that makes modes double
    terms = np.array([tapered, tapered * [0.2, 0, 0], tapered * [0, 0, 0.2]])
    morph = Morph(
        names=("length", "thickness"),
        lower=np.array([0.24, 0.016]), upper=np.array([0.36, 0.024]),
        exponents=np.array([[0, 0], [1, 0], [0, 1]]),
        coefficients=terms, tets=tets,
        faces={"near": face(points, tets, 0.0), "far": face(points, tets, LENGTH)}, error=0.0,
    )  # fmt: skip
    ports = (("far", 2), ("far", 1))
    return CadStage(morph, MATERIAL, ports, ports, held=held, modes=4)


@pytest.mark.parametrize("held", [(), ("near",)])
def test_slopes_of_the_reduced_plant_are_those_of_differences(held: tuple[str, ...]) -> None:
    """Of its response, which no choice of coordinates or signs enters, and of its eigenvalues."""
    stage = stretched(held)
    plant = plant_of_stage(stage, ("thickness", "length"))
    theta, width = np.array([0.019, 0.31]), np.array([0.008, 0.12])
    here = mechanics(plant, theta)
    s = 2j * np.pi * 400.0

    def response(system: object) -> np.ndarray:
        inverse = np.linalg.inv(system.K + s**2 * system.M)
        return system.C @ inverse @ system.B

    inverse = np.linalg.inv(here.K + s**2 * here.M)
    for i in range(2):
        dM, _, dK, dB, dC = (item[i] for item in here.derivatives)
        exact = dC @ inverse @ here.B + here.C @ inverse @ dB
        exact = exact - here.C @ inverse @ (dK + s**2 * dM) @ inverse @ here.B
        step = 5e-4 * width[i] * np.eye(2)[i]
        above, below = (plant.values(theta + sign * step) for sign in (1.0, -1.0))
        differences = (response(above) - response(below)) / (2.0 * step[i])
        assert np.abs(differences - exact).max() < 1e-5 * np.abs(exact).max()
        slopes = np.diag(dK)[-4:] - np.diag(here.K)[-4:] * np.diag(dM)[-4:]
        moved = (np.diag(above.K) - np.diag(below.K))[-4:] / (2.0 * step[i])
        size = np.diag(here.K)[-4:] / width[i]  # sideways a slope is small beside its eigenvalue
        assert np.all(np.abs(moved - slopes) < 1e-5 * np.maximum(size, np.abs(slopes)))


def test_mass_and_its_slope() -> None:
    """The block's mass is in proportion to both lengths."""
    plant = plant_of_stage(stretched(), ("thickness", "length"))
    mass = 2700.0 * 0.8 * LENGTH * SIDE**2
    theta = (0.022, 0.33)
    assert hardware_cost(plant, theta) == pytest.approx(1.1 * 1.1 * mass)
    slope = np.array(plant.hardware.jacobian()(theta, 0.0, [])[0]).ravel()
    assert slope == pytest.approx([1.1 * mass / SIDE, 1.1 * mass / LENGTH])
    assert constraint_values(plant, theta).size == 0


def test_rigid_body_motions_are_about_the_centre_of_gravity() -> None:
    """M of the six motions is diag(m, m, m) and the inertia about the centre, which is apart."""
    stage = stretched()
    M = stage.mechanics((0.3, 0.02)).M[:6, :6]
    assert M[:3, :3] == pytest.approx(M[0, 0] * np.eye(3), abs=1e-12)
    assert np.abs(M[:3, 3:]).max() < 1e-12 * M[0, 0]
    assert np.linalg.eigvalsh(M[3:, 3:]).min() > 0.0


def test_a_linear_function_is_its_own_extension() -> None:
    points, tets = block((4, 3, 3))
    inside = np.all((points > 1e-9) & (points < [LENGTH - 1e-9, SIDE - 1e-9, SIDE - 1e-9]), axis=1)
    rim = np.flatnonzero(~inside)
    A = np.random.default_rng(0).standard_normal((3, 3))
    np.testing.assert_allclose(extend(points, tets, rim, points[rim] @ A), points @ A, atol=1e-13)
    side = face(points, tets, 0.0)  # triangles in space
    corners = np.unique(side)
    edge = corners[(points[corners, 1:] < 1e-9).any(1) | (points[corners, 1:] > SIDE - 1e-9).any(1)]
    assert edge.size < corners.size
    on_side = extend(points, side, edge, points[edge] @ A)[corners]
    np.testing.assert_allclose(on_side, points[corners] @ A, atol=1e-13)


def test_a_morph_is_read_as_written(tmp_path) -> None:
    morph = stretched().morph
    write_morph(morph, tmp_path / "m.npz")
    again = read_morph(tmp_path / "m.npz")
    assert (again.names, again.error, set(again.faces)) == (morph.names, 0.0, {"near", "far"})
    theta = (0.25, 0.02)
    np.testing.assert_array_equal(again.points(theta), morph.points(theta))
    np.testing.assert_array_equal(again.velocities(theta), morph.velocities(theta))
    (tmp_path / "x.npz").write_bytes(b"no archive")
    with pytest.raises(PlantError, match="is not a morphed mesh"):
        read_morph(tmp_path / "x.npz")


def test_an_element_inside_out_is_reported() -> None:
    with pytest.raises(PlantError, match=r"inside out at length=-0\.3"):
        stretched().morph.points((-0.3, 0.02))


@pytest.mark.parametrize("held", [(), ("near",)])
def test_pictures_show_the_modes_on_a_closed_surface(held: tuple[str, ...]) -> None:
    stage = stretched(held)
    shapes = plant_of_stage(stage, ("thickness", "length")).shapes
    assert shapes is not None
    found, theta = shapes((0.019, 0.31), 4), (0.31, 0.019)
    one, two, three = found.points[found.faces[:, :3]].transpose(1, 0, 2)
    volume = np.einsum("qi,qi->", one, np.cross(two, three)) / 6.0
    assert volume == pytest.approx(stage.mass(theta) / MATERIAL.density, rel=1e-12)
    hertz = [mode.frequency for mode in found.modes]
    modal = stage.mechanics(theta, derivatives=False)
    known = np.sqrt(np.diag(modal.K)[-4:]) / (2.0 * np.pi)
    np.testing.assert_allclose(hertz, known, rtol=1e-9)
    read = modal.C[:, -4:]
    far, near = (np.isclose(found.points[:, 0], x) for x in (found.points[:, 0].max(), 0.0))
    for i, mode in enumerate(found.modes):
        size = np.abs(mode.displacement).max()
        assert (np.abs(mode.displacement[near]).max() == 0.0) == bool(held)
        ends = mode.displacement[far].mean(axis=0)  # of corners, not over the face
        assert abs(abs(ends[2]) - abs(read[0, i])) < 0.05 * size


def test_the_drawing_shows_the_edges_of_a_bar_of_both_designs() -> None:
    """A bar has twelve edges, however many elements it has, and the box around them is its own."""
    stage = stretched()
    drawing = plant_of_stage(stage, ("thickness", "length")).drawing
    assert drawing is not None
    figure = drawing({"start": (0.019, 0.31), "end": (0.02, 0.3)})
    assert isinstance(figure.drawing, Lines)
    for row, up in zip(figure.drawing.rows, (1, 2), strict=True):
        for panel, theta in zip(row, ((0.31, 0.019), (0.3, 0.02)), strict=True):
            points = 1e3 * stage.morph.points(theta)
            (edges,) = panel.curves
            lines = np.stack([edges.x, edges.y], axis=1).reshape(-1, 3, 2)[:, :2]
            np.testing.assert_allclose(lines.min(axis=(0, 1)), points[:, [0, up]].min(axis=0))
            np.testing.assert_allclose(lines.max(axis=(0, 1)), points[:, [0, up]].max(axis=0))
            assert len(lines) == 4 * (6 + 2 + 2)  # as many elements lie along the edges
    mass = stage.mass((0.31, 0.019))
    assert figure.tables[0].rows[0] == ("start", *figure.tables[0].rows[0][1:4], mass)
