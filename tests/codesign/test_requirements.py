"""The requirements beside what is achieved: of the judge, with margins, on pages and terminal."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.inner_problem.structured_plant_set import _plant_words
from ccd_casadi.reporting.facts import requirement_lines, requirements_table


def test_they_are_the_judges_figures(solved: Callable[[str], Path]) -> None:
    result = json.loads((solved("lifted") / "result.json").read_text())
    found = {one["name"]: one for one in result["requirements"]}
    assert list(found) == ["S_max", "S_low"]
    for name, share in result["judge"]["figures"].items():
        one = found[name]
        assert one["achieved"] == pytest.approx(share * one["required"], rel=1e-12)
        assert one["margin"] == pytest.approx(1.0 - share, abs=1e-12)
        assert (one["plant"], one["evidence"]) == ("", "judged")
    assert found["S_max"]["frequency_hz"] == pytest.approx(result["sensitivity_peak_hz"])
    lines, table = requirement_lines(result), requirements_table(result)
    assert len(lines) == len(table.rows) == 2
    assert lines[0].startswith("S_max 1.75: 1.75, margin ")


def test_a_figure_that_is_not_known_is_no_figure() -> None:
    one = {"name": "S_max", "required": 2.0, "achieved": None, "margin": None, "plant": "",
           "frequency_hz": None, "evidence": "judged"}  # fmt: skip
    assert requirement_lines({"requirements": [one]}) == [
        "S_max 2: not known, margin not known, judged"
    ]


def test_a_plant_is_named_by_what_it_differs_in() -> None:
    names = ("resonance_shift", "damping", "gain", "theta.load")
    at = np.array([-0.03, 1.0, 0.0, 4.0])
    assert _plant_words(names, 0, at) == "resonance_shift -3 %, load = 4"
    assert (
        _plant_words(names[:3], 2, np.array([0.0, 0.5, 0.05]))
        == "[robust] plants 2, damping x 0.5, gain +5 %"
    )
    assert _plant_words(names[:3], 0, np.array([0.0, 1.0, 0.0])) == "the model"
