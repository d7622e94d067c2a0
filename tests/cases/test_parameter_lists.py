"""Parameters that are fixed or from a list, in the case file."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from ccd_casadi.cases.case import CaseError, case_to_toml, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.compare import main as compare

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"


def document(**table: Any) -> dict[str, Any]:
    found = tomllib.loads(TWO_MASS.read_text())
    found["theta"]["m1"] = table
    return found


@pytest.mark.parametrize(
    ("table", "values"),
    [
        ({"values": [61, 57.0, 64]}, (57.0, 61.0, 64.0)),
        ({"lower": 55.2, "upper": 58.9, "integer": True}, (56.0, 57.0, 58.0)),
        ({"lower": 55.0, "upper": 58.0, "integer": False}, ()),
    ],
)
def test_lists_in_the_case_come_back(
    table: dict[str, Any], values: tuple[float, ...], tmp_path: Path
) -> None:
    case = parse_case(document(**table))
    assert case.theta[0].values == values
    path = tmp_path / "case.toml"
    path.write_text(case_to_toml(case))
    again = load_case(path)
    assert (again.theta, again.fixed) == (case.theta, case.fixed)
    assert problem_of(case).listed == ((("m1", values),) if values else ())


def test_a_fixed_parameter_comes_back(tmp_path: Path) -> None:
    case = parse_case(document(fixed=58, unit="kg"))
    assert [p.name for p in case.theta] == ["m2"]
    path = tmp_path / "case.toml"
    path.write_text(case_to_toml(case))
    assert load_case(path).fixed == case.fixed
    assert problem_of(case).source.fixed == (("m1", 58.0, "kg"),)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"fixed": 58, "lower": 55}, "theta.m1.lower: has no place beside fixed"),
        ({"values": [57, 58], "upper": 60}, "theta.m1.upper: has no place beside values"),
        ({"values": [57, 57.0]}, "theta.m1.values: needs two different numbers"),
        ({"values": "57"}, "theta.m1.values: is '57'; give a list of numbers"),
        ({"lower": 55.2, "upper": 55.9, "integer": True}, "holds 0 whole numbers"),
        ({"lower": 0, "upper": 1e6, "integer": True}, "give bounds with 2 to 100"),
        ({"values": [57, 60], "start": 70}, "70 is outside 57 to 60"),
    ],
)
def test_mistakes_about_lists_are_reported(table: dict[str, Any], words: str) -> None:
    with pytest.raises(CaseError, match=words.replace("(", "\\(")):
        parse_case(document(**table))


def test_something_has_to_be_free() -> None:
    found = document(fixed=58.0)
    found["theta"]["m2"] = {"values": [57, 60]}
    with pytest.raises(CaseError, match="no parameter with a range"):
        parse_case(found)


def test_what_needs_ranges_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "case.toml"
    path.write_text(case_to_toml(parse_case(document(values=[57, 60]))))
    assert compare([str(path), "--quiet"]) == 2
    assert "theta.m1.values: compare needs a range" in capsys.readouterr().err
