"""Of a plant from torque to angle no word speaks of newtons on metres."""

import re
import tomllib

import numpy as np

import ccd_casadi as ccd
from ccd_casadi.analysis.move import Move
from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.diagnosis import diagnose, plant_report
from ccd_casadi.codesign.inner_answer import InnerOptions, mixed_answer
from ccd_casadi.reporting.facts import facts
from ccd_casadi.reporting.moves import way_words
from ccd_casadi.support.process_pool import Workers

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
