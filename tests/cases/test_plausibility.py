"""What hardly any machine has is a question by its key; what is in SI is none, and nothing is
refused."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

import ccd_casadi as ccd
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.diagnosis import diagnose, plant_report, suspicions
from ccd_casadi.cases.findings import Severity, Topic
from ccd_casadi.cases.tables import Case
from ccd_casadi.check import main as check
from ccd_casadi.inner import main as inner
from ccd_casadi.support.text import use_units

ROOT = Path(__file__).parents[2]
AXIS = ROOT / "examples" / "linear_motor_axis"


def axis(folder: Path, *changes: tuple[str, str]) -> Path:
    """The linear-motor axis of the examples with a changed case."""
    text = (AXIS / "case.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "plant.py").write_text((AXIS / "plant.py").read_text(encoding="utf-8"))
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return path


def questions(path: Path) -> list[str]:
    """The questions about units."""
    found = diagnose(problem_of(load_case(path)))[1]
    assert not [item for item in found if item.severity is Severity.ERROR]
    return [item.words for item in found if item.topic is Topic.UNITS]


MOTORS = "[0.35, 0.62, 1.1, 1.9]"


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ([], ""),
        ([("distance = 0.1", "distance = 2.0")], ""),  # a long axis
        ([(MOTORS, "[350.0, 620.0, 1100.0, 1900.0]"), ("start = 0.62", "start = 620.0")],
         "theta.motor: 620 kg"),
        ([(MOTORS, "[0.35e-3, 0.62e-3, 1.1e-3, 1.9e-3]"), ("start = 0.62", "start = 0.62e-3")],
         "theta.motor: 0.00062 kg"),
        ([("distance = 0.1", "distance = 100.0")], "move.distance: 100 m"),
        ([("velocity = 1.5", "velocity = 1500.0")], "move.velocity: 1500 m/s"),
        ([("jerk = 1e4", "jerk = 1e9\nacceleration = 5e4")], "move.acceleration: "),
        ([("settle_band = 1e-6", "settle_band = 1.0")], "move.settle_band = 1 "),
        ([("velocity = 1.5", "velocity = 1.5e-3")], "[move] takes "),
    ],
)  # fmt: skip
def test_a_motor_or_a_move_of_no_machine_is_a_question_by_its_key(
    tmp_path: Path, change: list[tuple[str, str]], key: str
) -> None:
    path = axis(tmp_path, *change)
    words = [item for item in questions(path) if "M_K" not in item]
    assert bool(words) == bool(key)
    assert not key or any(item.startswith(key) for item in words)
    assert all("?" in item for item in words)
    assert check([str(path), "--quiet"]) == 0


@pytest.mark.parametrize("output", ["m", "rad"])
@pytest.mark.parametrize("far", ["30.0", "6.0"])
def test_a_rotation_beyond_a_turn_may_be_in_degrees(tmp_path: Path, output: str, far: str) -> None:
    """A distance in m is not asked about degrees."""
    change = ("distance = 0.1", f"distance = {far}")
    path = axis(tmp_path, change, ("[move]", f'[units]\noutput = "{output}"\n[move]'))
    try:
        words = [item for item in questions(path) if "deg meant? Then write 0.5236" in item]
    finally:
        use_units("m", "N")
    assert bool(words) == (output == "rad" and far == "30.0")


def case_study(**more: Any) -> Case:
    tables = tomllib.loads(ccd.TWO_MASS.read_text(encoding="utf-8"))
    for name, keys in more.items():
        tables[name] = tables.get(name, {}) | keys
    return ccd.parse_case(tables)


@pytest.mark.parametrize("low", [0.5, 5.0, 200.0, 1000.0])
@pytest.mark.parametrize("S_low", [0.003, 0.03, 0.3, 0.9])
def test_s_low_above_what_limits_the_bandwidth_is_a_question(low: float, S_low: float) -> None:
    """Where it needs more bandwidth than the resonance or M_K leaves, and nowhere else."""
    case = case_study(inner={"omega_low_hz": low, "S_low": S_low})
    problem = ccd.problem_of(case)
    words = [item for item in suspicions(problem) if "omega_low_hz" in item]
    assert len(words) == (low >= 200.0 and S_low < 0.7)
    if words:  # 65 Hz by M_K, below the resonance at 250 Hz
        assert f"omega_low_hz = {low:g}" in words[0]
        assert "M_K suits a bandwidth of at most 6" in words[0]


def test_inner_names_it_where_no_design_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = ccd.TWO_MASS.read_text(encoding="utf-8")
    path = tmp_path / "case.toml"
    path.write_text(text.replace("omega_low_hz = 1.0", "omega_low_hz = 300.0"), encoding="utf-8")
    words = ["--theta", "m1=60,m2=60", "--workers", "1", "--quiet"]
    assert inner([str(path), *words]) == 3
    assert "inner.omega_low_hz = 300" in capsys.readouterr().out


@pytest.mark.parametrize("output", ["rad", "m"])
def test_a_soft_rotary_stage_is_asked_about_degrees(output: str) -> None:
    """Where M_K suits far more than its first resonance."""
    units = {"output": "rad", "input": "N m"} if output == "rad" else {}
    case = case_study(units=units, weights={"M_K": 1e11})
    try:
        found = [words for words in suspicions(ccd.problem_of(case)) if "first resonance" in words]
    finally:
        use_units("m", "N")
    assert len(found) == 1
    assert ("per degree is 57.3 times" in found[0]) == (output == "rad")
    assert ("1 N/um is 1e6 N/m" in found[0]) == (output == "m")


@pytest.mark.parametrize("unit", ["N", "N m", "V", "A"])
@pytest.mark.parametrize("M_K", [2e7, 20.0, 2e10])
def test_no_mass_is_moved_by_what_is_not_a_force(unit: str, M_K: float) -> None:
    """In no word of `check`, whatever else it warns of."""
    case = case_study(units={"input": unit}, weights={"M_K": M_K})
    problem = ccd.problem_of(case)
    try:
        facts, findings = diagnose(problem)
        found = plant_report(case, problem, facts, findings)
    finally:
        use_units("m", "N")
    words = [found["size"], *(item["words"] for item in found["findings"])]
    force = unit.startswith("N")
    assert ("felt by an actuator" in found["size"]) == force
    assert force or not [text for text in words if "kg" in text or "force over" in text]
    undeclared = [text for text in words if "that an actuator feels" in text or text == words[0]]
    assert all(("if its input is in N" in text) == (unit == "N") for text in undeclared)
    assert found["size"]  # the resonance and M_K stay


def test_a_bound_of_the_compliance_that_bounds_nothing_is_asked_about(tmp_path: Path) -> None:
    """In µm/N; as shipped, 20 µm/N, there is no question."""
    assert questions(axis(tmp_path)) == []
    (words,) = questions(axis(tmp_path, ("compliance_max = 2e-5", "compliance_max = 20.0")))
    assert "compliance_max = 20: 20 m/N bounds nothing" in words
    assert words.endswith("Then write 2e-05")
