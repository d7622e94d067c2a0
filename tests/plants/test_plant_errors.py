"""What goes wrong in a user's plant function is told as what it is, with its text and its line."""

import subprocess
import sys
from pathlib import Path

import casadi as ca
import pytest

from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.plants.model_function import model_parts
from ccd_casadi.support.errors import PlantError

ROOT = Path(__file__).parents[2]
PLANT = """
import numpy as np

def stage(theta):
    a, b = float(theta["m1"]), float(theta["m2"])
    {line}
    one = np.array([[1.0], [0.0]])
    return {{"mass": np.diag([a, b]), "stiffness": 4e7 * np.array([[1.0, -1.0], [-1.0, 1.0]]),
            "damping_ratio": 0.01, "input": one, "output": one.T, "hardware_cost": a + b{more}}}
"""
AT = "a > 62 and b > 62"


def case_of(folder: Path, line: str, more: str = "") -> Path:
    """Case study 1 with this line in its plant, and no time to lose."""
    (folder / "plant.py").write_text(PLANT.format(line=line, more=more))
    text = (ROOT / "runs/two_mass.toml").read_text()
    text = text.replace('model = "two_mass"', 'function = "plant.py:stage"')
    text = "\n".join(row for row in text.splitlines() if not row.startswith("zeta"))
    (folder / "case.toml").write_text(text + "\n[limits]\nplant_seconds = 1\n")
    return folder / "case.toml"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (f"assert not ({AT}), 'too heavy'", "raised AssertionError: too heavy in line 6"),
        (f"{{}}['k'] if {AT} else 0", "raised KeyError: 'k' in line 6"),
        (f"while {AT}: pass", "did not return within 1 s"),
        (f"if {AT}: raise SystemExit(3)", "would end the program .SystemExit: 3 in line 6"),
        (f"if {AT}: __import__('os')._exit(0)", r"would end the program .os._exit\(0\) in line 6"),
        ("return None", "returned None"),
        ("return [a, b]", "returned a list"),
    ],
)
def test_each_fault_is_reported_as_what_it_is(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(CaseError, match=words) as error:
        problem_of(load_case(case_of(tmp_path, line)))
    assert "\n" not in str(error.value)
    assert "nan" not in str(error.value)


@pytest.mark.parametrize(
    ("more", "words"),
    [(', "constraints": [a - 80.0]', "constraints is a list"),
     (', "constraints": None', "constraints is a NoneType"),
     (', "constraints": {"heavy": None}', "heavy is None"),
     (', "constraints": {"heavy": a < 80.0}', "heavy is a comparison; .* h - 1.2 for h < 1.2"),
     (', **{"damping_ratio": (0.01,)}', "damping_ratio is a tuple; give one number")],
)  # fmt: skip
def test_what_is_returned_in_another_form_is_named(tmp_path: Path, more: str, words: str) -> None:
    with pytest.raises(CaseError, match=words):
        problem_of(load_case(case_of(tmp_path, "pass", more)))


def test_a_plant_that_ends_the_process_ends_no_run_as_done(tmp_path: Path) -> None:
    case = case_of(tmp_path, f"if {AT}: __import__('os')._exit(0)")
    command = [sys.executable, "-m", "ccd_casadi.solve", str(case), "--out", str(tmp_path / "out")]
    done = subprocess.run([*command, "--quiet", "--workers", "1"], cwd=ROOT, capture_output=True,
                          text=True, timeout=300)  # fmt: skip
    assert done.returncode == 2
    assert "would end the program" in done.stderr
    assert not (tmp_path / "out/result.json").exists()


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize(
    "bound", ["h < 1.2", "h >= 1.2", "1.2 == h", "ca.logic_and(h < 1.2, h > 0.8)"]
)
def test_a_comparison_is_no_constraint(kind: type, bound: str) -> None:
    h = kind.sym("h")
    parts = {"mass": h, "stiffness": 1e4, "damping_ratio": 0.01, "input": 1.0,
             "output": 1.0, "hardware_cost": h}  # fmt: skip
    given = {"ca": ca, "h": h}
    with pytest.raises(PlantError, match="constraint light is a comparison"):
        model_parts(parts | {"constraints": {"light": eval(bound, given)}}, kind)
    model_parts(parts | {"constraints": {"light": h - 1.2, "idle": 0.0}}, kind)
