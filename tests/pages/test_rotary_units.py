"""Of a plant from torque to angle no word speaks of newtons on metres."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ccd_casadi as ccd
from ccd_casadi.analysis.move import Move
from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.diagnosis import diagnose, plant_report
from ccd_casadi.codesign.inner_answer import InnerOptions, mixed_answer
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.reporting.facts import facts
from ccd_casadi.reporting.moves import cycle_chapter, way_words
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.text import spoken, use_units

LINEAR = re.compile(r"\d [kMG]?N\b(?! m)|/N\b|(?<![\w])[nµum]?m\b(?=/N|$)|\bN/|\bkg\b(?! m²)")
TABLES = tomllib.loads(ccd.TWO_MASS.read_text(encoding="utf-8"))
TABLES["inner"] = TABLES["inner"] | {"compliance_max": 1e-5}
for table in TABLES["theta"].values():
    table.pop("unit")
TABLES["objective"].pop("cost_unit", None)


def words_of(units: dict[str, str]) -> list[str]:
    """What `check`, `inner` and the pages' tables say of case study 1."""
    case = ccd.parse_case(TABLES | {"units": units})
    problem = ccd.problem_of(case)
    found = plant_report(case, problem, *diagnose(problem))
    how = InnerOptions(0, Workers(1), lambda _: None, (800.0 * ccd.HZ, 40.0 * ccd.HZ), None)
    answer = mixed_answer(problem, (60.0, 60.0), how).figures
    bounds = facts("problem", problem, "", "")
    assert ccd.parse_case(tomllib.loads(case_to_toml(case))).units == case.units
    return [found["size"], answer["compliance_words"], *(cell for row in bounds for cell in row)]


def test_a_rotation_is_spoken_of_in_its_units() -> None:
    turned = words_of({"output": "rad", "input": "N m"})
    assert not [words for words in turned if LINEAR.search(words)]
    assert [words for words in turned if "rad/(N m)" in words]
    moved = words_of({})
    assert [words for words in moved if LINEAR.search(words)]
    assert not [words for words in moved if "rad" in words.replace("rad/s", "")]


def test_what_holds_a_stage_on_springs_is_said_with_its_move() -> None:
    """A scanner cannot make the move that suits a carriage."""
    time = np.linspace(0.0, 1.0, 50)
    far, nothing = np.minimum(time, 0.5), np.zeros(50)
    pushed = 25e6 * far[:, None]
    free = 10.0 * np.sin(2.0 * np.pi * time)[:, None]

    def words(force: np.ndarray) -> str:
        return way_words("a", [Move(time, far, nothing, force, True, 0.5, 1e-6)])

    assert "12.5 MN hold the stage there" in words(pushed)
    assert "hold" not in words(free)


def test_a_unit_in_brackets_is_the_cases_too() -> None:
    """Of axes and heads; a unit that is a quotient has its own brackets once."""
    use_units("rad", "N m")
    try:
        said = [spoken(words) for words in ("force 1 (N)", "gain (N/m)", "left (µm/N)", "/N")]
    finally:
        use_units("m", "N")
    assert said == ["force 1 (N m)", "gain (N m/rad)", "left (µrad/(N m))", "/(N m)"]


def test_the_motors_figure_is_the_feedforward_that_the_loop_holds() -> None:
    """Its largest force is that of `result.json`, and its axis has the case's unit."""
    path = Path(ccd.__file__).parents[1] / "examples" / "linear_motor_axis" / "case.toml"
    case = ccd.load_case(path)
    sampled = replace(case, loop=replace(case.loop, rate_hz=8000.0, delay_us=125.0))
    problem = ccd.problem_of(replace(sampled, units=replace(case.units, output="rad", input="N m")))
    try:
        motion = motion_of(problem, problem.start)
        shares = {"peak_share": 1.0, "heat_share": 1.0, "settled_latest": None, "power": 1.0}
        shown = {"peak_force": 1.0, "peak_current": 1.0, "rms_force": 1.0, "limits": []} | shares
        (chapter,) = cycle_chapter(problem, problem.start, {"move": shown})
        figure = chapter.body[0]
        panel = figure.drawing.rows[0][0]
    finally:
        use_units("m", "N")
    most = float(np.abs(panel.curves[0].y).max())
    assert most == pytest.approx(motion.forward_force(problem.sampling), rel=1e-9)
    assert panel.y_label.endswith("(N m)")
    assert "feedforward alone" in figure.caption
