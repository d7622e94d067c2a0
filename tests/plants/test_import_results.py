"""Result files of finite-element programs: CalculiX's as it wrote them, Nastran's in its format.

tests/data/calculix holds the results of CalculiX 2.20 for a free beam of 8, 10 and 12 mm
(beam_10.inp is the input of one). The .f06 here is written by the test in Nastran's layout, with
the same modes under other modal masses.
"""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.extensions.imported import main
from ccd_casadi.extensions.imported.interpolation import InterpolatedModes
from ccd_casadi.extensions.imported.modal_table import read_modal_table
from ccd_casadi.extensions.imported.result_files import ResultModes, read_modes

DATA = Path(__file__).parents[1] / "data" / "calculix"
MIDDLE, ENDS = (2, 3, 6, 7), (1, 4, 5, 8)


def f06(modes: ResultModes, mass: float) -> str:
    """Nastran's print of these modes, each scaled to a modal mass, with a page break inside."""
    omega = 2.0 * np.pi * modes.frequency_hz
    page = (
        "1    A BEAM                                     NOVEMBER  21, 2026  NASTRAN   PAGE     1\n"
    )
    lines = [page, " " * 46 + "R E A L   E I G E N V A L U E S\n"]
    lines.append("   MODE    EXTRACTION      EIGENVALUE            RADIANS             CYCLES   \n")
    lines.append("    NO.       ORDER                                  MASS     STIFFNESS\n")
    for i, w in enumerate(omega):
        numbers = (w**2, w, w / (2.0 * np.pi), mass, mass * w**2)
        lines.append(f"{i + 1:9d}{i + 1:10d}" + "".join(f"{v:20.6E}" for v in numbers) + "\n")
    for i, w in enumerate(omega):
        banner = (
            f"      EIGENVALUE = {w**2:13.6E}\n          CYCLES = {w / (2 * np.pi):13.6E}"
            f"         R E A L   E I G E N V E C T O R   N O . {i + 1:10d}\n \n"
            "      POINT ID.   TYPE          T1             T2             T3             R1\n"
        )
        lines += [page, banner]
        for k, (node, shapes) in enumerate(modes.displacements.items()):
            if k == 6:  # the block goes on over the page
                lines += [page, banner]
            values = "".join(f"{v * mass**0.5:15.6E}" for v in shapes[i])
            lines.append(f"{node:14d}      G {values}\n")
    return "".join(lines)


def folder_of(folder: Path, suffix: str) -> Path:
    rows = ["t,results,damping,hardware_cost"]
    for t in (8, 10, 12):
        name = f"beam_{t:02d}{suffix}"
        if suffix == ".frd":
            shutil.copy(DATA / name, folder)
        else:
            modes = read_modes(DATA / f"beam_{t:02d}.frd")
            (folder / name).write_text(f06(modes, 0.3 * t))
        rows.append(f"{t}e-3,{name},0.01,{mass_of(t * 1e-3)}")
    (folder / "index.csv").write_text("\n".join(rows) + "\n")
    dofs = ["kind,name,node,direction,gain"]
    for kind, name, nodes in (("in", "force", ENDS), ("out", "end", ENDS), ("out", "mid", MIDDLE)):
        dofs += [f"{kind},{name},{node},z,0.25" for node in nodes]
    (folder / "dofs.csv").write_text("\n".join(dofs) + "\n")
    return folder


def mass_of(t: float) -> float:
    return 2700.0 * 0.2 * 0.02 * t


@pytest.mark.parametrize("suffix", [".frd", ".f06"])
def test_results_become_a_table_and_a_plant(tmp_path: Path, suffix: str) -> None:
    assert main([str(folder_of(tmp_path, suffix)), "--quiet"]) == 0
    table = read_modal_table(tmp_path / "modes.csv")
    assert table.omega.shape == (3, 9)
    modes = InterpolatedModes(table, 2.0 * np.pi * 0.1)
    assert modes.rigid == 6
    for s, t in enumerate((8e-3, 10e-3, 12e-3)):
        middle = table.outputs[s, :6, 1]
        assert middle @ middle == pytest.approx(1.0 / mass_of(t), rel=1e-5)
    for t in (8e-3, 9e-3, 11.5e-3):
        system = modes([t])
        rigid_mid = system.C[1, :6]
        # the middle of a free beam moves as its whole mass does; three samples settle no more than
        # a straight line for 1/√m
        assert rigid_mid @ rigid_mid == pytest.approx(1.0 / mass_of(t), rel=0.02)
        # bending follows the thickness: f ~ t for a slender beam
        first = np.sqrt(system.K[6, 6])
        assert first == pytest.approx(table.omega[1, 6] * t / 10e-3, rel=0.02)


def test_both_programs_results_give_the_same_table(tmp_path: Path) -> None:
    tables = []
    for suffix in (".frd", ".f06"):
        folder = tmp_path / suffix[1:]
        folder.mkdir()
        assert main([str(folder_of(folder, suffix)), "--quiet", "--out", str(folder / "o")]) == 0
        tables.append(read_modal_table(folder / "o" / "modes.csv"))
    one, other = tables
    np.testing.assert_allclose(other.omega, one.omega, rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(other.inputs, one.inputs, rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(other.outputs, one.outputs, rtol=2e-6, atol=1e-6)


def test_the_summary_says_what_was_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(folder_of(tmp_path, ".frd"))]) == 0
    assert "3 samples of 9 modes, t" in capsys.readouterr().out
    with (tmp_path / "modes.csv").open() as file:
        assert next(csv.reader(file))[:5] == ["t", "mode", "frequency_hz", "damping", "in:force"]


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("index.csv", "beam_10.frd", "beam_11.frd", "beam_11.frd: cannot be read"),
        ("index.csv", "beam_10.frd", "beam.odb", "is not a result file that is read: .frd"),
        ("index.csv", "results", "file", "has neither a column results nor"),
        ("index.csv", "0.01", "light", "damping: 'light' is not a number"),
        ("dofs.csv", "in,force,1,z", "in,force,99,z", "node: 99 has no displacements"),
        ("dofs.csv", "in,force,1,z", "in,force,1,w", "direction: 'w' is none of x, y, z"),
        ("dofs.csv", "in,force", "out,force", "names no in"),
        ("beam_10.frd", "DISP ", "FORC ", "holds no eigenvectors"),
        ("beam_10.frd", " -1         1-", " -1         1?", "beam_10.frd: is damaged"),
    ],
)
def test_wrong_results_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, old: str, new: str, words: str
) -> None:
    path = folder_of(tmp_path, ".frd") / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    assert main([str(tmp_path)]) == 2
    line = capsys.readouterr().err
    assert words in line
    assert len(line.splitlines()) == 1
