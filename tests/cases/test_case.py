"""The case file: what is read, with its plant function and theta, in SI."""

import dataclasses
import importlib
import inspect
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.case_documents import DROP, PLANT, TWO_MASS, edited, message

from ccd_casadi.cases import DRAWING, SAMPLING, is_searched, plant_tables
from ccd_casadi.cases.case import CaseError, case_to_toml, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.plant_tables import parse_theta
from ccd_casadi.cases.tables import Parameter
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants import registry
from ccd_casadi.plants.plant import Plant, mechanics
from ccd_casadi.plants.registry import model_named, model_names, two_mass_plant
from ccd_casadi.support.errors import UserError


@pytest.fixture
def plant_folder(tmp_path: Path) -> Path:
    (tmp_path / "my_plant.py").write_text(PLANT)
    return tmp_path


def test_the_contracts_case_is_read_as_it_stands() -> None:
    case = load_case(str(TWO_MASS))
    assert case.path == TWO_MASS
    assert (case.plant.model, case.plant.function) == ("two_mass", None)
    assert case.plant.options == {"zeta": 0.01}
    assert case.theta == (
        Parameter("m1", 55.0, 70.0, 67.56, "kg"),
        Parameter("m2", 55.0, 70.0, 67.56, "kg"),
    )
    assert vars(case.objective) == {"w1": 0.0995, "w2": -0.9950, "cost_unit": "kg"}
    assert vars(case.weights) == {
        "M_S": 2.0, "A_S": 1e-4, "c_K": 1e4, "omega_K_hz": 100.0, "M_K": 2e7, "A_l": 1.0,
        "A_u": 1e-2, "disturbance": None,
    }  # fmt: skip
    inner = case.inner
    assert (inner.S_max, inner.S_low, inner.omega_low_hz) == (1.75, 0.03, 1.0)
    assert (inner.omega_S_hz, inner.omega_T_hz) == ((10.0, 1800.0), (25.0, 1000.0))
    assert (inner.gamma_backoff, inner.sweep_points) == (1.02, (20, 20))
    suspension = {"frequency_hz": None, "damping_ratio": 0.7, "rigid_modes": None,
                  "undamped": 1e-3}  # fmt: skip
    assert vars(case.suspension) == suspension
    assert (case.sampling.design, case.sampling.points) == ("grid", 5)
    assert (case.outer.starts, case.outer.tolerance, case.outer.max_refinements) == (16, 1e-3, 12)


def test_a_first_look_says_whether_worker_processes_will_be_needed(tmp_path: Path) -> None:
    assert is_searched(TWO_MASS.with_name("two_mass_built.toml"))
    assert not is_searched(TWO_MASS)
    for words in ("", "controller = 3", "[controller]\nstructure = 'sections'", "]["):
        (tmp_path / "no_case.toml").write_text(words)
        assert not is_searched(tmp_path / "no_case.toml")
    assert not is_searched(tmp_path / "nowhere.toml")
    for module in (*SAMPLING, *DRAWING):
        importlib.import_module(module)


def test_the_problem_is_in_si() -> None:
    problem = problem_of(load_case(TWO_MASS))
    hz = 2.0 * math.pi
    assert problem.names == ("m1", "m2")
    assert problem.lower + problem.upper + problem.start == (55, 55, 70, 70, 67.56, 67.56)
    assert problem.inner.omega_S == pytest.approx((10.0 * hz, 1800.0 * hz), rel=1e-15)
    assert problem.inner.omega_T == pytest.approx((25.0 * hz, 1000.0 * hz), rel=1e-15)
    assert problem.inner.omega_low == pytest.approx(hz, rel=1e-15)
    assert problem.weights.omega_K == pytest.approx(100.0 * hz, rel=1e-15)
    assert problem.suspension.frequency_hz == 0.1
    assert problem.source.options == (("zeta", 0.01),)


@pytest.mark.parametrize(
    ("low", "given", "expected"),
    [(1.0, None, 0.1), (5.0, None, 0.1), (0.02, None, 0.002), (0.02, 0.05, 0.05)],
)
def test_a_suspension_is_a_decade_below_the_loop(low: float, given: Any, expected: float) -> None:
    """At 0.1 Hz a loop of 0.13 Hz on free bodies was "not stable", and infeasible for that."""
    case = load_case(TWO_MASS)
    case = replace(
        case, inner=replace(case.inner, omega_low_hz=low),
        suspension=replace(case.suspension, frequency_hz=given),
    )  # fmt: skip
    assert problem_of(case).suspension.frequency_hz == pytest.approx(expected, rel=1e-15)


def test_left_out_keys_take_their_defaults() -> None:
    document = edited(
        ("inner.gamma_backoff", DROP), ("theta.m1.start", DROP), ("theta.m1.unit", DROP)
    )
    case = parse_case(document, TWO_MASS)
    assert case.inner.gamma_backoff == 1.02
    assert case.theta[0] == Parameter("m1", 55.0, 70.0, 62.5, "")


def test_integers_stand_for_floats_and_become_floats() -> None:
    case = parse_case(edited(("theta.m1.lower", 55), ("inner.omega_S_hz", [10, 1800])), TWO_MASS)
    values = (case.theta[0].lower, *case.inner.omega_S_hz)
    assert values == (55.0, 10.0, 1800.0)
    assert {type(value) for value in values} == {float}


def test_theta_keeps_the_order_of_the_file() -> None:
    document = edited()
    document["theta"] = dict(reversed(document["theta"].items()))
    assert [p.name for p in parse_case(document, TWO_MASS).theta] == ["m2", "m1"]


def test_a_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    path = tmp_path / "bom.toml"
    path.write_bytes(b"\xef\xbb\xbf" + TWO_MASS.read_bytes())
    assert dataclasses.replace(load_case(path), path=TWO_MASS) == load_case(TWO_MASS)


def test_a_plant_function_is_found_beside_the_case_file(plant_folder: Path) -> None:
    document = edited(
        ("plant", {"function": "my_plant.py:model", "gain": 2, "table": [[1.5, 2], ["a", True]]})
    )
    case = parse_case(document, plant_folder / "x.toml")
    problem = problem_of(case)
    assert problem.source.file == str(plant_folder / "my_plant.py")
    assert problem.source.function == "model"
    assert dict(problem.source.options) == {"gain": 2, "table": ((1.5, 2), ("a", True))}


def test_a_resolved_case_finds_its_plant_from_another_folder(plant_folder: Path) -> None:
    document = edited(("plant", {"function": "my_plant.py:model"}))
    case = parse_case(document, plant_folder / "x.toml")
    run = plant_folder / "out" / "run"
    run.mkdir(parents=True)
    (run / "case.toml").write_text(case_to_toml(case), "utf-8")
    assert problem_of(load_case(run / "case.toml")).source == problem_of(case).source


@pytest.mark.parametrize(
    ("plant", "key", "remedy"),
    [
        ({"function": "other.py:model"}, "plant.function", "relative to the case file"),
        ({"function": "my_plant.py"}, "plant.function", 'write "my_plant.py:model"'),
        ({"function": "my_plant.py:"}, "plant.function", 'write "my_plant.py:model"'),
        ({"function": "my_plant.txt:model"}, "plant.function", 'write "my_plant.py:model"'),
        ({"function": "my_plant.py:a b"}, "plant.function", 'write "my_plant.py:model"'),
        ({"function": "my\0plant.py:model"}, "plant.function", "relative to the case file"),
        ({"function": 3}, "plant.function", 'write "my_plant.py:model"'),
        ({"function": "my_plant.py:model", "a b": 1}, "plant.a b", "use a Python identifier"),
        ({"function": "my_plant.py:model", "a": {"b": 1}}, "plant.a", "give a number, text"),
        ({"function": "my_plant.py:model", "a": [1, [math.inf]]}, "plant.a", "finite number"),
        ({"function": "my_plant.py:model", "a": [2**63]}, "plant.a", "write it as a float"),
    ],
)
def test_a_wrong_plant_function_is_reported(
    plant_folder: Path, plant: dict[str, Any], key: str, remedy: str
) -> None:
    path = plant_folder / "x.toml"
    text = message(edited(("plant", plant)), path)
    assert text.startswith(f"{path}: {key}: ")
    assert remedy in text


@pytest.mark.parametrize(
    ("function", "words"),
    [
        ("broken", "the plant function raised ZeroDivisionError: division by zero in line"),
        ("absent", "defines no function absent; check plant.function"),
        ("not_callable", "defines no function not_callable; check plant.function"),
    ],
)
def test_a_plant_function_that_fails_is_reported(
    plant_folder: Path, function: str, words: str
) -> None:
    document = edited(("plant", {"function": f"my_plant.py:{function}"}))
    case = parse_case(document, plant_folder / "x.toml")
    with pytest.raises(CaseError) as caught:
        problem_of(case)
    text = str(caught.value)
    assert text.startswith(f"{plant_folder / 'x.toml'}: plant")
    assert words in text
    assert text.isprintable()


def test_what_is_known_of_the_models_is_what_they_take() -> None:
    """A model that reads another θ, or renames an option, would make the checks refuse it."""
    for name in model_names():
        model = model_named(name)
        assert model is not None
        theta = model.theta or ()
        if theta:
            model.build(theta)
        for gone in theta:
            with pytest.raises((KeyError, UserError)):
                model.build(tuple(sorted(set(theta) - {gone})))
        takes = inspect.signature(model.build).parameters
        assert {*model.checks, model.data} <= {"", *takes}
        if model.annotated:  # every option has a check, by its name or its annotation
            checks = [plant_tables._check_of(takes[each]) for each in list(takes)[1:]]
            assert plant_tables._option not in checks


@pytest.mark.parametrize(
    ("text", "theta"),
    [
        ("m1=60,m2=65", (60.0, 65.0)),
        ("m2=65,m1=60", (60.0, 65.0)),
        (" m1 = 5.5e1 , m2 = 70", (55.0, 70.0)),
    ],
)
def test_theta_of_the_command_line(text: str, theta: tuple[float, ...]) -> None:
    assert parse_theta(load_case(TWO_MASS), text) == theta


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("m1=60", "m2 is missing; give all of m1, m2"),
        ("", "is not of the form name=value; give m1=..,m2=.."),
        ("60,60", "is not of the form name=value; give m1=..,m2=.."),
        ("m1=60,m2=60,", "is not of the form name=value; give m1=..,m2=.."),
        ("m1=60,m3=60", "'m3' is not a parameter of the case; known are m1, m2"),
        ("m1=60,m2=60,m1=60", "m1 is given twice; give it once"),
        ("m1=heavy,m2=60", "m1 = 'heavy' is not a number; give one"),
        ("m1=,m2=60", "m1 = '' is not a number; give one"),
        ("m1=nan,m2=60", "m1 = nan is outside its bounds; give 55 to 70"),
        ("m1=60,m2=inf", "m2 = inf is outside its bounds; give 55 to 70"),
        ("m1=60,m2=54.9", "m2 = 54.9 is outside its bounds; give 55 to 70"),
        ("m1=60,m\n3=60", "is not a parameter of the case"),
    ],
)
def test_wrong_theta_of_the_command_line(text: str, words: str) -> None:
    with pytest.raises(CaseError) as caught:
        parse_theta(load_case(TWO_MASS), text)
    reported = str(caught.value)
    assert reported.startswith(f"{TWO_MASS}: --theta: ")
    assert words in reported
    assert reported.isprintable()


def test_another_package_offers_a_plant_by_its_entry_point(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def build(names: tuple[str, ...], zeta: float = 0.02) -> Plant:
        return two_mass_plant(names, zeta)

    class Point:
        name = "pair"

        def load(self) -> object:
            return build

    monkeypatch.setattr(registry, "_offer", lambda: {"pair": Point()})
    registry.model_named.cache_clear()
    try:
        problem = problem_of(parse_case(edited(("plant", {"model": "pair"})), tmp_path / "x.toml"))
        theta = problem.start
        D = mechanics(plant_of(problem), theta).D
        np.testing.assert_array_equal(D, mechanics(build(problem.names), theta).D)
        with pytest.raises(CaseError, match="not an option of pair"):
            parse_case(edited(("plant", {"model": "pair", "mass": 1.0})), tmp_path / "x.toml")
        with pytest.raises(CaseError, match="did you mean pair"):
            parse_case(edited(("plant", {"model": "pairs"})), tmp_path / "x.toml")
    finally:
        registry.model_named.cache_clear()
