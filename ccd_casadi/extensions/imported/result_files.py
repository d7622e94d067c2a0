"""Modes in result files: one entry a format, mass-normalised displacements at nodes."""

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccd_casadi.extensions.imported.matrix_files import DIRECTIONS
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, UserError, describe, require
from ccd_casadi.support.text import HZ

_VALUE = re.compile(r"[-+]?\d*\.\d+(?:[EeDd]?[-+]\d+)?")
_VECTOR = re.compile(r"R E A L   E I G E N V E C T O R   N O \.\s+(\d+)")


class ReadModes(NamedTuple):
    """The modes of a file: Hz, modal masses, and displacements (6,) at nodes, mode by mode."""

    hz: list[float]
    masses: list[float]
    vectors: list[dict[int, Array]]


@dataclass(frozen=True)
class ResultModes:
    """frequency_hz (r,), and the mass-normalised displacements (r, 6) of each node."""

    frequency_hz: Array
    displacements: Mapping[int, Array]


@dataclass(frozen=True)
class ResultFormat:
    """The program that writes it, how it is made to, and what reads a path."""

    program: str
    remedy: str
    read: Callable[[Path], ReadModes]


def read_modes(path: Path) -> ResultModes:
    """Read the modes in a result file, in order of frequency.

    Raises PlantError where it cannot be read, or holds no modes whose mass is known.
    """
    form = RESULT_FORMATS.get(path.suffix.lower())
    if form is None:
        known = ", ".join(f"{end} ({own.program})" for end, own in RESULT_FORMATS.items())
        raise PlantError(f"{path}: is not a result file that is read: {known}; name one of these")
    try:
        path.open("rb").close()
    except OSError as error:
        raise PlantError(f"{path}: cannot be read: {error.strerror}; name a result file") from None
    try:
        frequencies, masses, vectors = form.read(path)
    except (PlantError, UserError):
        raise
    except Exception as error:  # a damaged file fails anywhere inside a reader
        words = " ".join(describe(error).split())[:200]
        cause = f"is damaged, or not as {form.program} writes it: {words}"
        raise PlantError(f"{path}: {cause}; run the analysis again") from None
    counts = {len(vector) for vector in vectors}
    if not vectors or len(frequencies) < len(vectors) or len(counts) != 1 or counts == {0}:
        raise PlantError(
            f"{path}: holds no eigenvectors of one set of nodes; ask the program to print them "
            f"({form.program}: {form.remedy})"
        )
    if not min(masses[: len(vectors)]) > 0.0:
        words = "gives no modal mass, so that the scale of its modes is not known"
        raise PlantError(f"{path}: {words}; write modal masses, 1 where mass-normalised")
    order = np.argsort(frequencies[: len(vectors)], kind="stable")
    scale = 1.0 / np.sqrt(np.array(masses)[order])
    nodes = vectors[0].keys()
    shapes = {n: np.array([vectors[i][n] for i in order]) * scale[:, None] for n in nodes}
    return ResultModes(np.array(frequencies)[order], shapes)


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="latin-1").splitlines()


def _op2(path: Path) -> ReadModes:
    """Tables LAMA and OUG of Nastran: eigenvalues with modal masses, displacements at grid points.

    Directions are those of each point's own output coordinate system.
    """
    op2 = require("pyyeti.nastran.op2", "nastran")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of tables that are not used here
        found = op2.rdparampost(str(path), get_mats=False, get_ougs=True, get_dr_tables=False,
                                which="all")  # fmt: skip
    sets = [one for key, held in found.items() if key.startswith(("oug", "boph")) for one in held]
    tables = found.get("lama", [])
    if len(sets) > 1 or len(tables) > 1:
        words = f"holds {len(sets)} sets of eigenvectors and {len(tables)} of eigenvalues"
        raise PlantError(f"{path}: {words}, as of superelements or subcases; write one")
    if not sets:
        return ReadModes([], [], [])
    if not tables:
        words = "has eigenvectors and no table LAMA of modal masses"
        raise PlantError(f"{path}: {words}; write it too (PARAM,POST,-1)")
    (lama,), (shapes,) = tables, sets
    order, hz, masses = lama[:, 0].astype(int), lama[:, 4], lama[:, 5]
    _require_positive(path, lama[:, 2])
    numbers = shapes.columns.get_level_values(0).to_numpy(int)
    places = np.searchsorted(order, numbers)
    nodes, directions = (shapes.index.get_level_values(i).to_numpy(int) for i in (0, 1))
    values = shapes.to_numpy(float)
    vectors = _by_node(values.T, nodes, directions - 1)
    return ReadModes(hz[places].tolist(), masses[places].tolist(), vectors)


def _require_positive(path: Path, eigenvalues: Array, *, rigid_hz: float = 0.1) -> None:
    """Refuse ω² < 0 beyond what rounding leaves of a rigid body."""
    if len(eigenvalues) and eigenvalues.min() < -((HZ * rigid_hz) ** 2):
        words = f"a mode has the eigenvalue {eigenvalues.min():.3g} 1/s², below 0"
        raise PlantError(f"{path}: {words}; constrain or correct the model")


def _by_node(values: Array, nodes: Array, directions: Array) -> list[dict[int, Array]]:
    """Sort modes (r, k) by node: displacements (6,) of each; other degrees of freedom are left
    out."""
    found: list[dict[int, Array]] = []
    kept = (directions >= 0) & (directions < len(DIRECTIONS))
    names, place = np.unique(nodes[kept], return_inverse=True)
    for row in values[:, kept]:
        table = np.zeros((len(names), len(DIRECTIONS)))
        table[place, directions[kept]] = row
        found.append(dict(zip(names.tolist(), table, strict=True)))
    return found


def _unv(path: Path, *, normal_mode: int = 2, displacement: int = 8, real: int = 2) -> ReadModes:
    """Datasets 55 of a universal file: real normal modes, displacements, by pyuff."""
    pyuff = require("pyuff", "uff")
    file = pyuff.UFF(str(path))
    kinds = [int(kind) for kind in file.get_set_types()]
    sets = [file.read_sets(i) for i, kind in enumerate(kinds) if kind == 55]
    frequencies, masses, vectors = [], [], []
    for one in sets:
        stated = one["analysis_type"], one["spec_data_type"], one["data_type"]
        if stated != (normal_mode, displacement, real):
            words = "its dataset 55 is not of real normal modes in displacements"
            raise PlantError(f"{path}: {words}; write these")
        nodes = np.asarray(one["node_nums"], int)
        rows = [np.asarray(one.get(f"r{i}", np.zeros(len(nodes))), float) for i in range(1, 7)]
        vectors.append(dict(zip(nodes.tolist(), np.stack(rows, axis=1), strict=True)))
        frequencies.append(float(one["freq"]))
        masses.append(float(one["modal_m"]))
    return ReadModes(frequencies, masses, vectors)


def _rst(path: Path, *, modal: int = 2) -> ReadModes:
    """Nodal displacements of a modal analysis of ANSYS, in global directions."""
    reader = require("ansys.mapdl.reader", "ansys")
    file = reader.read_binary(str(path))
    if file._resultheader["kan"] != modal:
        raise PlantError(f"{path}: is not of a modal analysis; run ANTYPE,MODAL")
    named = {"UX": 0, "UY": 1, "UZ": 2, "ROTX": 3, "ROTY": 4, "ROTZ": 5}
    vectors, largest = [], []
    for i in range(file.nsets):
        nodes, values = file.nodal_solution(i)
        at = [named.get(name, -1) for name in file.result_dof(i)]
        directions = np.tile(at, len(nodes))
        vectors += _by_node(values[:, : len(at)].reshape(1, -1), np.repeat(nodes, len(at)),
                            directions)  # fmt: skip
        largest.append(float(np.abs(values).max()))
    if np.all(np.isin(largest, 1.0)):
        words = "its modes are normalised to unity, so that their modal masses are not known"
        raise PlantError(f"{path}: {words}; leave Nrmkey of MODOPT off")
    frequencies = [float(hz) for hz in file.time_values]
    return ReadModes(frequencies, [1.0] * len(vectors), vectors)


def _frd(path: Path) -> ReadModes:
    """Displacement blocks that carry a mode: `100C` line, `-4 DISP`, ` -1` rows of fixed width."""
    frequencies: list[float] = []
    vectors: list[dict[int, Array]] = []
    frequency, reading, mode = 0.0, False, False
    for line in _lines(path):
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
    return ReadModes(frequencies, [1.0] * len(frequencies), vectors)


def _f06(path: Path) -> ReadModes:
    """The table of real eigenvalues, and the blocks of real eigenvectors over all pages."""
    frequencies: list[float] = []
    masses: list[float] = []
    vectors: dict[int, dict[int, Array]] = {}
    table, block = False, None
    for line in _lines(path):
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
    return ReadModes(frequencies, masses, [vectors[i] for i in sorted(vectors)])


def _float(text: str) -> float:
    """Fortran's numbers: 1.0E+00, 1.0D+00 and 1.0-3."""
    text = re.sub("[Dd]", "E", text)
    return float(re.sub(r"(?<=[\d.])([-+])", r"E\1", text) if "E" not in text.upper() else text)


RESULT_FORMATS: Mapping[str, ResultFormat] = {
    ".frd": ResultFormat("CalculiX", "*NODE FILE U", _frd),
    ".f06": ResultFormat("Nastran", "VECTOR(PRINT) = ALL", _f06),
    ".op2": ResultFormat("Nastran", "VECTOR = ALL and PARAM,POST,-1", _op2),
    ".rst": ResultFormat("ANSYS", "MODOPT and MXPAND", _rst),
    ".unv": ResultFormat("universal file", "dataset 55 of normal modes", _unv),
    ".uff": ResultFormat("universal file", "dataset 55 of normal modes", _unv),
}
