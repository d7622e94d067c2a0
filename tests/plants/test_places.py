"""Forces and sensors between nodes: exact on what it is exact on, slopes, masses, the case file."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles.helpers import few
from scipy.linalg import eigh

from ccd_casadi.cases.case import CaseError, case_to_toml, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import plant_of, scaled_plant
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.plants.nodes import NodeInterpolation
from ccd_casadi.plants.places import Places, place_ports
from ccd_casadi.plants.plant import Plant, build_plant, constraint_values, hardware_cost, mechanics
from ccd_casadi.support.errors import PlantError

CASE = Path(__file__).parents[2] / "examples" / "placed_motors" / "case.toml"
HOLES = CASE.with_name("holes.toml")
GRID = tuple((x, y) for x in np.linspace(-0.3, 0.3, 5) for y in np.linspace(-0.2, 0.2, 4))
RIGID = np.array([[1.0, x, y] for x, y in GRID]).T
KG, INERTIA = 3.0, (0.05, 0.09)


def beam_of_nodes(seed: int) -> Plant:
    """A rigid plate with four smooth modes on it, whose stiffness a θ scales."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(2.0, 6.0, (4, 2))
    shapes = np.cos(np.array(GRID) @ waves.T + rng.uniform(0.0, 3.0, 4)).T

    def model(theta):
        k = theta["k"]
        return {
            "mass": ca.diag([KG, *INERTIA, 1.0, 1.0, 1.0, 1.0]),
            "stiffness": k * ca.diag([0.0, 0.0, 0.0, 1e5, 3e5, 6e5, 9e5]),
            "damping_ratio": 0.01,
            "input": ca.vertcat(ca.DM(RIGID), k * ca.DM(shapes)),
            "output": ca.DM([[1.0, 0, 0, 0, 0, 0, 0]]),
            "hardware_cost": k,
        }

    return build_plant(model, ["k"], {})


POINTS = (("x", "y"), ("-x", 0.1), (0.05, "-y"))
inside = st.tuples(st.floats(-0.25, 0.25), st.floats(-0.15, 0.15))


@few(8)
@given(inside, st.integers(0, 99))
def test_the_spline_holds_nodes_and_second_degrees(at: tuple[float, float], seed: int) -> None:
    between, point = NodeInterpolation(np.array(GRID)), np.array(at)
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(), rng.normal(size=2), rng.normal(size=(2, 2))

    def field(p: np.ndarray) -> float:
        return float(a + b @ p + p @ c @ p)

    weights, slopes = between.at(point)
    values = np.array([field(np.array(node)) for node in GRID])
    assert weights @ values == pytest.approx(field(point), abs=1e-9)
    assert slopes @ values == pytest.approx(b + (c + c.T) @ point, abs=1e-8)
    node = int(rng.integers(len(GRID)))
    assert between.at(np.array(GRID[node]))[0] == pytest.approx(np.eye(len(GRID))[node], abs=1e-9)
    assert between.left_out(values[None], point[None]) < 1e-8


@few(8)
@given(inside, st.integers(0, 99))
def test_slopes_are_those_of_differences(at: tuple[float, float], seed: int) -> None:
    """To 1e-6, of M, K, B and C to stiffness and positions."""
    places = Places(GRID, POINTS, POINTS[:2], 0.4, 0.1)
    plant = place_ports(beam_of_nodes(seed), places, ("x", "k", "y"))
    theta = np.array([at[0], 1.3, at[1]])
    compare_slopes(plant, theta)


def compare_slopes(plant: Plant, theta: np.ndarray) -> None:
    """To 1e-6, besides what differences of two steps differ by: where modes come close, much."""
    system, steps = mechanics(plant, theta), (5e-4, 1e-3)
    for i, unit in enumerate(np.eye(len(theta))):
        near = [[mechanics(plant, theta + k * h * unit) for k in (-2, -1, 1, 2)] for h in steps]
        for part, exact in zip("MDKBC", system.derivatives, strict=True):
            found, coarse = (
                np.tensordot([1, -8, 8, -1], [getattr(one, part) for one in four], 1) / (12 * h)
                for four, h in zip(near, steps, strict=True)
            )
            size = max(1.0, float(np.abs(exact[i]).max()))
            rough = np.abs(found - coarse).max()
            assume(rough < 1e-3 * size)
            assert np.abs(found - exact[i]).max() < 1e-6 * size + rough, (part, i)


SIX = (("x", "y"), ("-x", 0.13), (0.05, "-y"), (-0.2, -0.1), (0.22, 0.1), (-0.1, 0.02))


@few(8)
@given(inside, st.integers(0, 99))
def test_axes_leave_quiet_modes_alone_and_have_slopes(at: tuple[float, float], seed: int) -> None:
    """Forces of length 1 along 1, x, y and a damped mode, none on the quiet one."""
    places = Places(GRID, SIX, SIX, 0.4, 0.1, axes=True, quiet=(1,), damped=(3,))
    free = place_ports(beam_of_nodes(seed), replace(places, axes=False), ("x", "k", "y"))
    plant = place_ports(beam_of_nodes(seed), places, ("x", "k", "y"))
    theta = np.array([at[0], 1.3, at[1]])
    system, apart = mechanics(plant, theta), mechanics(free, theta)
    assert (plant.inputs, plant.outputs, system.B.shape) == (4, 4, (7, 4))
    lam, modes = eigh(system.K, system.M)
    quiet = modes[:, 3]
    assert np.abs(quiet @ system.B).max() < 1e-9 * np.abs(quiet @ apart.B).max()
    assert np.abs(system.C @ quiet).max() < 1e-9 * np.abs(apart.C @ quiet).max()
    V = np.linalg.lstsq(apart.B, system.B, rcond=None)[0]
    assert pytest.approx(np.eye(4), abs=1e-8) == V.T @ V
    if np.diff(lam[3:]).min() > 0.02 * lam[3]:  # where two modes come close slopes are steep
        compare_slopes(plant, theta)


CORNERS = ((0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2), (0.3, -0.2))


@few(8)
@given(inside, st.integers(0, 99), st.sampled_from([3, 4]))
def test_loads_at_reference_points_move_the_body_as_there_and_have_slopes(
    at: tuple[float, float], seed: int, count: int
) -> None:
    """By the least forces that do it; of three points without twist."""
    corners = CORNERS[:count]
    places = Places(GRID, SIX, SIX[1:], 0.4, 0.1, reference=corners)
    free = place_ports(beam_of_nodes(seed), replace(places, reference=()), ("x", "k", "y"))
    plant = place_ports(beam_of_nodes(seed), places, ("x", "k", "y"))
    theta = np.array([at[0], 1.3, at[1]])
    system, apart = mechanics(plant, theta), mechanics(free, theta)
    assert (plant.inputs, plant.outputs, system.B.shape) == (count, count, (7, count))
    there = np.array([[1.0, *p] for p in corners]).T
    assert system.B[:3] == pytest.approx(there, abs=1e-9)
    assert system.C[:, :3] == pytest.approx(there.T, abs=1e-9)
    forces = np.linalg.lstsq(apart.B, system.B, rcond=None)[0]
    motions = apart.B[:3].T
    if count == 4:
        motions = np.column_stack([motions, motions[:, 1] * motions[:, 2]])
        corner = np.prod(there[1:], axis=0)
        assert motions[:, 3] @ forces == pytest.approx(corner, abs=1e-9)
    assert motions @ np.linalg.lstsq(motions, forces, rcond=None)[0] == pytest.approx(forces)
    compare_slopes(plant, theta)


@few(6)
@given(inside, st.integers(0, 99), st.sampled_from([{"axes": True}, {"reference": CORNERS}]))
def test_an_actuator_that_is_not_there_is_as_if_never_given(
    at: tuple[float, float], seed: int, how: dict[str, Any]
) -> None:
    """Its mass too; in part it has slopes; more than are to be chosen break a rule."""
    flags = tuple(f"p{i}" for i in range(6))
    whole = Places(GRID, SIX, SIX, 0.4, 0.1, present=flags, choose=4, **how)
    some = replace(whole, actuators=tuple(SIX[i] for i in (0, 2, 3, 5)), present=(), choose=0)
    plant = place_ports(beam_of_nodes(seed), whole, ("x", "k", "y", *flags))
    four = place_ports(beam_of_nodes(seed), some, ("x", "k", "y"))
    theta = np.array([at[0], 1.3, at[1]])
    x, y = np.array([at, (0.05, -at[1]), SIX[3], SIX[5]]).T
    assume(np.linalg.cond(np.stack([1.0 + 0.0 * x, x / 0.3, y / 0.2, x * y / 0.06])) < 100.0)
    chosen = mechanics(plant, np.append(theta, [1, 0, 1, 1, 0, 1]))
    expected = mechanics(four, theta)
    for part in "MKBC":
        there = getattr(expected, part)
        assert getattr(chosen, part) == pytest.approx(there, abs=1e-7 * np.abs(there).max()), part
    parts = np.append(theta, [0.7, 0.4, 0.9, 0.5, 0.6, 0.8])
    compare_slopes(plant, parts)
    assert plant.constraint_names[-1] == "actuators chosen"
    assert constraint_values(plant, parts)[-1] == pytest.approx(3.9 / 4.0 - 1.0)
    dearer = place_ports(beam_of_nodes(seed), replace(whole, actuator_cost=0.5), plant.names)
    assert hardware_cost(dearer, parts) == pytest.approx(hardware_cost(plant, parts) + 0.5 * 3.9)


@few(8)
@given(inside, st.floats(0.0, 2.0))
def test_a_mass_moves_centre_and_inertia_as_by_parallel_axes(
    at: tuple[float, float], kg: float
) -> None:
    plant = place_ports(beam_of_nodes(0), Places(GRID, POINTS, (), kg), ("k", "x", "y"))
    M = mechanics(plant, (1.0, *at)).M[:3, :3]
    r = np.array([[1.0, *p] for p in (at, (-at[0], 0.1), (0.05, -at[1]))])
    assert pytest.approx(np.diag([KG, *INERTIA]) + kg * r.T @ r, abs=1e-9) == M
    assert mechanics(plant, (1.0, *at)).C.shape == (1, 7)  # without sensors the plant's own


def test_distances_are_kept_where_theta_moves_them() -> None:
    corners = (("r", "r"), ("-r", "-r"), (0.0, 0.1), (0.1, 0.0))
    plant = place_ports(beam_of_nodes(0), Places(GRID, corners, corners, apart=0.2), ("k", "r"))
    assert len(plant.constraint_names) == 5  # of six pairs one stands still; sensors are the same
    assert constraint_values(plant, (1.0, 0.1))[0] == pytest.approx(1.0 - 0.08 / 0.04)


def test_what_does_not_match_is_one_sentence() -> None:
    plant = beam_of_nodes(0)
    line = tuple((x, 0.0) for x in np.linspace(0.0, 1.0, len(GRID)))
    for places, words in (
        (Places(GRID[:-1], POINTS), "19, the plant has 20 inputs"),
        (Places(GRID, (("x",),)), "has 1 coordinates, a node 2"),
        (Places(GRID, (("x", 0.21),)), "beyond the nodes"),
        (Places(line, POINTS), "on one line"),
        (Places(GRID, POINTS, POINTS, reference=CORNERS), "no fewer actuators and sensors"),
        (Places(GRID, POINTS, POINTS, reference=CORNERS[:2]), "3 or 4 points"),
        (Places(GRID, POINTS, POINTS, axes=True, present=("k",), choose=3), "for each actuator"),
    ):
        with pytest.raises(PlantError, match=words):
            place_ports(plant, places, ("k", "x", "y"))


def test_the_case_moves_with_its_places(tmp_path: Path) -> None:
    """A position by its name or as a number is one plant; what a run writes needs no file."""
    case = load_case(CASE)
    whole = problem_of(case)
    text = case_to_toml(case)
    assert load_case_of(text) == case.places
    with pytest.raises(CaseError, match=r"theta\.b: is missing"):
        parse_case(tomllib.loads(text.replace("[theta.b]", "[theta.other]")))
    data = tomllib.loads(text.replace('"b"', "0.09").replace('"-b"', "-0.09"))
    del data["theta"]["b"]
    held = problem_of(parse_case(data))
    at = dict(zip(whole.names, whole.start, strict=True)) | {"b": 0.09}
    data = tomllib.loads(text)
    data["theta"]["b"] = {"fixed": 0.09}
    fixed = problem_of(parse_case(data))
    other = mechanics(plant_of(whole), [at[name] for name in whole.names])
    for one in (held, fixed):
        assert plant_of(one).names == one.names == ("a", "t")
        system = mechanics(plant_of(one), [at[name] for name in one.names])
        for part in "MKBC":
            expected = getattr(other, part)
            size = np.abs(expected).max()
            assert np.abs(getattr(system, part) - expected).max() <= 1e-12 * size
        assert one.identity() != whole.identity()


def load_case_of(text: str):  # what is written is read as it was
    return parse_case(tomllib.loads(text)).places


STROKE = CASE.parent.parent / "gantry_stroke" / "case.toml"


def test_a_parameter_that_varies_is_one_of_the_box() -> None:
    """Not in θ, with slopes of its own, and at its start the model itself."""
    problem = problem_of(load_case(STROKE))
    assert problem.names == ("h",)
    assert problem.source.held == {"wall": 4.5e-3, "at": 0.1}
    uncertain = uncertain_plant(problem, problem.start)
    assert uncertain.names == ("resonance_shift", "theta.at")
    assert uncertain.nominal.tolist() == [0.0, 0.1]
    assert uncertain.box.tolist() == [[-0.02, -0.3], [0.02, 0.3]]
    model, moved = uncertain.plant(uncertain.nominal), uncertain.plant(np.array([0.01, -0.2]))
    omega = np.array([0.1, 0.7, 2.0])
    assert model.system.response(omega) == pytest.approx(
        scaled_plant(problem, problem.start).system.response(omega), rel=1e-9
    )
    assert moved.natural[1:] != pytest.approx(1.01 * model.natural[1:], rel=1e-3)
    assert len(model.dA) == 1  # to h, not to where the carriage is
    point, step = np.array([0.01, 0.15]), 1e-4
    near = [uncertain.plant(point + k * step * np.eye(2)[1]).plant_si() for k in (-2, -1, 1, 2)]
    omega = 2.0 * np.pi * np.array([3.0, 40.0, 150.0, 330.0])
    found = np.tensordot([1, -8, 8, -1], [one.response(omega) for one in near], 1) / (12 * step)
    sloped = uncertain.with_slopes(point)
    dA, dB, dC = (part[1] for part in (sloped.dA, sloped.dB, sloped.dC))
    for i, w in enumerate(omega / sloped.omega_0):
        R = np.linalg.inv(1j * w * np.eye(len(sloped.A)) - sloped.A)
        slope = dC @ R @ sloped.B + sloped.C @ R @ (dA @ R @ sloped.B + dB)
        scale = (sloped.C @ R @ sloped.B) / sloped.plant_si().response(omega[[i]])[0]
        assert slope / scale == pytest.approx(found[i], rel=1e-5)


def test_what_varies_needs_sections_and_bounds() -> None:
    data = tomllib.loads(STROKE.read_text())
    whole = parse_case(data, STROKE)
    text = case_to_toml(whole)
    assert parse_case(tomllib.loads(text), STROKE).fixed == whole.fixed
    data["theta"]["at"]["integer"] = True
    with pytest.raises(CaseError, match=r"theta\.at\.varies: has no place beside integer"):
        parse_case(data, STROKE)
    del data["theta"]["at"]["integer"], data["controller"], data["loop"], data["robust"]
    with pytest.raises(CaseError, match=r"theta\.at\.varies: needs controller\.structure"):
        parse_case(data, STROKE)


@pytest.mark.parametrize("key", ["quiet", "damped"])
def test_one_controller_has_no_directions_for_modes_of_several_plants(key: str) -> None:
    """Forces that leave a mode of one plant alone drive that of another."""
    data = tomllib.loads(case_to_toml(load_case(CASE)))
    data["places"][key] = [1]
    parse_case(data, CASE)
    with pytest.raises(CaseError, match=rf"places\.{key}: .* drop it, or these plants"):
        parse_case(data | {"robust": data["robust"] | {"plants": [{}]}}, CASE)
    varies = {"lower": 0.03, "upper": 0.11, "start": 0.07, "varies": True}
    with pytest.raises(CaseError, match=rf"places\.{key}: .* drop it, or these plants"):
        parse_case(data | {"theta": data["theta"] | {"b": varies}}, CASE)


@pytest.mark.parametrize(
    ("entry", "refused"),
    [
        ({"values": [0, 1]}, False),
        ({"fixed": 1.0}, False),
        ({"lower": 0, "upper": 1, "integer": True}, False),
        ({"lower": 0.0, "upper": 1.0}, True),
        ({"values": [0, 0.5, 1]}, True),
        ({"fixed": 0.4}, True),
    ],
)
def test_an_actuator_is_there_or_not(entry: dict[str, Any], refused: bool) -> None:
    """A share of one would make a verified design that nobody can build."""
    data = tomllib.loads(HOLES.read_text())
    data["theta"]["p5"] = entry
    if refused:
        with pytest.raises(CaseError, match=r"theta\.p5: may be other than 0 and 1"):
            parse_case(data, HOLES)
    else:
        parse_case(data, HOLES)
    data["places"]["present"][4] = "p4"
    with pytest.raises(CaseError, match=r"places\.present: has p4 twice"):
        parse_case(data, HOLES)
