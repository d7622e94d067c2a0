"""Solving case study 1, and cases changed from it, as a user does."""

import json
import re
from pathlib import Path
from typing import Any

from ccd_casadi.solve import main

TWO_MASS = Path(__file__).parents[2] / "runs" / "two_mass.toml"
PLANT = """
from ccd_casadi.plants.registry import two_mass

def model(theta, least):
    total = theta["m1"] + theta["m2"]
    return two_mass(theta, 0.01) | {"constraints": {"total": least - total}}
"""


def run(folder: Path, *more: str, case: Path = TWO_MASS) -> int:
    return main([str(case), "--out", str(folder), "--workers", "1", "--quiet", *more])


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


def changed(folder: Path, *changes: tuple[str, str], more: str = "") -> Path:
    """A copy of the two-mass case with lines replaced and sections appended."""
    text = TWO_MASS.read_text()
    for old, new in changes:
        assert text.count(old) == 1, f"{old} is not once in the case file"
        text = text.replace(old, new)
    path = folder / "case.toml"
    path.write_text(text + more)
    return path


def own_plant(folder: Path, least: float, more: str = "") -> Path:
    (folder / "plant.py").write_text(PLANT)
    lines = f'function = "plant.py:model"\nleast = {least}\n'
    text = re.sub(r'model = "two_mass".*\nzeta = .*\n', lines, TWO_MASS.read_text())
    path = folder / "case.toml"
    path.write_text(text + more)
    return path
