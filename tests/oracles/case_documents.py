"""Case documents to be edited, and what becomes of them: a case, or one line."""

import dataclasses
import tomllib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from ccd_casadi.cases.case import CaseError, case_to_toml, load_case, parse_case
from ccd_casadi.cases.tables import Case

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"
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
# What is left of [inner] after S_max, then weights and structure: quick to design.
SECTIONS_TABLES = """S_low = 0.2
omega_low_hz = 1.0
omega_S_hz = [10.0, 1800.0]
omega_T_hz = [25.0, 1000.0]
[weights]
M_S = 2.0
A_S = 1e-4
c_K = 1e4
omega_K_hz = 100.0
M_K = 2e7
A_l = 1.0
A_u = 1e-2
[controller]
structure = "sections"
starts = 4
weighted_level = 8.426
biquads = 0"""
# Solved in seconds.
QUICK_SECTIONS = f"""
[plant]
model = "two_mass"
[theta.m1]
lower = 58.0
upper = 60.0
start = 59.0
unit = "kg"
[theta.m2]
lower = 58.0
upper = 60.0
start = 59.0
unit = "kg"
[objective]
w1 = 0.0995
w2 = -0.9950
[inner]
S_max = 1.75
{SECTIONS_TABLES}
[loop]
rate_hz = 8000.0
delay_us = 80.0
[robust]
gain = 0.02
[sampling]
points = 2
[outer]
box_points = 0
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
