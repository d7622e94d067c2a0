"""The case file: what is read, what is written back, and one line for every mistake."""

import dataclasses
import inspect
import math
import tomllib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from helpers import few
from hypothesis import given
from hypothesis import strategies as st

from ccd_casadi import case as case_module
from ccd_casadi.case import CaseError, load_case, parse_case, parse_theta, problem_of
from ccd_casadi.case_sections import Case, Parameter
from ccd_casadi.case_toml import case_to_toml
from ccd_casadi.errors import UserError
from ccd_casadi.models import BUILDERS, MODELS

TWO_MASS = Path(__file__).parent.parent / "runs" / "two_mass.toml"
DOCUMENT = tomllib.loads(TWO_MASS.read_text("utf-8"))
DROP = object()
PLANT = """
def model(theta, gain=1.0, **rest):
    m = theta["m1"] + theta["m2"]
    return {
        "mass": m, "stiffness": 1e6, "damping_ratio": 0.01,
        "input": gain, "output": 1.0, "hardware_cost": m,
    }

def broken(theta):
    return 1 / 0

not_callable = 3
"""


def edited(*changes: tuple[str, Any]) -> dict[str, Any]:
    """The two-mass document with each dotted key set to a value, or dropped."""
    document = deepcopy(DOCUMENT)
    for key, value in changes:
        *parents, last = key.split(".")
        table = document
        for name in parents:
            table = table.setdefault(name, {})
        if value is DROP:
            del table[last]
        else:
            table[last] = value
    return document


def message(document: dict[str, Any], path: Path = Path("runs/x.toml")) -> str:
    """The one line that refuses `document`."""
    with pytest.raises(CaseError) as caught:
        parse_case(document, path)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert text.isprintable()
    return text


def verdict(read: Callable[[], Case]) -> Case | str:
    """What `read` makes: a case, or the one line that refuses it."""
    try:
        return read()
    except CaseError as error:
        return str(error)


def again(case: Case, folder: Path) -> Case:
    """`case` written to a file in `folder` and read back, at the path it had."""
    path = folder / "case.toml"
    path.write_text(case_to_toml(case), "utf-8")
    return dataclasses.replace(load_case(path), path=case.path)


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
    assert vars(case.objective) == {"w1": 0.0995, "w2": -0.9950}
    assert vars(case.weights) == {
        "M_S": 2.0, "A_S": 1e-4, "c_K": 1e4, "omega_K_hz": 100.0, "M_K": 2e7, "A_l": 1.0,
        "A_u": 1e-2,
    }  # fmt: skip
    inner = case.inner
    assert (inner.S_max, inner.S_low, inner.omega_low_hz) == (1.75, 0.03, 1.0)
    assert (inner.omega_S_hz, inner.omega_T_hz) == ((10.0, 1800.0), (25.0, 1000.0))
    assert (inner.gamma_backoff, inner.sweep_points) == (1.02, (20, 20))
    suspension = {"frequency_hz": 0.1, "damping_ratio": 0.7, "rigid_modes": None}
    assert vars(case.suspension) == suspension
    assert (case.sampling.design, case.sampling.points) == ("grid", 5)
    assert (case.outer.starts, case.outer.tolerance, case.outer.max_refinements) == (16, 1e-3, 12)


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


# Every kind of mistake: what is changed, the key that is named, and the remedy.
MISTAKES: list[tuple[str, Any, str, str]] = [
    # sections and keys
    ("wieghts", {}, "wieghts", "did you mean weights?"),
    ("qqq", {}, "qqq", "known are plant, theta"),
    ("weights", 3, "weights", "write a table [weights]"),
    ("theta", [1], "theta", "write a table [theta]"),
    ("plant", DROP, "plant", "add a table [plant]"),
    ("theta", DROP, "theta", "add a table [theta]"),
    ("theta", {}, "theta", "add a table [theta.NAME]"),
    ("objective", DROP, "objective", "add a table [objective]"),
    ("weights", DROP, "weights", "add a table [weights]"),
    ("inner", DROP, "inner", "add a table [inner]"),
    ("inner.S_mx", 1.75, "inner.S_mx", "did you mean S_max?"),
    ("sampling.pionts", 3, "sampling.pionts", "did you mean points?"),
    ("theta.m1.uper", 3.0, "theta.m1.uper", "did you mean upper?"),
    ("theta.m1.lower", DROP, "theta.m1.lower", "add it"),
    ("theta.m2.upper", DROP, "theta.m2.upper", "add it"),
    ("objective.w2", DROP, "objective.w2", "add it"),
    ("weights.M_K", DROP, "weights.M_K", "add it"),
    ("inner.S_low", DROP, "inner.S_low", "add it"),
    # types
    ("weights.M_S", "2.0", "weights.M_S", "give a number"),
    ("weights.M_S", True, "weights.M_S", "give a number"),
    ("weights.M_S", [2.0], "weights.M_S", "give a number"),
    ("weights.M_S", {"a": 1}, "weights.M_S", "give a number"),
    ("weights.M_S", 10**400, "weights.M_S", "give a number"),
    ("theta.m1", 60.0, "theta.m1", "write a table [theta.m1]"),
    ("theta.m1.lower", "55", "theta.m1.lower", "give a finite number"),
    ("theta.m1.lower", False, "theta.m1.lower", "give a finite number"),
    ("theta.m1.unit", 3, "theta.m1.unit", "give a text in quotes"),
    ("plant.model", 3, "plant.model", "known are two_mass"),
    ("sampling.points", 5.0, "sampling.points", "give a whole number"),
    ("sampling.points", True, "sampling.points", "give a whole number"),
    ("sampling.points", 16**5000, "sampling.points", "give a whole number"),
    ("inner.omega_S_hz", 10.0, "inner.omega_S_hz", "[low, high] with low < high"),
    ("inner.omega_S_hz", [10.0], "inner.omega_S_hz", "[low, high] with low < high"),
    ("inner.omega_S_hz", [1.0, 2.0, 3.0], "inner.omega_S_hz", "[low, high] with low < high"),
    ("inner.omega_S_hz", ["a", "b"], "inner.omega_S_hz", "[low, high] with low < high"),
    ("inner.omega_S_hz", [1.0, 16**5000], "inner.omega_S_hz", "[low, high] with low < high"),
    # what is no number
    ("weights.M_K", math.nan, "weights.M_K", "give a number above 0"),
    ("weights.M_K", math.inf, "weights.M_K", "give a number above 0"),
    ("theta.m1.start", math.nan, "theta.m1.start", "give a finite number"),
    ("theta.m1.upper", math.inf, "theta.m1.upper", "give a finite number"),
    ("inner.omega_T_hz", [25.0, math.inf], "inner.omega_T_hz", "[low, high] with low < high"),
    ("plant.zeta", math.nan, "plant.zeta", "give a number between 0 and 1"),
    # theta
    ("theta.m1.lower", 80.0, "theta.m1.lower", "80 is above upper = 70; swap them"),
    ("theta.m1.lower", 70.0, "theta.m1.lower", "widen it"),
    ("theta.m1.start", 54.9, "theta.m1.start", "give a start within the bounds"),
    ("theta.m1.start", 70.1, "theta.m1.start", "give a start within the bounds"),
    ("theta.2m", {"lower": 1.0, "upper": 2.0}, "theta.2m", "use letters, digits and _"),
    ("theta.m 3", {"lower": 1.0, "upper": 2.0}, "theta.m 3", "use letters, digits and _"),
    ("theta.m3", {"lower": 1.0, "upper": 2.0}, "theta.m3", "known are m1, m2"),
    ("theta.m2", DROP, "theta.m2", "add a table [theta.m2]"),
    # plant
    ("plant.model", DROP, "plant", "give either model or function"),
    ("plant.function", "p.py:f", "plant", "and not both"),
    ("plant.model", "two_mas", "plant.model", "did you mean two_mass?"),
    ("plant.zetta", 0.01, "plant.zetta", "did you mean zeta?"),
    ("plant.zeta", "0.01", "plant.zeta", "give a number between 0 and 1"),
    ("plant.zeta", -0.01, "plant.zeta", "give a number between 0 and 1"),
    # objective and weights
    ("objective.w1", -0.1, "objective.w1", "give 0 or more"),
    ("objective.w2", 0.0, "objective.w2", "give a negative number: J must reward bandwidth"),
    ("objective.w2", 0.995, "objective.w2", "give a negative number: J must reward bandwidth"),
    ("weights.M_S", 0.0, "weights.M_S", "give a number above 0"),
    ("weights.M_S", 1e-4, "weights.M_S", "give M_S > A_S"),
    ("weights.A_S", 0.0, "weights.A_S", "give a number between 0 and 1"),
    ("weights.A_S", 1.0, "weights.A_S", "give a number between 0 and 1"),
    ("weights.c_K", 1.0, "weights.c_K", "give a number above 1"),
    ("weights.omega_K_hz", 0.0, "weights.omega_K_hz", "give a number above 0"),
    ("weights.M_K", -2e7, "weights.M_K", "give a number above 0"),
    ("weights.A_l", 1e-2, "weights.A_l", "give A_l > A_u"),
    ("weights.A_u", 0.0, "weights.A_u", "give a number between 0 and 1"),
    ("weights.A_u", 1.0, "weights.A_u", "give a number between 0 and 1"),
    # inner
    ("inner.S_max", 1.0, "inner.S_max", "give more than 1"),
    ("inner.S_max", 0.9, "inner.S_max", "Bode's integral"),
    ("inner.S_low", 0.0, "inner.S_low", "give a number between 0 and 1"),
    ("inner.S_low", 1.0, "inner.S_low", "give a number between 0 and 1"),
    ("inner.omega_low_hz", 0.0, "inner.omega_low_hz", "give a number above 0"),
    ("inner.omega_S_hz", [1800.0, 10.0], "inner.omega_S_hz", "[low, high] with low < high"),
    ("inner.omega_S_hz", [10.0, 10.0], "inner.omega_S_hz", "[low, high] with low < high"),
    ("inner.omega_T_hz", [0.0, 10.0], "inner.omega_T_hz", "two positive numbers"),
    ("inner.omega_T_hz", [], "inner.omega_T_hz", "two positive numbers"),
    ("inner.gamma_backoff", 1.0, "inner.gamma_backoff", "give a number above 1"),
    ("inner.sweep_points", [1, 20], "inner.sweep_points", "two whole numbers of at least 2"),
    ("inner.sweep_points", [20.0, 20.0], "inner.sweep_points", "two whole numbers"),
    ("inner.sweep_points", 20, "inner.sweep_points", "two whole numbers of at least 2"),
    # the optional sections
    ("suspension.frequency_hz", 0.0, "suspension.frequency_hz", "give a number above 0"),
    ("suspension.damping_ratio", -0.7, "suspension.damping_ratio", "give a number above 0"),
    ("sampling.design", "gird", "sampling.design", "choose one of grid, sobol, lhs"),
    ("sampling.design", ["grid"], "sampling.design", "choose one of grid, sobol, lhs"),
    ("sampling.points", 0, "sampling.points", "give a whole number of at least"),
    ("sampling.points", -5, "sampling.points", "give a whole number of at least"),
    ("outer.starts", 0, "outer.starts", "give a whole number of at least 1"),
    ("outer.tolerance", 0.0, "outer.tolerance", "give a number between 0 and 1"),
    ("outer.max_refinements", -1, "outer.max_refinements", "give a whole number of at least 0"),
]


@pytest.mark.parametrize(
    ("change", "value", "key", "remedy"),
    MISTAKES,
    ids=[f"{number}-{mistake[0]}" for number, mistake in enumerate(MISTAKES)],
)
def test_a_mistake_is_told_with_its_key_and_its_remedy(
    change: str, value: Any, key: str, remedy: str
) -> None:
    text = message(edited((change, value)))
    assert text.startswith(f"runs/x.toml: {key}: ")
    assert remedy in text


def test_a_key_that_holds_line_ends_or_escapes_stays_on_one_line() -> None:
    text = message(edited(("inner", DOCUMENT["inner"] | {"a\nb\u2028c\x1b[31m": 1})))
    assert text.startswith(r"runs/x.toml: inner.a b c\x1b[31m: unknown key")


def test_a_long_value_is_cut() -> None:
    text = message(edited(("weights.M_S", "x" * 10_000)))
    assert "xxx..." in text
    assert len(text) < 200


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[plant]\nmodel = \n", "line 2, column 9"),
        (b"[plant]\n[plant]\n", "line 2"),
        (b"a = 1\na = 2\n", "line 2"),
        (b"[plant]\nmodel = 'caf\xe9'\n", "line 2 is not UTF-8 text; save the file as UTF-8"),
        (b"\x00\x01", "is not valid TOML"),
        (b"a = " + b"[" * 100_000, "nested too deeply; flatten its arrays"),
        (b"a = " + b"1" * 5_000, "write it as a float"),
        (b"", "plant: is missing; add a table [plant]"),
    ],
)
def test_a_broken_file_is_told_with_the_place(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(CaseError) as caught:
        load_case(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert words in text
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere.toml", "there is no such file; name a case file"),
        (".", "Is a directory; name a readable file"),
        ("a_file/x.toml", "Not a directory; name a readable file"),
        ("a\0b.toml", "name a readable file"),
        ("a\nb.toml", "there is no such file; name a case file"),
        ("x" * 5_000, "name a readable file"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "a_file").write_text("")
    with pytest.raises(CaseError) as caught:
        load_case(tmp_path / name)
    text = str(caught.value)
    assert text.startswith(str(tmp_path))
    assert words in text
    assert text.isprintable()


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
def test_a_wrong_plant_function_is_told(
    plant_folder: Path, plant: dict[str, Any], key: str, remedy: str
) -> None:
    path = plant_folder / "x.toml"
    text = message(edited(("plant", plant)), path)
    assert text.startswith(f"{path}: {key}: ")
    assert remedy in text


@pytest.mark.parametrize(
    ("function", "words"),
    [
        ("broken", "plant.function: broken raised ZeroDivisionError: division by zero; mend it"),
        ("absent", "defines no function absent; check plant.function"),
        ("not_callable", "defines no function not_callable; check plant.function"),
    ],
)
def test_a_plant_function_that_fails_is_told(plant_folder: Path, function: str, words: str) -> None:
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
    for name, theta in case_module._MODEL_THETA.items():
        if name in BUILDERS:
            BUILDERS[name](theta)
        else:
            MODELS[name](dict.fromkeys(theta, 60.0))
        for gone in theta:
            rest = tuple(sorted(set(theta) - {gone}))
            with pytest.raises((KeyError, UserError)):
                BUILDERS[name](rest) if name in BUILDERS else MODELS[name](
                    dict.fromkeys(rest, 60.0)
                )
    for name, option in case_module._MODEL_OPTIONS:
        assert option in inspect.signature({**MODELS, **BUILDERS}[str(name)]).parameters


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
        ("m1=60,m3=60", "'m3' is no parameter of the case; known are m1, m2"),
        ("m1=60,m2=60,m1=60", "m1 is given twice; give it once"),
        ("m1=heavy,m2=60", "m1 = 'heavy' is not a number; give one"),
        ("m1=,m2=60", "m1 = '' is not a number; give one"),
        ("m1=nan,m2=60", "m1 = nan is outside its bounds; give 55 to 70"),
        ("m1=60,m2=inf", "m2 = inf is outside its bounds; give 55 to 70"),
        ("m1=60,m2=54.9", "m2 = 54.9 is outside its bounds; give 55 to 70"),
        ("m1=60,m\n3=60", "is no parameter of the case"),
    ],
)
def test_wrong_theta_of_the_command_line(text: str, words: str) -> None:
    with pytest.raises(CaseError) as caught:
        parse_theta(load_case(TWO_MASS), text)
    told = str(caught.value)
    assert told.startswith(f"{TWO_MASS}: --theta: ")
    assert words in told
    assert told.isprintable()


def test_a_case_error_is_a_user_error() -> None:
    assert issubclass(CaseError, UserError)
    assert issubclass(UserError, ValueError)


def test_the_contracts_case_comes_back_as_it_was(tmp_path: Path) -> None:
    case = load_case(TWO_MASS)
    assert again(case, tmp_path) == case


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(1e-9, 1e9)
fraction = st.floats(1e-6, 0.9)
above_one = st.floats(1.001, 1e6)
texts = st.text(max_size=12)
names = st.one_of(
    st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True), st.sampled_from(["é", "μ1"])
)
options = st.recursive(
    st.one_of(st.booleans(), st.integers(-(2**63) + 1, 2**63 - 1), finite, texts),
    lambda inside: st.lists(inside, max_size=3),
    max_leaves=5,
)
ranges = st.tuples(positive, st.floats(1.01, 100.0)).map(lambda v: [v[0], v[0] * v[1]])


@st.composite
def parameters(draw: st.DrawFn) -> dict[str, Any]:
    lower, width, share = draw(st.floats(-1e9, 1e9)), draw(st.floats(1.0, 1e9)), draw(fraction)
    table = {"lower": lower, "upper": lower + width}
    optional = {"start": lower + share * width, "unit": draw(texts)}
    return table | draw(st.sampled_from([optional, {}]))


cases = st.fixed_dictionaries(
    {
        "plant": st.dictionaries(names, options, max_size=4).map(
            lambda table: table | {"function": "my_plant.py:model"}
        ),
        "theta": st.dictionaries(names, parameters(), min_size=1, max_size=3),
        "objective": st.fixed_dictionaries({"w1": st.floats(0, 1e9), "w2": st.floats(-1e9, -1e-9)}),
        "weights": st.fixed_dictionaries(
            {
                "M_S": above_one, "A_S": fraction, "c_K": above_one, "omega_K_hz": positive,
                "M_K": positive, "A_l": above_one, "A_u": fraction,
            }
        ),
        "inner": st.fixed_dictionaries(
            {
                "S_max": above_one, "S_low": fraction, "omega_low_hz": positive,
                "omega_S_hz": ranges, "omega_T_hz": ranges,
            },
            optional={
                "gamma_backoff": st.floats(1.001, 9.0),
                "sweep_points": st.lists(st.integers(2, 50), min_size=2, max_size=2),
            },
        ),
    },
    optional={
        "suspension": st.fixed_dictionaries({}, optional={"frequency_hz": positive}),
        "sampling": st.fixed_dictionaries(
            {}, optional={"design": st.sampled_from(["grid", "sobol", "lhs"])}
        ),
        "outer": st.fixed_dictionaries({}, optional={"starts": st.integers(1, 99)}),
    },
)  # fmt: skip


@few(max_examples=50)
@given(document=cases)
def test_every_case_comes_back_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, document: dict[str, Any]
) -> None:
    folder = tmp_path_factory.mktemp("case")
    (folder / "my_plant.py").write_text(PLANT)
    case = parse_case(document, folder / "x.toml")
    found = again(case, tmp_path_factory.mktemp("elsewhere"))
    assert found == case
    assert repr(found) == repr(case)  # types too: 1, 1.0 and True are equal


anything = st.recursive(
    st.one_of(
        st.booleans(), st.integers(), st.floats(), texts, st.dates(),
        st.sampled_from([10**400, -(2**63), 0, 1, 1.0, 60.0, "two_mass", "my_plant.py:model"]),
    ),
    lambda inside: st.one_of(
        st.lists(inside, max_size=3), st.dictionaries(texts, inside, max_size=3)
    ),
    max_leaves=6,
)  # fmt: skip
places = [
    *DOCUMENT,
    *(f"{section}.{key}" for section, table in DOCUMENT.items() for key in table),
    *(f"theta.m1.{key}" for key in DOCUMENT["theta"]["m1"]),
    "plant.function", "inner.sweep_points", "sampling", "sampling.points", "outer.starts",
    "sampling.design", "suspension.frequency_hz",
]  # fmt: skip


@few(max_examples=300)
@given(place=st.sampled_from(places), value=anything)
def test_any_value_anywhere_gives_a_case_or_one_line(place: str, value: Any) -> None:
    path = Path("runs/x.toml")
    found = verdict(lambda: parse_case(edited((place, value)), path))
    if isinstance(found, Case):
        assert tomllib.loads(case_to_toml(found))["plant"]["model"] == "two_mass"
    else:
        assert found.startswith(f"{path}: ")
        assert found.isprintable()


@few(max_examples=100)
@given(document=st.dictionaries(st.one_of(st.sampled_from(list(DOCUMENT)), texts), anything))
def test_no_random_document_is_a_case(document: dict[str, Any]) -> None:
    message(document)


@few(max_examples=100)
@given(cut=st.integers(0, TWO_MASS.stat().st_size), junk=st.binary(max_size=8))
def test_a_damaged_file_gives_a_case_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, cut: int, junk: bytes
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "x.toml"
    whole = TWO_MASS.read_bytes()
    path.write_bytes(whole[:cut] + junk + whole[cut + len(junk) :])
    found = verdict(lambda: load_case(path))
    if isinstance(found, Case):
        assert [p.name for p in found.theta] == ["m1", "m2"]
    else:
        assert found.startswith(f"{path}: ")
        assert found.isprintable()
