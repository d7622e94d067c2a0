"""[budget] of a case file, and what becomes of it in results, pages and on the terminal."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.case_documents import TWO_MASS

from ccd_casadi.budget.error_density import integrate
from ccd_casadi.budget.sources import ShapedSpectrum, SourceKind, TabulatedSpectrum
from ccd_casadi.cases.case import CaseError, case_to_toml, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.result_entries import budget_entry
from ccd_casadi.drawing.paint import block_html
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.reporting.facts import loop_lines
from ccd_casadi.reporting.limit_figures import budget_chapter
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.synthesis import synthesise

BUDGET = """
[budget]
window_ms = 10.0
[[budget.force]]
name = "cables"
unit = "N^2/Hz"
level = 1e-2
poles_hz = [20.0]
[[budget.force]]
name = "amplifier"
unit = "N/rtHz"
level = 1e-3
[budget.floor_motion]
unit = "(m/s^2)^2/Hz"
file = "floor.csv"
mass = 110.0
[budget.sensor_noise]
unit = "nm/rtHz"
level = 0.05
[budget.setpoint]
unit = "m^2/Hz"
level = 1e-12
poles_hz = [[1.0, 0.7]]
"""
FLOOR = "f_hz,density\n0.5,1e-9\n5; 1e-8  # a comment\n\n200\t1e-10\n"


def written(folder: Path, text: str = BUDGET) -> Case:
    (folder / "floor.csv").write_text(FLOOR)
    path = folder / "case.toml"
    path.write_text(TWO_MASS.read_text() + text)
    return load_case(path)


def test_a_budget_is_read_in_si_and_comes_back(tmp_path: Path) -> None:
    case = written(tmp_path)
    again = tmp_path / "elsewhere" / "again.toml"
    again.parent.mkdir()
    again.write_text(case_to_toml(case))  # the file of the floor is in it, not beside it
    assert replace(load_case(again), path=case.path) == case
    problem = problem_of(case)
    assert problem.budget is not None
    assert problem.budget.window == pytest.approx(0.01)
    cables, amplifier, floor, noise, setpoint = problem.budget.sources
    assert (cables.kind, cables.name) == (SourceKind.FORCE, "cables")
    assert amplifier.spectrum.level == pytest.approx(1e-6)
    assert floor.spectrum == TabulatedSpectrum((0.5, 5.0, 200.0), (1e-9, 1e-8, 1e-10))
    assert floor.of_acceleration
    assert noise.spectrum.level == pytest.approx(2.5e-21)
    assert setpoint.name == "setpoint"
    # A mass on an accelerating floor feels m a.
    np.testing.assert_allclose(floor.density(np.array([5.0])), [110.0**2 * 1e-8])
    # What is only judged determines no sample.
    assert problem.identity() == replace(problem, budget=None).identity()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[budget]\nwindow_ms = 1.0\n", "no spectrum to go with"),
        ("[budget]\nforce = 3\n", "write a table"),
        ('[budget.force]\nlevel = 1.0\nunit = "N"\n', 'choose one of "N^2/Hz"'),
        ("[budget.force]\nlevel = 1.0\n", "choose one of"),
        ('[budget.force]\nunit = "N^2/Hz"\n', "give one of level, psd and file"),
        ('[budget.force]\nunit = "N^2/Hz"\nlevel = 1.0\nmass = 1.0\n', "unknown key"),
        ('[budget.force]\nunit = "N^2/Hz"\nlevel = -1.0\n', "give a number above 0"),
        ('[budget.force]\nunit = "N^2/Hz"\nlevel = 1.0\npoles_hz = [[1.0, 2.0, 3.0]]\n', "damping"),
        ('[budget.force]\nunit = "N^2/Hz"\nlevel = 1.0\nzeros_hz = [1.0]\n', "as many poles"),
        ('[budget.force]\nunit = "N/rtHz"\npsd = [[1.0, 1.0], [2.0, -1.0]]\n', "above 0"),
        ('[budget.force]\nunit = "N^2/Hz"\npsd = [[2.0, 1.0], [1.0, 1.0]]\n', "have to rise"),
        ('[budget.force]\nunit = "N^2/Hz"\nfile = "none.csv"\n', "cannot be read"),
        ('[budget.force]\nunit = "N^2/Hz"\nfile = "wrong.csv"\n', "line 2"),
        ('[budget.floor_motion]\nunit = "m^2/Hz"\nlevel = 1.0\n', "needs a mass"),
        ('[budget.setpoint]\nunit = "m^2/Hz"\nlevel = 1.0\n', "has to fall off"),
    ],
)
def test_mistakes_are_one_line_with_a_remedy(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "wrong.csv").write_text("1.0, 2.0\n3.0\n")
    with pytest.raises(CaseError, match="budget") as caught:
        written(tmp_path, text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_budget_of_a_design_in_result_terminal_and_page(tmp_path: Path) -> None:
    problem = problem_of(written(tmp_path))
    weights = problem.weights.at(72.0 * HZ, 150.0 * HZ)
    made = synthesise(scaled_plant(problem, (55.0, 55.0)), weights, omega_low=HZ)
    found = budget_entry(problem, (55.0, 55.0), made.controller)
    budget = json.loads(json.dumps(json_values(found), allow_nan=False))["budget"]
    shares = [item["share"] for item in budget["sources"]]
    assert sum(shares) == pytest.approx(1.0)
    squares = sum(item["error_rms"] ** 2 for item in budget["sources"])
    assert budget["error_rms"] ** 2 == pytest.approx(squares)
    assert budget["error_rms_largest"] == pytest.approx(budget["error_rms"])
    assert budget["disagreement"] < 1e-5
    (line,) = loop_lines({"budget": budget})
    assert "cables has" in line
    (section,) = budget_chapter(problem, (55.0, 55.0), made.controller)
    for name in ("cables", "amplifier", "floor motion", "sensor noise", "setpoint", "together"):
        assert name in block_html(section, "1")
    none = replace(problem, budget=None)
    assert budget_entry(none, (55.0, 55.0), made.controller) == {}
    assert budget_chapter(none, (55.0, 55.0), made.controller) == []
    assert loop_lines({}) == []


def test_the_rms_of_a_spectrum_is_its_integrals_root() -> None:
    table = TabulatedSpectrum((0.5, 5.0, 50.0, 60.0), (1e-3, 1e-4, 1e-4, 1e-9))  # slopes -1, 0
    shaped = ShapedSpectrum(2.0, ((3.0,),), ((5.0, 0.2), (40.0,)))
    for spectrum, ends in ((table, np.array(table.hz)), (shaped, np.geomspace(1e-6, 1e8, 150))):
        whole = integrate(lambda hz, S=spectrum: S.at(hz)[None], ends)
        assert spectrum.rms() == pytest.approx(float(np.sqrt(whole.value[0])), rel=1e-6)
    assert ShapedSpectrum(1.0).rms() is None
