"""Matrices of finite-element programs: one entry a format, and which row is which node's."""

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, mmread
from scipy.sparse import coo_array, csc_array, issparse, triu
from scipy.sparse import load_npz as load_sparse

from ccd_casadi.support.errors import PlantError, UserError, describe, require

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
NodeRows = Mapping[tuple[int, str], int]  # (node, direction) -> row, where a file names nodes
Held = tuple[Any, NodeRows | None]
# Nastran's names of the two matrices of a model, as they are written most
NAMES = {"mass": ("maa", "mgg", "mxx", "mff", "mhh"),
         "stiffness": ("kaa", "kgg", "kxx", "kff", "khh")}  # fmt: skip


@dataclass(frozen=True)
class MatrixFormat:
    """The program that writes it, and what reads a matrix for a role, or by its name in a file."""

    program: str
    read: Callable[[Path, str, str], Held]


def read_matrix(
    folder: Path, cell: str, role: str, *, symmetric: float = 1e-9
) -> tuple[csc_array, NodeRows | None]:
    """Read a real symmetric matrix (n, n), and which (node, direction) is which row where that is
    known.

    `cell` names the file, and after a colon which of its matrices; `role` is "mass" or "stiffness",
    `symmetric` the asymmetry that rounding may have left, over the largest entry. Raises PlantError
    where the file cannot be read, or the matrix is not real, square and symmetric.
    """
    file, _, name = cell.partition(":")
    path = folder / file
    form = MATRIX_FORMATS.get(path.suffix.lower())
    if form is None:
        known = ", ".join(f"{end} ({own.program})" for end, own in MATRIX_FORMATS.items())
        raise PlantError(f"{path}: is not a matrix file that is read: {known}; save it as one")
    try:
        value, rows = form.read(path, role, name)
    except (PlantError, UserError):
        raise
    except Exception as error:  # whatever a reader makes of a damaged or foreign file
        words = " ".join(describe(error).split())[:200]
        raise PlantError(f"{path}: cannot be read: {words}; save the matrix again") from None
    if np.iscomplexobj(value):
        raise PlantError(f"{path}: is not a real matrix; save it without structural damping")
    try:
        matrix = csc_array(value if issparse(value) else np.asarray(value), dtype=float)
    except (ValueError, TypeError) as error:
        raise PlantError(f"{path}: is not a real matrix: {error}") from None
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise PlantError(f"{path}: is {matrix.shape}, not square; save the whole matrix")
    if not np.isfinite(matrix.data).all() or not matrix.nnz:
        raise PlantError(f"{path}: is empty or not finite; save the matrix again")
    gap = abs(matrix - matrix.T)
    if gap.max() > symmetric * abs(matrix).max():
        raise PlantError(f"{path}: is not symmetric; save both triangles")
    return matrix, rows


def _only(path: Path, held: Mapping[str, Any], role: str, name: str) -> Any:
    """The matrix of this name, else the only one, else the only one with a usual name."""
    plain = {key.casefold(): value for key, value in held.items()}
    if name:
        if name.casefold() not in plain:
            raise PlantError(f"{path}: has no matrix {name}; it holds {', '.join(held)}")
        return plain[name.casefold()]
    usual = [key for key in NAMES[role] if key in plain]
    if len(held) != 1 and len(usual) != 1:
        words = ", ".join(list(held)[:8]) or "nothing"
        raise PlantError(f"{path}: holds {words}; save one matrix, or write FILE:NAME of one")
    return plain[usual[0]] if usual else next(iter(held.values()))


def _mtx(path: Path, role: str, name: str) -> Held:
    """Matrix Market, or what Abaqus writes under the same ending."""
    with path.open(encoding="latin-1") as stream:
        first = stream.readline()
    return (mmread(path), None) if first.startswith("%%MatrixMarket") else _abaqus(path)


def _abaqus(path: Path) -> Held:
    """*MATRIX OUTPUT, FORMAT=MATRIX INPUT (node, dof, node, dof, value) or COORDINATE (row, column,
    value), of which one triangle may stand for both."""
    lines = path.read_text(encoding="latin-1").splitlines()
    kept = [re.split(r"[,\s]+", line.strip(" ,\t")) for line in lines
            if line.strip() and not line.lstrip().startswith("*")]  # fmt: skip
    counts = {len(row) for row in kept}
    if counts not in ({3}, {5}):
        words = "is neither Matrix Market nor Abaqus's FORMAT=MATRIX INPUT or COORDINATE"
        raise PlantError(f"{path}: {words}; write one of these")
    table = np.array(kept, float)
    if counts == {3}:
        rows, columns = table[:, 0].astype(int) - 1, table[:, 1].astype(int) - 1
        return _whole(rows, columns, table[:, 2], int(max(rows.max(), columns.max())) + 1), None
    ends = table[:, :4].astype(int).reshape(-1, 2, 2)
    named = {own: i for i, own in enumerate(sorted(set(map(tuple, ends.reshape(-1, 2).tolist()))))}
    rows, columns = (np.array([named[tuple(own)] for own in ends[:, i].tolist()]) for i in (0, 1))
    labels = {(node, _direction(dof - 1)): i for (node, dof), i in named.items()}
    return _whole(rows, columns, table[:, 4], len(named)), labels


def _direction(number: int) -> str:
    return DIRECTIONS[number] if 0 <= number < len(DIRECTIONS) else f"dof {number + 1}"


def _whole(rows: Any, columns: Any, values: Any, size: int) -> csc_array:
    """Both halves of a matrix of which one or both are given, in whatever order."""
    one = csc_array(coo_array((values, (rows, columns)), shape=(size, size)))
    off = coo_array((np.ones(len(rows)), (rows, columns)), shape=(size, size)).tocsc()
    off.setdiag(0.0)
    if (off * off.T).nnz:  # some entry is there with its mirror image
        return one
    whole = one + one.T
    whole.setdiag(one.diagonal())
    return csc_array(whole)


def _npz(path: Path, role: str, name: str) -> Held:
    with np.load(path, allow_pickle=False) as file:
        if "format" in file:
            return load_sparse(path), None
        return _only(path, {key: file[key] for key in file.files}, role, name), None


def _mat(path: Path, role: str, name: str) -> Held:
    held = {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
    return _only(path, held, role, name), None


def _op4(path: Path, role: str, name: str) -> Held:
    """Nastran's OUTPUT4 of any form, by pyYeti."""
    op4 = require("pyyeti.nastran.op4", "nastran")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that it changes
        names, matrices, *_ = op4.OP4().load(str(path), into="list", sparse=True)
    chosen = name.casefold() or next((key for key in NAMES[role] if key in names), "")
    if names.count(chosen) > 1:
        words = f"holds {names.count(chosen)} matrices {chosen}, as of superelements"
        raise PlantError(f"{path}: {words}; write one")
    return _only(path, dict(zip(names, matrices, strict=True)), role, name), None


def _full(path: Path, role: str, name: str) -> Held:
    """ANSYS's assembled matrices without what is constrained."""
    reader = require("ansys.mapdl.reader", "ansys")
    file = reader.read_binary(str(path))
    places, K, M = file.load_km(sort=True)
    part = M if role == "mass" else K
    if part is None:
        raise PlantError(f"{path}: holds no {role}; write it by a modal analysis")
    fixed = {tuple(own) for own in np.asarray(file.const).tolist()}
    free = [i for i, own in enumerate(places.tolist()) if tuple(own) not in fixed]
    upper = csc_array(part)
    whole = csc_array(upper + triu(upper, 1).T)[free][:, free]
    labels = {(int(node), _direction(int(dof))): row for row, (node, dof) in
              enumerate(places[free].tolist())}  # fmt: skip
    return whole, labels


def _harwell_boeing(path: Path, role: str, name: str) -> Held:
    """A real assembled matrix of fixed columns, as HBMAT of ANSYS writes it."""
    lines = path.read_text(encoding="latin-1").splitlines()
    counts = [int(lines[1][i : i + 14]) for i in range(14, 56, 14)]
    kind, (n, m, entries) = lines[2][:3].upper(), map(int, lines[2][14:56].split())
    if kind not in ("RSA", "RUA"):
        raise PlantError(f"{path}: is {kind}, not a real assembled matrix; write RSA or RUA")
    fields = [lines[3][i : i + w] for i, w in ((0, 16), (16, 16), (32, 20))]
    after = 5 if len(lines[1]) > 56 and lines[1][56:70].strip() not in ("", "0") else 4
    parts = []
    for count, field in zip(counts, fields, strict=True):
        width = int(re.search(r"[IFEDG](\d+)", field.upper())[1])  # type: ignore[index]
        parts.append([*_cells(lines[after : after + count], width)])
        after += count
    starts, rows = (np.array(part, int) - 1 for part in parts[:2])
    values = np.array([part.upper().replace("D", "E") for part in parts[2]], float)
    if (len(starts), len(rows), len(values)) != (m + 1, entries, entries) or starts[-1] != entries:
        raise PlantError(
            f"{path}: its numbers are not those that its header counts; write it again"
        )
    columns = np.repeat(np.arange(m), np.diff(starts))
    if kind == "RSA":
        return _whole(rows, columns, values, n), None
    return coo_array((values, (rows, columns)), shape=(n, m)), None


def _cells(lines: list[str], width: int) -> Iterator[str]:
    for line in lines:
        text = line.rstrip()
        yield from (text[i : i + width].strip() for i in range(0, len(text), width))


MATRIX_FORMATS: Mapping[str, MatrixFormat] = {
    ".mtx": MatrixFormat("Matrix Market, Abaqus", _mtx),
    ".npz": MatrixFormat("NumPy, SciPy", _npz),
    ".mat": MatrixFormat("MATLAB", _mat),
    ".op4": MatrixFormat("Nastran", _op4),
    ".full": MatrixFormat("ANSYS", _full),
    ".matrix": MatrixFormat("ANSYS HBMAT", _harwell_boeing),
    ".rsa": MatrixFormat("Harwell-Boeing", _harwell_boeing),
    ".rua": MatrixFormat("Harwell-Boeing", _harwell_boeing),
}
