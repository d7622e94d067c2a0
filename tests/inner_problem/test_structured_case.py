"""The case file of a fixed structure: its keys, its mistakes, and that today's cases stay."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.case_documents import TWO_MASS
from oracles.helpers import random_plant

from ccd_casadi.cases.case import CaseError, case_to_toml, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.tables import Case
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    plants_of,
    structure_of,
    uncertain_plant,
    with_channels,
)
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.sampling.units import problem_hash

RUNS = Path(__file__).parents[2] / "runs"
SECTIONS = '\n[controller]\nstructure = "sections"\n'


def written(folder: Path, *added: str, inner: str = "") -> Case:
    text = TWO_MASS.read_text().replace("[inner]", f"[inner]\n{inner}")
    path = folder / "case.toml"
    path.write_text(text + "\n".join(added))
    return load_case(path)


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("two_mass", "20c25cde464f92fd12d04d0c55cd922573004c8cb74c82d55c3ee40ba5bf37c0"),
        ("rib_stage", "0e3fa7213aadb1a046c1c6e86a0b6a862e34d367924f3673169e1c72a2bff9db"),
    ],
)
def test_samples_of_mixed_sensitivity_keep_their_keys(name: str, digest: str) -> None:
    """The hash of before the sections, but for the numerics' own number: no key of theirs is in."""
    identity = problem_of(load_case(RUNS / f"{name}.toml")).identity()
    assert problem_hash(identity | {"numerics": 5}) == digest


def test_the_shipped_case_comes_back_and_says_what_it_means(tmp_path: Path) -> None:
    case = load_case(RUNS / "two_mass_built.toml")
    again = tmp_path / "again.toml"
    again.write_text(case_to_toml(case))
    assert replace(load_case(again), path=case.path) == case
    problem = problem_of(case)
    assert problem.robust is None
    assert isinstance(problem.controller, StructuredProblem)
    assert problem.controller.structure.order == 8
    assert problem.controller.sampling is not None
    assert problem.controller.sampling.delay == pytest.approx(1e-4)
    bounds = bounds_of(problem)
    assert (bounds.S_max, bounds.shape, bounds.weighted_level) == (1.75, 1.1, 8.426)
    assert bounds.weights is not None
    assert bounds.weights.omega_T == problem.inner.omega_T[0]
    box = uncertain_plant(problem, problem.start).box
    assert box.tolist() == [[-0.03, 0.5], [0.03, 2.0]]
    assert len(plants_of(problem, problem.start)) == 5


def test_what_determines_a_design_determines_its_key(tmp_path: Path) -> None:
    changes = ("biquads = 3", "weighted_level = 8.0", "least_damping = 0.1", "starts = 7")
    cases = [written(tmp_path, SECTIONS + line) for line in ("", *changes)]
    cases.append(written(tmp_path, SECTIONS, inner="compliance_max = 1e-6"))
    cases.append(written(tmp_path, SECTIONS, "[loop]\nrate_hz = 8000.0"))
    cases.append(written(tmp_path, SECTIONS, "[robust]\ngain = 0.05"))
    hashes = [problem_hash(problem_of(case).identity()) for case in cases]
    assert len(set(hashes)) == len(hashes)


@pytest.mark.parametrize(
    ("words", "added"),
    [
        ("controller.lead: has an effect with", ("[controller]\nlead = 2",)),
        ("loop.rate_hz: has an effect with", ("[loop]\nrate_hz = 1e4",)),
        ("robust.gain: has an effect with", ("[robust]\ngain = 0.1",)),
        ("robust.design_at: has no effect on", (SECTIONS, '[robust]\ndesign_at = "high"')),
        ("give loop.rate_hz", (SECTIONS, "[loop]\ndelay_us = 10.0")),
        ("controller.structure: is 'pid'", ('[controller]\nstructure = "pid"',)),
        ("controller.integrator: is 1; give true or false", (SECTIONS + "integrator = 1",)),
        ("least_damping: has no effect with biquads = 0",
         (SECTIONS + "biquads = 0\nleast_damping = 0.1",)),
        ("there is no such file", (SECTIONS, '[robust]\nplants = ["none.toml"]')),
        ("controller.biquad: unknown key; did you mean biquads", (SECTIONS + "biquad = 1",)),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_with_a_remedy(
    tmp_path: Path, words: str, added: tuple[str, ...]
) -> None:
    with pytest.raises(CaseError) as caught:
        written(tmp_path, *added)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_option_sets_are_plants_of_the_set(tmp_path: Path) -> None:
    """Another damping ratio as an option set; a wrong key is told by its own name."""
    (tmp_path / "soft.toml").write_text("zeta = 0.02\n")
    case = written(tmp_path, SECTIONS, '[robust]\nplants = ["soft.toml"]')
    problem = problem_of(case)
    model, soft = plants_of(problem, (60.0, 60.0))[:2]
    assert soft.A.trace() < 1.5 * model.A.trace() < 0.0
    assert hardware_cost(plant_of(problem), (60.0, 60.0)) == 120.0
    moved = tmp_path / "run" / "case.toml"
    moved.parent.mkdir()
    moved.write_text(case_to_toml(case))
    assert problem_of(load_case(moved)).identity() == problem.identity()
    (tmp_path / "soft.toml").write_text("zetta = 0.02\n")
    with pytest.raises(CaseError, match="zetta"):
        written(tmp_path, SECTIONS, '[robust]\nplants = ["soft.toml"]')


AXES = """
def axes(theta):
    m = theta["m1"]
    return {"mass": [[m, 0], [0, 2 * m]], "stiffness": [[0, 0], [0, 0]],
            "damping_ratio": 0.01, "input": [[1, 0], [0, 1]],
            "output": OUTPUT, "hardware_cost": m}
"""


def two_axes(folder: Path, *added: str, output: str = "[[1, 0], [0, 1]]") -> Case:
    """Case study 1 with a plant of two rigid axes that do not touch each other."""
    (folder / "axes.py").write_text(AXES.replace("OUTPUT", output))
    text = TWO_MASS.read_text().split("[objective]")[1]
    plant = '[plant]\nfunction = "axes.py:axes"\n[theta.m1]\nlower = 55.0\nupper = 70.0\n'
    path = folder / "axes.toml"
    path.write_text(f"{plant}[objective]{text}{SECTIONS}" + "\n".join(added))
    return load_case(path)


def test_channels_of_a_plant_with_several_outputs(tmp_path: Path) -> None:
    """Found at the start and kept for every θ, or given; single ones with their own structure."""
    problem = with_channels(problem_of(two_axes(tmp_path, "[controller.channel.2]\nlead = 3")))
    structure = structure_of(problem)
    assert isinstance(structure, ChannelStructure)
    assert [own.lead for own in structure.structures] == [1, 3]
    assert np.abs(structure.decoupling.outputs).tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert structure_of(with_channels(replace(problem, start=(60.0,)))).names == structure.names
    given = two_axes(tmp_path, "[controller.channel.sum]\noutputs = [1, 1]",
                     "[controller.channel.difference]\noutputs = [2, -2]\nbiquads = 0")  # fmt: skip
    again = tmp_path / "again.toml"
    again.write_text(case_to_toml(given))
    assert replace(load_case(again), path=given.path) == given
    found = structure_of(problem_of(given))
    assert isinstance(found, ChannelStructure)
    assert found.decoupling.names == ("sum", "difference")
    assert found.decoupling.outputs == pytest.approx(np.array([[1, 1], [1, -1]]) / np.sqrt(2.0))
    hashes = [problem_hash(p.identity()) for p in (problem, problem_of(given))]
    assert len({*hashes, problem_hash(problem_of(two_axes(tmp_path)).identity())}) == 3


@pytest.mark.parametrize(
    ("words", "added", "output"),
    [
        ("many of one as of the other", (), "[[1, 1]]"),
        ("two.lead: is -1", ("[controller.channel.two]\nlead = -1",), "[[1, 0], [0, 1]]"),
        ("name one of them", ("[controller.channel.z]\nlead = 2",), "[[1, 0], [0, 1]]"),
        ("for every channel or for none",
         ("[controller.channel.1]\noutputs = [1, 0]", "[controller.channel.2]\nlead = 2"),
         "[[1, 0], [0, 1]]"),
        ("need a channel each, and 1 of these are given; add 1 more",
         ("[controller.channel.1]\noutputs = [1, 0]",), "[[1, 0], [0, 1]]"),
        ("a direction of 3 outputs, 1 of 2",
         ("[controller.channel.1]\noutputs = [1, 0]",
          "[controller.channel.2]\noutputs = [0, 1, 0]"),
         "[[1, 0], [0, 1]]"),
        ("has one output: drop", ("[controller.channel.1]\nlead = 2",), None),
        ("an effect with controller", ("[controller.channel.1]\nlead = 2",), ""),
    ],
)  # fmt: skip
def test_mistakes_about_channels_are_reported(
    tmp_path: Path, words: str, added: tuple[str, ...], output: str | None
) -> None:
    def made() -> Case:
        if output:
            return two_axes(tmp_path, *added, output=output)
        return written(tmp_path, *((SECTIONS,) if output is None else ()), *added)

    with pytest.raises(CaseError) as caught:
        problem_of(made())
    assert words in str(caught.value)


@pytest.mark.parametrize("modal", [True, False])
def test_derivatives_of_plants_with_single_modes_shifted(modal: bool) -> None:
    """Against differences of the transfer function, which knows no coordinates."""
    plant = random_plant(7, rigid=1, flexible=3, inputs=1, outputs=1, modal=modal)
    theta, h, s = np.array([0.4, 0.6]), 1e-5, 2j * np.pi * 60.0

    def shifted(at: np.ndarray) -> ScaledPlant:
        systems = (mechanics(plant, tuple(at)),)
        uncertain = UncertainPlant(systems, 1e6, 0.03, 0.1, (0.5, 2.0), 0.2)
        return uncertain.plant(np.array([0.02, 0.1, -0.05, 0.07, 1.5, 0.1]))

    def response(at: np.ndarray) -> complex:
        G = shifted(at).plant_si()
        return complex((G.C @ np.linalg.solve(s * np.eye(len(G.A)) - G.A, G.B))[0, 0])

    q = shifted(theta)
    R = np.linalg.inv(s / q.omega_0 * np.eye(len(q.A)) - q.A)
    for i in range(2):
        e = h * np.eye(2)[i]
        numeric = (response(theta + e) - response(theta - e)) / (2.0 * h)
        exact = q.dC[i] @ R @ q.B + q.C @ R @ q.dA[i] @ R @ q.B + q.C @ R @ q.dB[i]
        assert exact[0, 0] / q.force == pytest.approx(numeric, rel=1e-6)


@pytest.mark.parametrize("modal", [True, False])
def test_derivatives_of_a_plant_to_what_is_uncertain(modal: bool) -> None:
    """Of the transfer function, at a point of the box, against differences."""
    plant = random_plant(7, rigid=1, flexible=3, inputs=1, outputs=1, modal=modal)
    system = mechanics(plant, (0.4, 0.6))
    box = UncertainPlant((system,), 1e6, 0.03, 0.1, (0.5, 2.0), 0.2)
    point, h, s = np.array([0.02, 0.1, -0.05, 0.07, 1.5, 0.1]), 1e-5, 2j * np.pi * 60.0

    def response(at: np.ndarray) -> complex:
        G = box.plant(at).plant_si()
        return complex((G.C @ np.linalg.solve(s * np.eye(len(G.A)) - G.A, G.B))[0, 0])

    q = box.with_slopes(point)
    np.testing.assert_array_equal(q.A, box.plant(point).A)
    R = np.linalg.inv(s / q.omega_0 * np.eye(len(q.A)) - q.A)
    slopes = zip(q.dA, q.dB, strict=True)
    exact = np.array([(q.C @ R @ (dA @ R @ q.B + dB))[0, 0] for dA, dB in slopes])
    numeric = [(response(point + e) - response(point - e)) / (2.0 * h) for e in h * np.eye(6)]
    size = np.abs(numeric).max()
    np.testing.assert_allclose(exact / q.force, numeric, rtol=1e-6, atol=1e-8 * size)
    assert len(box.corners()) == 1 + 2**3  # the common shift, the modes together, the gain


def test_the_built_stage_has_its_channels_and_its_option_sets() -> None:
    problem = problem_of(load_case(RUNS / "rib_stage_built.toml"))
    structure = structure_of(problem)
    assert isinstance(structure, ChannelStructure)
    assert structure.decoupling.names == ("z", "tip", "tilt", "twist")
    assert structure.decoupling.orthogonal
    assert isinstance(problem.controller, StructuredProblem)
    options = [dict(item) for item in problem.controller.uncertainty.options]
    assert [item["modes"] for item in options] == [20, 20]
    assert options[0]["mesh"] == "fine"
    assert "point_masses" in options[1]
    assert structure.owners == (0, 1, 1, 3)
    assert not any(name.startswith("tilt") for name in structure.names)


@pytest.mark.parametrize(
    ("added", "words"),
    [
        ('[controller.channel.1]\nlike = "2"', "name a channel with a table"),
        ('[controller.channel.1]\nlike = "1"', "name a channel with a table"),
        ('[controller.channel.1]\n[controller.channel.2]\nlike = "1"\nlead = 2', "given by like"),
    ],
)
def test_a_channel_is_like_one_with_parameters_of_its_own(
    tmp_path: Path, added: str, words: str
) -> None:
    with pytest.raises(CaseError, match=words):
        two_axes(tmp_path, added)


CHANNELS = ("[controller.channel.a]\noutputs = [1, 0]", "[controller.channel.b]\noutputs = [0, 2]")


def test_bounds_of_a_channels_own(tmp_path: Path) -> None:
    """In its unit direction, round trip, in the samples' keys; what is not tighter is none."""
    level = "weighted_level = 8.0\n"
    case = two_axes(
        tmp_path, level, CHANNELS[0], CHANNELS[1], "S_max = 1.5\nM_K = 1e7\nbandwidth_ratio = 2"
    )
    again = tmp_path / "again.toml"
    again.write_text(case_to_toml(case))
    assert replace(load_case(again), path=case.path) == case
    problem = problem_of(case)
    first, own = bounds_of(problem).channels
    assert not first.given
    assert (own.name, own.output, own.force) == ("b", (0.0, 1.0), (0.0, 1.0))
    assert (own.S_max, own.M_K, own.bandwidth_ratio) == (1.5, 1e7, 2.0)
    lower = replace(problem, inner=replace(problem.inner, S_max=1.4))  # a slider of the explorer
    assert bounds_of(lower).channels[1].S_max is None
    plain = problem_of(two_axes(tmp_path, level, *CHANNELS))
    whole = f"S_max = {case.inner.S_max}\nM_K = {case.weights.M_K}\nbandwidth_ratio = 1.0"
    equal = problem_of(two_axes(tmp_path, level, *CHANNELS, whole))
    assert bounds_of(equal) == bounds_of(plain)
    assert bounds_of(plain).channels == ()
    assert problem_hash(plain.identity()) != problem_hash(problem.identity())
    given = plain.identity()["sections"]["channels"]  # type: ignore[index]
    assert set(given[0]) == {"name", "structure", "outputs", "inputs"}


def test_a_channel_like_another_has_its_bounds(tmp_path: Path) -> None:
    case = two_axes(tmp_path, CHANNELS[0], "S_max = 1.5", CHANNELS[1], 'like = "a"')
    rows = bounds_of(problem_of(case)).channels
    assert [own.S_max for own in rows] == [1.5, 1.5]
    assert rows[0].output != rows[1].output


@pytest.mark.parametrize(
    ("words", "added"),
    [
        ("b.S_max: is 1.8, above inner.S_max = 1.75", (*CHANNELS, "S_max = 1.8")),
        ("b.S_max: is 1; give more than 1", (*CHANNELS, "S_max = 1.0")),
        ("b.M_K: is 1e\\+09, above weights.M_K", (*CHANNELS, "M_K = 1e9")),
        ("b.M_K: has an effect on a bounded KS only", (*CHANNELS, "M_K = 1e6")),
        ("b.bandwidth_ratio: is 0.5; give 1 or more", (*CHANNELS, "bandwidth_ratio = 0.5")),
        ("every one of its channels has a bandwidth_ratio",
         (CHANNELS[0], "bandwidth_ratio = 2", CHANNELS[1], "bandwidth_ratio = 3")),
        ("b.S_max: is given by like", (*CHANNELS, 'like = "a"\nS_max = 1.5')),
    ],
)  # fmt: skip
def test_mistakes_about_own_bounds_are_reported(
    tmp_path: Path, words: str, added: tuple[str, ...]
) -> None:
    with pytest.raises(CaseError, match=words):
        problem_of(two_axes(tmp_path, *added))


@pytest.mark.parametrize("key", ["inner.S_max", "weights.M_S", "controller.weighted_level"])
def test_a_list_for_all_channels_is_refused_with_the_way(key: str) -> None:
    """Of mixed sensitivity and of sections alike: a number, and where a channel's own goes."""
    table, name = key.split(".")
    data = tomllib.loads(TWO_MASS.read_text())
    data.setdefault(table, {})[name] = [1.5, 1.7]
    with pytest.raises(CaseError, match=rf"{key}: is \[1.5, 1.7\]; give a number.*channel.NAME"):
        parse_case(data)
