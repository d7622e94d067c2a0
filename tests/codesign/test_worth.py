"""`ccd worth`: both designs are true, co-design is no worse, and a full solve gains the same."""

import json
from pathlib import Path

import pytest

from ccd_casadi import HZ, Lifted, load_case, problem_of, solve
from ccd_casadi.inner_problem.problem import true_inner
from ccd_casadi.worth import main

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"


def test_the_gain_is_that_of_a_full_solve(tmp_path, capsys) -> None:
    assert main([str(TWO_MASS), "--out", str(tmp_path), "--workers", "1"]) == 0
    found = json.loads((tmp_path / "worth.json").read_text())
    said = capsys.readouterr().out
    assert said.startswith("answer        Co-design changes the hardware cost by -")
    problem = problem_of(load_case(TWO_MASS))
    old, new = found["sequential"], found["co_design"]
    for each in (old, new):  # the bandwidth is that of the true inner problem
        inner = true_inner(problem, tuple(each["theta"].values()))
        assert inner.bandwidth / HZ == pytest.approx(each["bandwidth_hz"], rel=1e-6)
        assert each["hardware_cost"] == pytest.approx(sum(each["theta"].values()))
    assert found["resonance_met"]
    assert found["first_resonance_hz"] == pytest.approx(250.0, rel=1e-6)  # the case's rule
    solved = solve(problem, Lifted(points=24, box_points=4)).result
    for key, percent in (
        ("hardware_cost", "hardware_cost_percent"),
        ("bandwidth_hz", "bandwidth_percent"),
    ):
        assert found[percent] == pytest.approx(100.0 * (solved[key] / old[key] - 1.0), abs=3.0)
    assert found["uncertainty_percent"] > 0.0


def test_a_case_that_it_cannot_count_is_one_line(tmp_path, capsys) -> None:
    listed = TWO_MASS.read_text().replace(
        "lower = 55.0\nupper = 70.0\nstart = 67.56", "values = [55.0, 60.0]", 1
    )
    case = tmp_path / "case.toml"
    case.write_text(listed)
    assert main([str(case), "--out", str(tmp_path / "out")]) == 2
    assert "worth needs a range" in capsys.readouterr().err
