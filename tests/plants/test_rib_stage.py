"""The stage's finite elements: theory, tables, closed forms, an independent assembly, options."""

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from oracles.helpers import HZ

from ccd_casadi.extensions.rib_stage.geometry import (
    COARSE,
    FINE,
    LOWER,
    UPPER,
    Geometry,
    Mesh,
    MeshOrder,
    PointMass,
    build_mesh,
    has_square_symmetry,
    line_nodes,
    mass_properties,
    plain,
    rigid_fields,
    rigid_values,
)
from ccd_casadi.extensions.rib_stage.model import (
    ModeCount,
    RibStage,
    discretisation,
    orthonormal_directions,
)
from ccd_casadi.extensions.rib_stage.pictures import mode_shapes
from ccd_casadi.extensions.rib_stage.stage_modes import functionals, groups_of, spectrum
from ccd_casadi.plants.finite_elements import Material, StageError
from ccd_casadi.plants.plant import Mechanics

Array = np.ndarray
A = tuple(1e-3 * np.array([1.0, 3.0, 8.0, 8.0, 16.806, 67.5]))
B = tuple(1e-3 * np.array([1.0, 3.0, 4.2446, 4.0588, 11.917, 74.974]))
MIDDLE = tuple(1e-3 * np.array([2.0, 5.0, 5.5, 4.0, 12.0, 80.0]))
# a mesh of 38k displacements of another program; CalculiX beside it is within 0.7 %
TABLE = {
    A: [250.00, 820.27, 907.18, 933.17, 933.17, 1512.95, 1546.83, 1557.79, 1557.79, 1707.86],
    B: [110.50, 573.35, 616.48, 655.78, 655.78, 1126.09, 1381.44, 1381.44, 1433.08, 1445.52],
}
LETTERS = {
    A: ["AA", "SS", "SS", "SA", "SA", "SS", "AA", "SA", "SA", "SS"],
    B: ["AA", "SS", "SS", "SA", "SA", "SS", "SA", "SA", "AA", "AA"],
}
TWIST = {A: 36.4, B: 51.0}
LOPSIDED = Geometry(point_masses=(PointMass(0.1, 0.12, 0.05), PointMass(-0.13, 0.02, 0.03)))


def response(system: Mechanics, omega: float) -> Array:
    return system.C @ np.linalg.solve(system.K - omega**2 * system.M, system.B)


# ---- frequencies ------------------------------------------------------------------------------


@pytest.mark.parametrize("theta", [A, pytest.param(B, marks=pytest.mark.slow)], ids=["a", "b"])
def test_frequencies_and_twist_are_those_of_the_tables(theta) -> None:
    stage = RibStage(truncation="frequency", outputs="modal4")
    modes = stage.frequencies(theta)[3:]
    found = [mode.frequency for mode in modes]
    np.testing.assert_allclose(found, TABLE[theta], rtol=1e-2)
    letters = [mode.sector for mode in modes]
    # the two of a pair come in either order
    assert [s.replace("AS", "SA") for s in letters] == LETTERS[theta]
    # the twist's residue in its channel (1, -1, 1, -1)/2, per kg
    u = stage.mechanics(theta, derivatives=False).B[3]
    assert u[3] ** 2 == pytest.approx(TWIST[theta], rel=0.01)
    np.testing.assert_allclose(u[:3], 0.0, atol=1e-12)


def test_a_plain_plate_has_the_frequencies_of_thin_plate_theory() -> None:
    """λ² = ω L² √(ρh/D) of a free square plate: 13.2, 19.2, 24.4 (ν = 1/3)."""
    h, material = 4.2e-3, Material()
    stage = RibStage(order=plain(6, 2, 1), truncation="frequency")
    modes = stage.frequencies((h, 5e-3, 5e-3, 5e-3, 1e-6, 75e-3))[3:6]
    D = material.young * h**3 / (12.0 * (1.0 - material.poisson**2))
    scale = HZ * 0.3**2 * np.sqrt(material.density * h / D)
    np.testing.assert_allclose([scale * m.frequency for m in modes], [13.2, 19.2, 24.4], rtol=0.013)
    assert [m.name for m in modes] == ["B2", "B1", "A1"]


def test_the_pair_is_double_and_one_frequency_crossing_another_does_not_reorder_rows() -> None:
    stage = RibStage(order=COARSE)
    modes = stage.frequencies(A)
    names = [m.name for m in modes]
    assert (
        names
        == [m.name for m in stage.frequencies(B)]
        == [m.name for m in stage.frequencies(MIDDLE)]
    )
    values = {name: [m.frequency for m in modes if m.name == name] for name in names}
    assert values["SA"] == values["AS"]
    sparse = RibStage(order=COARSE, modes=ModeCount(1, 0, 1, 1, 1)).frequencies(B)
    assert [m.name for m in sparse[3:]] == ["A1", "B2", "A2", "SA", "AS"]


@pytest.mark.slow
@pytest.mark.parametrize("theta", [A, B, MIDDLE, (2.5e-3, 6e-3, 5e-3, 5e-3, 15e-3, 80e-3)])
def test_the_shipped_mesh_has_converged_to_one_per_cent(theta) -> None:
    finest = MeshOrder(
        bay=((0.025, 3), (0.95, 7), (0.025, 3)), rib=((1.0, 5),), height=((0.04, 3), (0.96, 4))
    )
    here, fine, limit = (
        np.array(
            [m.frequency for m in RibStage(order=o, truncation="frequency").frequencies(theta)]
        )
        for o in (RibStage().order, FINE, finest)
    )
    np.testing.assert_allclose(here[3:], limit[3:], rtol=1e-2)
    np.testing.assert_allclose(fine[3:], limit[3:], rtol=4e-3)
    assert (here[3:] >= limit[3:]).all()


# ---- closed forms -----------------------------------------------------------------------------


def test_mass_of_the_published_points() -> None:
    stage = RibStage()
    assert stage.hardware(A)[0] == pytest.approx(1.0189, abs=5e-5)
    assert stage.hardware(B)[0] == pytest.approx(0.5900, abs=5e-5)


@pytest.mark.parametrize("geometry", [Geometry(), LOPSIDED], ids=["square", "lopsided"])
def test_mass_and_rigid_modes_of_the_mesh_are_exact(geometry) -> None:
    """Σ over rigid modes of u_z(p) u_z(q), from the mass matrix and in closed form."""
    stage = RibStage(geometry=geometry, order=COARSE)
    points = ((0.15, 0.15), (-0.07, 0.11), (0.02, -0.14), (0.0, 0.0))
    expected = rigid_values(rigid_fields(geometry, points), np.array(MIDDLE))[0]
    groups = groups_of(geometry)
    found = np.zeros((4, 4))
    count = 0
    for group in groups:
        item = spectrum(discretisation(stage), geometry, np.array(MIDDLE), group, 1)
        for image in group.images:
            F = functionals(discretisation(stage), image, np.array(MIDDLE), points)[0][:, 2]
            found += (F.T @ item.rigid) @ (item.rigid.T @ F)
            count += item.rigid.shape[1]
        np.testing.assert_allclose(
            item.rigid.T @ item.pencil.mass(item.rigid), np.eye(item.rigid.shape[1]), atol=1e-12
        )
        np.testing.assert_allclose(item.rigid.T @ item.pencil.mass(item.vectors), 0.0, atol=1e-9)
    assert count == 6
    np.testing.assert_allclose(found, expected.T @ expected, rtol=1e-9)


def test_inertia_of_design_b() -> None:
    body = mass_properties(Geometry(), B)
    assert body.inertia[0][0] == pytest.approx(4.81e-3, rel=2e-3)
    assert body.centre[2] == pytest.approx(4.30e-3, rel=2e-3)


def test_hardware_takes_casadi_symbols_and_the_box_keeps_its_bays() -> None:
    stage = RibStage()
    theta = ca.SX.sym("theta", 6)
    mass, rules = stage.hardware(theta)
    function = ca.Function("f", [theta], [mass, *rules.values()])
    number, numbers = stage.hardware(B)
    assert list(numbers) == ["bay_1", "bay_2"]
    np.testing.assert_allclose(
        [float(v) for v in function(np.array(B))], [number, *numbers.values()], rtol=1e-13
    )
    for corner in np.array(np.meshgrid(*zip(LOWER, UPPER, strict=True))).reshape(6, -1).T:
        assert max(stage.hardware(corner)[1].values()) < 0.0


# ---- an assembly that shares nothing but node coordinates --------------------------------------


def quadrature_matrices(mesh: Mesh, theta: Array, material: Material) -> tuple[Array, Array]:
    """Isoparametric K and M of the quarter by Gauss quadrature, dense."""
    x, n = mesh.coordinates(theta), 3 * mesh.nodes
    E, nu = material.young, material.poisson
    C = np.zeros((6, 6))
    C[:3, :3] = nu
    np.fill_diagonal(C[:3, :3], 1.0 - nu)
    C[3:, 3:] = 0.5 * (1.0 - 2.0 * nu) * np.eye(3)
    C *= E / ((1.0 + nu) * (1.0 - 2.0 * nu))
    K, M = np.zeros((n, n)), np.zeros((n, n))
    for block in mesh.blocks:
        lines = [np.polynomial.legendre.leggauss(p + 2) for p in block.orders]
        tables = []
        for p, (points, _) in zip(block.orders, lines, strict=True):
            nodes = 2.0 * line_nodes(p) - 1.0
            inverse = np.linalg.inv(np.vander(nodes, increasing=True))
            powers = np.vander(points, p + 1, increasing=True)
            slopes = np.hstack([np.zeros((len(points), 1)), powers[:, :-1] * np.arange(1, p + 1)])
            tables.append((powers @ inverse, slopes @ inverse))
        places = (3 * block.nodes[:, None] + np.arange(3)).ravel()
        K_e, M_e = np.zeros((len(places),) * 2), np.zeros((len(places),) * 2)
        for a, b, c in np.ndindex(*(len(w) for _, w in lines)):
            weight = lines[0][1][a] * lines[1][1][b] * lines[2][1][c]
            (Nx, Dx), (Ny, Dy), (Nz, Dz) = (
                (t[0][i], t[1][i]) for t, i in zip(tables, (a, b, c), strict=True)
            )
            N = np.einsum("i,j,k->ijk", Nx, Ny, Nz).ravel()
            local = np.stack(
                [
                    np.einsum("i,j,k->ijk", *f).ravel()
                    for f in ((Dx, Ny, Nz), (Nx, Dy, Nz), (Nx, Ny, Dz))
                ]
            )
            jacobian = local @ x[block.nodes]
            g = np.linalg.solve(jacobian, local)
            S = np.zeros((6, len(places)))
            for i in range(3):
                S[i, i::3] = g[i]
            for row, (i, j) in enumerate(((0, 1), (1, 2), (0, 2)), start=3):
                S[row, i::3], S[row, j::3] = g[j], g[i]
            volume = weight * np.linalg.det(jacobian)
            K_e += volume * S.T @ C @ S
            M_e += volume * material.density * np.kron(np.outer(N, N), np.eye(3))
        K[np.ix_(places, places)] += K_e
        M[np.ix_(places, places)] += M_e
    return K, M


def test_the_affine_sum_is_the_matrix_assembled_by_quadrature() -> None:
    order = plain(2, 2, 2)
    stage = RibStage(order=order)
    disc, theta = discretisation(stage), np.array(MIDDLE)
    K, M = quadrature_matrices(build_mesh(order, 0.3), theta, Material())
    for sector in disc.sectors.values():
        T = sector.fold.matrix
        stiff, mass = disc.assembler.box_matrices(theta, 0.0)
        pair = sector.stiffness.fill(stiff), sector.mass.fill(mass)
        for found, whole in zip(pair, (K, M), strict=True):
            expected = 4.0 * (T.T @ (T.T @ whole).T)
            error = np.linalg.norm(found.toarray() - expected) / np.linalg.norm(expected)
            assert error < 1e-12
        np.testing.assert_allclose((T.T @ T).toarray(), np.eye(T.shape[1]), atol=1e-14)


# ---- the plant --------------------------------------------------------------------------------


def test_the_plant_is_modal_and_collocated() -> None:
    system = RibStage(order=COARSE).mechanics(B)
    assert system.M.shape == (13, 13)
    assert system.B.shape == (13, 4)
    np.testing.assert_array_equal(system.C, system.B.T)
    np.testing.assert_array_equal(system.M, np.eye(13))
    assert (np.diag(system.K)[:3] == 0.0).all()
    assert system.damping_ratio == 0.01
    mass = RibStage().hardware(B)[0]
    np.testing.assert_allclose(system.B[0], 1.0 / np.sqrt(mass), rtol=1e-13)


def test_outputs_decouple_the_square_stage_exactly() -> None:
    system = RibStage(order=COARSE, outputs="modal4").mechanics(B, derivatives=False)
    G = response(system, 90.0 * HZ)
    assert np.abs(G - np.diag(np.diag(G))).max() < 1e-12 * np.abs(np.diag(G)).min()
    three = RibStage(order=COARSE, outputs="rigid").mechanics(B, derivatives=False)
    np.testing.assert_allclose(np.diag(response(three, 90.0 * HZ)), np.diag(G)[:3], rtol=1e-12)
    corners = RibStage(order=COARSE).mechanics(B, derivatives=False)
    T = orthonormal_directions(RibStage().actuator_points, 4)
    np.testing.assert_allclose(T @ T.T, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(
        T @ response(corners, 500.0) @ T.T, response(system, 500.0), atol=1e-14
    )


def test_z_alone_has_the_modes_that_it_moves_and_is_that_channel() -> None:
    alone = RibStage(order=COARSE, outputs="z").mechanics(B)
    three = RibStage(order=COARSE, outputs="rigid").mechanics(B)
    assert alone.B.shape == (len(alone.K), 1)
    assert len(alone.K) < len(three.K)
    for omega in (500.0, 3000.0, 8000.0):
        z = response(alone, omega)[0, 0]
        np.testing.assert_allclose(z, response(three, omega)[0, 0], rtol=1e-9)
    for own, whole in zip(alone.derivatives[3:], three.derivatives[3:], strict=True):
        assert own.size < whole.size
    heavy = Geometry(point_masses=(PointMass(0.02, 0.0, 0.05),))
    with pytest.raises(StageError, match="z moves tip or tilt"):
        RibStage(geometry=heavy, order=COARSE, outputs="z").mechanics(B)


@pytest.mark.parametrize(
    ("points", "words"),
    [((), "give one point or more"), (((np.nan, 0.0), (0.1, 0.1), (0.1, 0.0)), "off the stage")],
)
def test_points_that_are_none_are_refused(points: tuple, words: str) -> None:
    with pytest.raises(StageError, match=words):
        RibStage(sensors=points)


def test_signs_hold_along_a_path() -> None:
    stage = RibStage(order=COARSE)
    path = [stage.mechanics(theta, derivatives=False).B for theta in np.linspace(A, B, 7)]
    for before, after in itertools.pairwise(path):
        seen = np.linalg.norm(before, axis=1) > 0.5
        assert (np.einsum("ij,ij->i", before, after)[seen] > 0.0).all()


def test_a_whole_model_without_symmetry_is_the_sum_of_its_sectors() -> None:
    """A point mass of a microgram breaks the symmetry in name only."""
    speck = Geometry(point_masses=(PointMass(0.1, 0.12, 1e-9),))
    whole = RibStage(geometry=speck, order=COARSE)
    parts = RibStage(order=COARSE, truncation="frequency")
    np.testing.assert_allclose(
        [m.frequency for m in whole.frequencies(MIDDLE)],
        [m.frequency for m in parts.frequencies(MIDDLE)],
        rtol=1e-7,
    )
    for omega in (300.0, 1500.0, 6000.0):
        expected = response(parts.mechanics(MIDDLE, derivatives=False), omega)
        found = response(whole.mechanics(MIDDLE, derivatives=False), omega)
        assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


def test_point_masses_in_a_square_keep_the_symmetry() -> None:
    """The same stage once as sectors, once as a whole broken by a speck."""
    four = tuple(PointMass(x, y, 0.05) for x in (-0.1, 0.1) for y in (-0.1, 0.1))
    sectors = RibStage(geometry=Geometry(point_masses=four), order=COARSE, truncation="frequency")
    speck = (*four, PointMass(0.05, 0.11, 1e-9))
    whole = RibStage(geometry=Geometry(point_masses=speck), order=COARSE)
    assert has_square_symmetry(sectors.geometry)
    assert not has_square_symmetry(whole.geometry)
    np.testing.assert_allclose(
        [m.frequency for m in whole.frequencies(MIDDLE)],
        [m.frequency for m in sectors.frequencies(MIDDLE)],
        rtol=1e-6,
    )


def test_a_moved_actuator_sees_the_same_modes_elsewhere() -> None:
    """B at a point is the mode shape there, in every quadrant."""
    spots = ((0.149, 0.15), (-0.06, 0.15), (-0.15, -0.07), (0.02, -0.01))
    stage = RibStage(order=COARSE, actuators=spots)
    here, there = (each.mechanics(B, derivatives=False) for each in (RibStage(order=COARSE), stage))
    np.testing.assert_array_equal(there.C, here.C)
    system = by_frequency(stage).mechanics(B, derivatives=False)
    nearby = ((0.15, 0.15), (-0.06, 0.15), (-0.15, -0.07), (0.02, -0.01))
    shapes = mode_shapes(stage, B, 6)
    floor = shapes.points[:, 2] == 0.0
    for mode in shapes.modes:
        for column, spot in enumerate(nearby):
            distance = np.linalg.norm(shapes.points[floor, :2] - spot, axis=1)
            near = np.argmin(distance)
            size = np.abs(mode.displacement[:, 2]).max()
            slack = 0.02 + 12.0 * distance[near] / 0.15 + (0.1 if column == 0 else 0.0)
            here = mode.displacement[floor, 2][near]
            assert abs(system.B[2 + mode.numbers[0], column] - here) < slack * size


def by_frequency(stage: RibStage) -> RibStage:
    """The stage with the lowest modes of all, as its pictures number them."""
    return replace(stage, truncation="frequency", modes=ModeCount(12, 0, 0, 0, 0))


# ---- pictures, caching, refusals ----------------------------------------------------------------


@pytest.mark.parametrize("geometry", [Geometry(), LOPSIDED], ids=["square", "lopsided"])
def test_mode_shapes_close_over_the_surface(geometry) -> None:
    stage = RibStage(geometry=geometry, order=COARSE)
    shapes = mode_shapes(stage, B, 6)
    system = by_frequency(stage).mechanics(B, derivatives=False)
    assert shapes.faces.max() < len(shapes.points)
    assert len(np.unique(shapes.points.round(9), axis=0)) == len(shapes.points)
    for mode in shapes.modes:
        assert shapes.points.shape == mode.displacement.shape
        for column, corner in enumerate(stage.actuator_points):
            at = np.linalg.norm(shapes.points - [*corner, 0.0], axis=1) < 1e-12
            found = mode.displacement[at, 2]
            row = system.B[2 + mode.numbers[0]]
            np.testing.assert_allclose(found, row[column], rtol=1e-6, atol=1e-7)
    # the divergence theorem on outward quads gives the volume
    corners = shapes.points[shapes.faces]
    normal = 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    volume = np.einsum("qi,qi->", corners.mean(axis=1), normal) / 3.0
    assert volume * 2700.0 == pytest.approx(RibStage().hardware(B)[0], rel=1e-9)
