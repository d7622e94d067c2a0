"""Matrices and result files of finite-element programs at samples of θ."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, mmread
from scipy.linalg import eigh, qr
from scipy.sparse import csc_array, issparse
from scipy.sparse import load_npz as load_sparse
from scipy.sparse.linalg import eigsh, splu

from ccd_casadi.extensions.imported.modal_table import ModalTable, Rows, number_in, read_rows
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

COLUMNS = ("kind", "name", "dof", "gain")
KNOWN = ("mass", "stiffness", "results", "damping", "hardware_cost")  # of index.csv: no θ


def reduced_table(folder: Path, modes: int, static_correction: bool = False) -> ModalTable:
    """Reduce the matrices of every sample in a folder to their lowest modes.

    With `static_correction` the responses (K + s M)⁻¹ [B, Cᵀ] join the modes as a Ritz basis, so
    that the compliance at low frequency is that of the full model.

    Parameters
    ----------
    folder : Path
        With index.csv, dofs.csv and the matrices, SI.
    modes : int
        Number of modes kept.
    static_correction : bool

    Returns
    -------
    ModalTable

    Raises
    ------
    PlantError
        A file is missing, foreign, not symmetric or of another size than the others.
    """
    index = read_index(folder, "mass", "stiffness", "damping")
    dofs = read_dofs(folder, COLUMNS)
    if modes < 1:
        raise PlantError(f"modes = {modes}; keep at least 1")
    found, bases = [], []
    for row in index.values():
        M, K = (_matrix(folder / row[key]) for key in ("mass", "stiffness"))
        if M.shape != K.shape:
            raise PlantError(f"{folder / row['mass']}: is {M.shape}, stiffness {K.shape}")
        B, C = (_selected(folder, dofs, kind, M.shape[0]) for kind in ("in", "out"))
        extra = np.hstack([B, C]) if static_correction else None
        omega, basis = modes_of(M, K, modes, extra)
        found.append((omega, basis.T @ B, basis.T @ C))
        bases.append(basis)
    shapes = _shape_values(folder, dofs, bases)
    modes_each = [(*one, own) for one, own in zip(found, shapes, strict=True)]
    return table_of_samples(folder, index, dofs, modes_each)


def table_of_samples(
    folder: Path, index: Rows, dofs: Rows, modes: Sequence[tuple[Array, ...]]
) -> ModalTable:
    """The table of ω (r,) in rad/s, inputs, outputs and shapes (r, .) of every sample, of as many
    modes as every one has; the rest is in the rows of `index.csv` and `dofs.csv`."""
    columns = [name for name in next(iter(index.values())) if name not in KNOWN]
    names = [name for name in columns if not name.startswith("constraint:")]
    constraints = [name for name in columns if name.startswith("constraint:")]
    r = min(len(omega) for omega, *_ in modes)
    omega, inputs, outputs, shapes = (
        np.array([part[:r] for part in parts]) for parts in zip(*modes, strict=True)
    )

    def numbers(*keys: str) -> Array:
        return np.array([[number_in(place, key, row.get(key, "0")) for key in keys]
                         for place, row in index.items()])  # fmt: skip

    return ModalTable(
        names=tuple(names),
        input_names=names_of_kind(folder, dofs, "in"),
        output_names=names_of_kind(folder, dofs, "out"),
        constraint_names=tuple(name.split(":", 1)[1] for name in constraints),
        theta=numbers(*names),
        omega=omega,
        zeta=np.tile(numbers("damping"), (1, r)),
        inputs=inputs,
        outputs=outputs,
        shapes=shapes,
        cost=numbers("hardware_cost")[:, 0],
        constraints=numbers(*constraints).reshape(len(index), len(constraints)),
    )


def modes_of(
    M: csc_array, K: csc_array, count: int, extra: Array | None = None, *, shift: float = 1e-9
) -> tuple[Array, Array]:
    """ω (r,) in rad/s and mass-normalised shapes (n, r) of the lowest modes of K φ = ω² M φ.

    `extra` (n, k) are forces whose static responses are added to the basis. A small model is solved
    densely; a large one by shift-inverted Lanczos iteration, at `shift` of the largest stiffness
    over mass below zero, where K is regular with rigid-body modes, too.
    """
    n = M.shape[0]
    if n <= 3 * count + 20:
        lam, basis = eigh(K.toarray(), M.toarray())
        lam, basis = lam[:count], basis[:, :count]
    else:
        shift *= float(K.diagonal().max() / M.diagonal().max())
        lam, basis = eigsh(K, count, M, sigma=-shift, which="LM", v0=np.ones(n))
        if extra is not None:
            static = splu(csc_array(K + shift * M)).solve(extra)
            static -= basis @ (basis.T @ (M @ static))  # what the modes do not hold already
            scale = np.sqrt(np.maximum((static * (M @ static)).sum(axis=0), 0.0))
            static = static[:, scale > 0.0] / scale[scale > 0.0]
            U, R, _ = qr(static, mode="economic", pivoting=True)
            keep = np.abs(np.diag(R)) > 1e-8 * abs(R[0, 0])
            basis = np.hstack([basis, U[:, keep]])
            lam, turn = eigh(basis.T @ (K @ basis), basis.T @ (M @ basis))
            basis = basis @ turn
    order = np.argsort(lam)
    lam, basis = lam[order], basis[:, order]
    basis = basis / np.sqrt((basis * (M @ basis)).sum(axis=0))
    return np.sqrt(np.maximum(lam, 0.0)), basis


def _shape_values(
    folder: Path, dofs: Rows, bases: list[Array], *, per_mode: int = 2
) -> list[Array]:
    """Shapes at the dofs named for it; else, on one mesh, at the `per_mode` times the number of
    modes rows that distinguish these best."""
    if any(row["kind"] == "shape" for row in dofs.values()):
        return [basis.T @ _selected(folder, dofs, "shape", len(basis)) for basis in bases]
    if len({len(basis) for basis in bases}) > 1:
        return [np.zeros((basis.shape[1], 0)) for basis in bases]
    _, _, pivots = qr(bases[0].T, mode="economic", pivoting=True)
    rows = np.sort(pivots[: per_mode * min(basis.shape[1] for basis in bases)])
    return [basis[rows].T for basis in bases]


def _selected(folder: Path, dofs: Rows, kind: str, size: int) -> Array:
    """(n, k) columns that pick the dofs of each name of this kind."""
    names = names_of_kind(folder, dofs, kind)
    found = np.zeros((size, len(names)))
    for place, row in dofs.items():
        if row["kind"] == kind:
            dof, gain = number_in(place, "dof", row["dof"]), number_in(place, "gain", row["gain"])
            if dof != int(dof) or not 0 <= dof < size:
                words = f"{dof:g} is not a row of a matrix of {size}; count from 0"
                raise PlantError(f"{place}: dof: {words}")
            found[int(dof), names.index(row["name"])] += gain
    return found


def names_of_kind(folder: Path, dofs: Rows, kind: str) -> tuple[str, ...]:
    """Names of this kind in dofs.csv. Raises PlantError where there is no input or no output."""
    names = tuple(dict.fromkeys(row["name"] for row in dofs.values() if row["kind"] == kind))
    if kind != "shape" and not names:
        raise PlantError(f"{folder / 'dofs.csv'}: names no {kind}; add a row of kind {kind}")
    return names


def _matrix(path: Path, *, symmetric: float = 1e-9) -> csc_array:
    """A real symmetric matrix from .mtx, .npz (sparse, or one array) or .mat (one matrix)."""
    try:
        if path.suffix == ".mtx":
            value = mmread(path)
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                value = load_sparse(path) if "format" in file else _only(path, file)
        elif path.suffix == ".mat":
            held = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
            value = _only(path, held)
        else:
            raise PlantError(f"{path}: is not a .mtx, .npz or .mat; save the matrix as one of them")
    except PlantError:
        raise
    except Exception as error:  # whatever a reader makes of a damaged or foreign file
        words = " ".join(str(error).split())[:200]
        raise PlantError(f"{path}: cannot be read: {words}; save the matrix again") from None
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
    return matrix


def _only(path: Path, held: Mapping[str, Any]) -> Any:
    if len(held) != 1:
        raise PlantError(f"{path}: holds {', '.join(held) or 'nothing'}; save one matrix")
    return next(iter(held.values()))


def read_dofs(folder: Path, columns: Sequence[str]) -> Rows:
    """The rows of dofs.csv (gain: 1 where missing). Raises PlantError where it has others."""
    path = folder / "dofs.csv"
    found = {place: {"gain": "1"} | row for place, row in read_rows(path).items()}
    for row in found.values():
        if set(row) != set(columns) or row["kind"] not in ("in", "out", "shape"):
            words = f"needs the columns {', '.join(columns)}, kind one of in, out, shape"
            raise PlantError(f"{path}: {words}; see docs/own_finite_elements.md")
    return found


def read_index(folder: Path, *columns: str) -> Rows:
    """Read the rows of index.csv.

    Parameters
    ----------
    folder : Path
    *columns : str
        Columns that it must have.

    Returns
    -------
    Rows

    Raises
    ------
    PlantError
        A column is missing.
    """
    path = folder / "index.csv"
    found = read_rows(path)
    for key in columns:
        if any(key not in row for row in found.values()):
            raise PlantError(f"{path}: has no column {key}; add it")
    return found


DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
RESULT_COLUMNS = ("kind", "name", "node", "direction", "gain")
_VALUE = re.compile(r"[-+]?\d*\.\d+(?:[EeDd]?[-+]\d+)?")
_VECTOR = re.compile(r"R E A L   E I G E N V E C T O R   N O \.\s+(\d+)")


@dataclass(frozen=True)
class ResultModes:
    """frequency_hz (r,), and the mass-normalised displacements (r, 6) of each node."""

    frequency_hz: Array
    displacements: Mapping[int, Array]


def results_table(folder: Path) -> ModalTable:
    """Read the modal table of a folder of result files.

    Parameters
    ----------
    folder : Path
        With index.csv, dofs.csv and the result files (.frd, .f06).

    Returns
    -------
    ModalTable

    Raises
    ------
    PlantError
        A file or node is missing, or a file holds no modes.
    """
    index, dofs = read_index(folder, "results", "damping"), read_dofs(folder, RESULT_COLUMNS)
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
