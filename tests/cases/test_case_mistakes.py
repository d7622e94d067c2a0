"""One line for every mistake in a case file: file, key, what is wrong, what to do."""

import math
from pathlib import Path
from typing import Any

import pytest
from oracles.case_documents import DOCUMENT, DROP, edited, message

from ccd_casadi.cases.case import CaseError, load_case, parse_case
from ccd_casadi.support.errors import UserError

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
    ("plant.model", 3, "plant.model", "known are cad_stage"),
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
    ("plant.function", "p.py:f", "plant", "has both model and function"),
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
    ("inner.S_max", math.inf, "inner.S_max", "less than infinity"),
    ("robust", {"damping": [50.0, 200.0]}, "robust.damping", "such as [0.5, 2] for half to twice"),
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
def test_a_mistake_is_reported_with_its_key_and_its_remedy(
    change: str, value: Any, key: str, remedy: str
) -> None:
    text = message(edited((change, value)))
    assert text.startswith(f"runs/x.toml: {key}: ")
    assert remedy in text


def test_a_key_that_holds_line_ends_or_escapes_stays_on_one_line() -> None:
    text = message(edited(("inner", DOCUMENT["inner"] | {"a\nb\u2028c\x1b[31m": 1})))
    assert text.startswith(r"runs/x.toml: inner.a b c\x1b[31m: unknown key")


@pytest.mark.parametrize(("low", "rate"), [(6.0, 10.0), (5.0, 10.0), (1.0, 0.5)])
def test_a_bound_above_half_the_rate_is_reported_with_both_numbers(low: float, rate: float) -> None:
    sections = ("controller", {"structure": "sections", "biquads": 0, "weighted_level": 9.0})
    text = message(edited(sections, ("loop.rate_hz", rate), ("inner.omega_low_hz", low)))
    words = f"is {low:g}, not below {0.5 * rate:g}, half of loop.rate_hz = {rate:g}; lower it"
    assert text.startswith(f"runs/x.toml: inner.omega_low_hz: {words}")
    below = edited(sections, ("loop.rate_hz", 2.1 * low), ("inner.omega_low_hz", low))
    assert parse_case(below).inner.omega_low_hz == low


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
def test_a_broken_file_is_reported_with_the_place(
    tmp_path: Path, content: bytes, words: str
) -> None:
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
        (".", "is a folder; name a case file in it, such as /"),
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


def test_a_case_error_is_a_user_error() -> None:
    assert issubclass(CaseError, UserError)
    assert issubclass(UserError, ValueError)
