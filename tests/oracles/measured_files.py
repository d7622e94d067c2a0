"""Case study 1 as a spectrum analyser would give it, and as a case file."""

from pathlib import Path

import numpy as np

from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.text import HZ
from oracles.case_documents import SECTIONS_TABLES
from oracles.fixed_structure_loops import FAST, plant

CASE = f"""
[plant]
model = "measured"
file = "stage.csv"
[inner]
S_max = 2.0
{SECTIONS_TABLES}
"""


def measured(sampling: Sampling | None, lines: int = 2000) -> MeasuredResponse:
    """Case study 1 as a spectrum analyser would give it, hold and delay in it."""
    P = plant_set([plant()], sampling)
    hz = np.geomspace(0.3, 4900.0, lines)
    G = P.responses(np.zeros(lines, int), P.variable(HZ * hz / P.omega_0))[0][:, 0, 0] / P.force
    return MeasuredResponse(hz, G)


def written(folder: Path, text: str = CASE, sampled: bool = False, lines: int = 1200) -> Path:
    """The case's path; its response beside it."""
    found = measured(FAST if sampled else None, lines)
    rows = np.column_stack([found.hz, found.G.real, found.G.imag])
    np.savetxt(folder / "stage.csv", rows, delimiter=",", header="f_hz,re,im", comments="")
    path = folder / "case.toml"
    path.write_text(text)
    return path
