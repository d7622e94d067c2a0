"""Modes from result files of finite-element programs: CalculiX (.frd) and Nastran (.f06).

Both are read narrowly: the eigenvectors of a normal-modes analysis as text, nothing else. CalculiX
scales its modes to unit modal mass; Nastran prints the modal masses, and these are taken.

The folder holds `index.csv`, one row a sample: the parameters of θ, `results` (file), `damping`
(modal ratio), `hardware_cost`, `constraint:NAME`; and `dofs.csv`: `kind` (in, out or shape),
`name`, `node`, `direction` (x, y, z, rx, ry, rz) and `gain`, as many rows a name as it takes.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ccd_casadi.plants.imported.matrices import read_dofs, read_index, table_of_samples
from ccd_casadi.plants.imported.modal_table import ModalTable, Rows, number_in
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
COLUMNS = ("kind", "name", "node", "direction", "gain")
_VALUE = re.compile(r"[-+]?\d*\.\d+(?:[EeDd]?[-+]\d+)?")
_VECTOR = re.compile(r"R E A L   E I G E N V E C T O R   N O \.\s+(\d+)")


@dataclass(frozen=True)
class ResultModes:
    """frequency_hz (r,), and the mass-normalised displacements (r, 6) of each node."""

    frequency_hz: Array
    displacements: Mapping[int, Array]


def results_table(folder: Path) -> ModalTable:
    """The modal table of a folder of result files.

    Raises PlantError where a file or node is missing, or a file holds no modes.
    """
    index, dofs = read_index(folder, "results", "damping"), read_dofs(folder, COLUMNS)
    found = [read_modes(folder / row["results"]) for row in index.values()]
    kinds = ("in", "out", "shape")
    modes = [
        (2.0 * np.pi * one.frequency_hz, *(_picked(dofs, kind, one) for kind in kinds))
        for one in found
    ]
    return table_of_samples(folder, index, dofs, modes)


def read_modes(path: Path) -> ResultModes:
    """The modes in a .frd or .f06 file. Raises PlantError where there are none."""
    readers = {".frd": _frd, ".f06": _f06}
    if path.suffix.lower() not in readers:
        raise PlantError(f"{path}: is not a .frd (CalculiX) or .f06 (Nastran); name one of these")
    try:
        lines = path.read_text(encoding="latin-1").splitlines()
    except OSError as error:
        raise PlantError(f"{path}: cannot be read: {error.strerror}; name a result file") from None
    try:
        frequencies, masses, vectors = readers[path.suffix.lower()](lines)
    except (ValueError, IndexError, KeyError) as error:
        raise PlantError(f"{path}: is damaged: {error}; run the analysis again") from None
    counts = {len(vector) for vector in vectors}
    if not vectors or len(frequencies) < len(vectors) or len(counts) != 1 or counts == {0}:
        raise PlantError(
            f"{path}: holds no eigenvectors of one set of nodes; ask the program to print them "
            "(CalculiX: *NODE FILE U; Nastran: VECTOR(PRINT) = ALL)"
        )
    order = np.argsort(frequencies[: len(vectors)], kind="stable")
    scale = 1.0 / np.sqrt(np.array(masses)[order])
    nodes = vectors[0].keys()
    shapes = {n: np.array([vectors[i][n] for i in order]) * scale[:, None] for n in nodes}
    return ResultModes(np.array(frequencies)[order], shapes)


def _frd(lines: list[str]) -> tuple[list[float], list[float], list[dict[int, Array]]]:
    """Displacement blocks that carry a mode: `100C` line, `-4 DISP`, ` -1` rows of fixed width."""
    frequencies: list[float] = []
    vectors: list[dict[int, Array]] = []
    frequency, reading, mode = 0.0, False, False
    for line in lines:
        if line.startswith("    1PMODE"):
            mode = True
        elif line.startswith("  100C"):
            frequency = float(line[12:24])
        elif line.startswith(" -4"):
            reading = mode and line.split()[1] == "DISP"
            if reading:
                frequencies.append(frequency)
                vectors.append({})
        elif line.startswith(" -3"):
            reading = mode = False
        elif reading and line.startswith(" -1"):
            values = [float(line[13 + 12 * k : 25 + 12 * k]) for k in range(3)]
            vectors[-1][int(line[3:13])] = np.array([*values, 0.0, 0.0, 0.0])
    return frequencies, [1.0] * len(frequencies), vectors


def _f06(lines: list[str]) -> tuple[list[float], list[float], list[dict[int, Array]]]:
    """The table of real eigenvalues, and the blocks of real eigenvectors over all pages."""
    frequencies: list[float] = []
    masses: list[float] = []
    vectors: dict[int, dict[int, Array]] = {}
    table, block = False, None
    for line in lines:
        words = line.split()
        found = _VECTOR.search(line)
        if "R E A L   E I G E N V A L U E S" in line:
            table, block = True, None
        elif found is not None:
            table, block = False, vectors.setdefault(int(found.group(1)), {})
        elif line.startswith("1"):  # a new page; its banner says what goes on
            table, block = False, None
        elif table and len(words) == 7 and words[0].isdigit() and words[1].isdigit():
            frequencies.append(_float(words[4]))
            masses.append(_float(words[5]))
        elif block is not None and len(words) > 2 and words[0].isdigit() and words[1] == "G":
            values = _VALUE.findall(line)
            block[int(words[0])] = np.array([_float(value) for value in values[:6]])
    return frequencies, masses, [vectors[i] for i in sorted(vectors)]


def _float(text: str) -> float:
    """Fortran's numbers: 1.0E+00, 1.0D+00 and 1.0-3."""
    text = re.sub("[Dd]", "E", text)
    return float(re.sub(r"(?<=[\d.])([-+])", r"E\1", text) if "E" not in text.upper() else text)


def _picked(dofs: Rows, kind: str, modes: ResultModes) -> Array:
    """(r, k) displacement along each name of this kind."""
    names = list(dict.fromkeys(row["name"] for row in dofs.values() if row["kind"] == kind))
    found = np.zeros((len(modes.frequency_hz), len(names)))
    for place, row in dofs.items():
        if row["kind"] != kind:
            continue
        node, gain = number_in(place, "node", row["node"]), number_in(place, "gain", row["gain"])
        if node not in modes.displacements:
            raise PlantError(f"{place}: node: {row['node']} has no displacements in a result file")
        if row["direction"] not in DIRECTIONS:
            words = f"{row['direction']!r:.20} is none of {', '.join(DIRECTIONS)}"
            raise PlantError(f"{place}: direction: {words}")
        shape = modes.displacements[int(node)][:, DIRECTIONS.index(row["direction"])]
        found[:, names.index(row["name"])] += gain * shape
    return found
