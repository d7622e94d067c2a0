"""The user's own finite-element models: their matrices or results at samples of θ, as a plant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import eigh, qr
from scipy.sparse import csc_array
from scipy.sparse.linalg import eigsh, splu

from ccd_casadi.extensions.imported.interpolation import (
    Errors,
    InterpolatedModes,
    fit_entries,
    row_of,
)
from ccd_casadi.extensions.imported.matrix_files import DIRECTIONS, NodeRows, read_matrix
from ccd_casadi.extensions.imported.modal_table import (
    ModalTable,
    Rows,
    number_in,
    read_modal_table,
    read_rows,
)
from ccd_casadi.extensions.imported.result_files import ResultModes, read_modes
from ccd_casadi.plants.plant import Plant, named_values
from ccd_casadi.plants.registry import Model
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

COLUMNS = ("kind", "name", "dof", "gain")
RESULT_COLUMNS = ("kind", "name", "node", "direction", "gain")
KNOWN = ("mass", "stiffness", "results", "damping", "hardware_cost")  # of index.csv: no θ


def reduced_table(folder: Path, modes: int, static_correction: bool = False) -> ModalTable:
    """Reduce the matrices of every sample in a folder to their lowest modes.

    With `static_correction` the responses (K + s M)⁻¹ [B, Cᵀ] join the modes as a Ritz basis, so
    that the compliance at low frequency is that of the full model. The folder has index.csv,
    dofs.csv and the matrices, in SI. Raises PlantError where a file is missing, foreign, not
    symmetric or of another size than the others.
    """
    index = read_index(folder, "mass", "stiffness", "damping")
    dofs = read_dofs(folder, COLUMNS, RESULT_COLUMNS)
    if modes < 1:
        raise PlantError(f"modes = {modes}; keep at least 1")
    found, bases = [], []
    for row in index.values():
        (M, rows), (K, other) = (read_matrix(folder, row[key], key)
                                 for key in ("mass", "stiffness"))  # fmt: skip
        if M.shape != K.shape:
            raise PlantError(f"{folder / row['mass']}: is {M.shape}, stiffness {K.shape}")
        if rows is not None and other is not None and rows != other:
            words = "its degrees of freedom are not those of the stiffness"
            raise PlantError(f"{folder / row['mass']}: {words}; write both of one step")
        at = rows if rows is not None else other
        B, C = (_select(folder, dofs, kind, M.shape[0], at) for kind in ("in", "out"))
        extra = np.hstack([B, C]) if static_correction else None
        omega, basis = modes_of(M, K, modes, extra)
        found.append((omega, basis.T @ B, basis.T @ C))
        bases.append((basis, at))
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
        lam, basis = _dense_modes(M.toarray(), K.toarray(), shift)
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


def _dense_modes(
    M: Array, K: Array, shift: float, *, massless: float = 1e-12
) -> tuple[Array, Array]:
    """All modes with mass; motions without follow statically. Raises PlantError where one has
    neither mass nor stiffness."""
    try:
        lam, basis = eigh(K, M)
        return lam, basis
    except np.linalg.LinAlgError:  # motions without mass, as of a superelement
        pass
    shift *= float(K.diagonal().max() / M.diagonal().max())
    try:
        mu, basis = eigh(M, K + shift * M)
    except np.linalg.LinAlgError:
        empty = int(np.argmin(K.diagonal() + shift * M.diagonal()))
        words = f"the matrices leave a motion without mass and stiffness, as of row {empty}"
        raise PlantError(f"{words}; leave it out") from None
    order = np.argsort(-mu)[: int((mu > massless * mu.max()).sum())]
    return 1.0 / mu[order] - shift, basis[:, order]


def _shape_values(
    folder: Path, dofs: Rows, reduced: list[tuple[Array, NodeRows | None]], *, per_mode: int = 2
) -> list[Array]:
    """Shapes at the dofs named for it; else, on one mesh, at the `per_mode` times the number of
    modes rows that distinguish these best."""
    if any(row["kind"] == "shape" for row in dofs.values()):
        return [own.T @ _select(folder, dofs, "shape", len(own), at) for own, at in reduced]
    bases = [basis for basis, _ in reduced]
    if len({len(basis) for basis in bases}) > 1:
        return [np.zeros((basis.shape[1], 0)) for basis in bases]
    _, _, pivots = qr(bases[0].T, mode="economic", pivoting=True)
    rows = np.sort(pivots[: per_mode * min(basis.shape[1] for basis in bases)])
    return [basis[rows].T for basis in bases]


def _select(folder: Path, dofs: Rows, kind: str, size: int, at: NodeRows | None) -> Array:
    """(n, k) columns that pick the dofs of each name of this kind."""
    names = names_of_kind(folder, dofs, kind)
    found = np.zeros((size, len(names)))
    for place, row in dofs.items():
        if row["kind"] == kind:
            gain = number_in(place, "gain", row["gain"])
            if "node" in row:
                found[_row_of(place, row, at), names.index(row["name"])] += gain
                continue
            dof = number_in(place, "dof", row["dof"])
            if dof != int(dof) or not 0 <= dof < size:
                words = f"{dof:g} is not a row of a matrix of {size}; count from 0"
                raise PlantError(f"{place}: dof: {words}")
            found[int(dof), names.index(row["name"])] += gain
    return found


def _row_of(place: str, row: Mapping[str, str], at: NodeRows | None) -> int:
    """The row of a matrix by node and direction. Raises PlantError where it has none."""
    if at is None:
        words = "these matrices do not name nodes; give the column dof instead"
        raise PlantError(f"{place}: node: {words}")
    node = int(number_in(place, "node", row["node"]))
    if (node, row["direction"]) not in at:
        words = f"{row['direction']} of node {node} is not in the matrices"
        there = [direction for own, direction in at if own == node]
        raise PlantError(f"{place}: {words}; it has {', '.join(there) or 'no such node'}")
    return at[node, row["direction"]]


def names_of_kind(folder: Path, dofs: Rows, kind: str) -> tuple[str, ...]:
    """Names of this kind in dofs.csv. Raises PlantError where there is no input or no output."""
    names = tuple(dict.fromkeys(row["name"] for row in dofs.values() if row["kind"] == kind))
    if kind != "shape" and not names:
        raise PlantError(f"{folder / 'dofs.csv'}: names no {kind}; add a row of kind {kind}")
    return names


def read_dofs(folder: Path, *either: Sequence[str]) -> Rows:
    """The rows of dofs.csv (gain: 1 where missing), of `either` columns. Raises PlantError where it
    has others."""
    path, columns = folder / "dofs.csv", either[0]
    found = {place: {"gain": "1"} | row for place, row in read_rows(path).items()}
    for row in found.values():
        if set(row) not in map(set, either) or row["kind"] not in ("in", "out", "shape"):
            words = f"needs the columns {', '.join(columns)}, kind one of in, out, shape"
            raise PlantError(f"{path}: {words}; see docs/own_finite_elements.md")
    return found


def read_index(folder: Path, *columns: str) -> Rows:
    """Read the rows of index.csv; PlantError where one of the columns is missing."""
    path = folder / "index.csv"
    found = read_rows(path)
    for key in columns:
        if any(key not in row for row in found.values()):
            raise PlantError(f"{path}: has no column {key}; add it")
    return found


def results_table(folder: Path) -> ModalTable:
    """Read the modal table of a folder with index.csv, dofs.csv and result files.

    Raises PlantError where a file or node is missing, or a file holds no modes.
    """
    index, dofs = read_index(folder, "results", "damping"), read_dofs(folder, RESULT_COLUMNS)
    found = [read_modes(folder / row["results"]) for row in index.values()]
    kinds = ("in", "out", "shape")
    modes = [
        (2.0 * np.pi * one.frequency_hz, *(_pick(dofs, kind, one) for kind in kinds))
        for one in found
    ]
    return table_of_samples(folder, index, dofs, modes)


def _pick(dofs: Rows, kind: str, modes: ResultModes) -> Array:
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


NEAREST = "the nearest sample as it stands"


@dataclass(frozen=True)
class AcceptanceOptions:
    """Largest relative errors of a sample that is predicted without it.

    A mode 5 % off moves a response at 10 % of damping by half.
    """

    frequency_error: float = 0.05  # of a frequency
    response_error: float = 0.5  # of the response


def modal_table(
    names: Sequence[str], table: str = "", rigid_below_hz: float = 0.1,
    frequency_error: float = AcceptanceOptions.frequency_error,
    response_error: float = AcceptanceOptions.response_error,
) -> Plant:  # fmt: skip
    """Interpolate the plant between the modal models of a CSV file (see `modal_table`).

    Parameters
    ----------
    names : sequence of str (n,)
        θ, those of the table in any order.
    table : str
        The CSV file.
    rigid_below_hz : float
        Modes below this frequency in Hz are rigid-body modes.
    frequency_error, response_error : float
        Largest relative errors of a sample that is predicted without it: beyond, the plant is known
        at the samples alone.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        The table cannot be read, or its parameters are not those of the case.
    """
    if not table:
        raise PlantError('modal_table needs table = "modes.csv", relative to the case file')
    accepted, file = (frequency_error, response_error), Path(table)
    return plant_of_table(read_modal_table(file), names, rigid_below_hz, file.name, accepted)


def sampled_matrices(
    names: Sequence[str], folder: str = "", modes: int = 10, static_correction: bool = False,
    rigid_below_hz: float = 0.1, frequency_error: float = AcceptanceOptions.frequency_error,
    response_error: float = AcceptanceOptions.response_error,
) -> Plant:  # fmt: skip
    """Interpolate the plant between M and K given as files (`reduced_table`), reduced to modes.

    Parameters
    ----------
    names : sequence of str (n,)
        θ, those of the samples in any order.
    folder : str
        Folder of the matrices.
    modes : int
        Modes kept of each sample.
    static_correction : bool
        Whether static responses join the modes; see `reduced_table`.
    rigid_below_hz, frequency_error, response_error : float
        As in `modal_table`.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        A file cannot be read, or the parameters are not those of the case.
    """
    if not folder:
        raise PlantError('sampled_matrices needs folder = "fe", relative to the case file')
    table = reduced_table(Path(folder), modes, static_correction)
    accepted = (frequency_error, response_error)
    return plant_of_table(table, names, rigid_below_hz, Path(folder).name, accepted)


def plant_of_table(
    table: ModalTable, names: Sequence[str], rigid_below_hz: float, source: str,
    accepted: Errors = (AcceptanceOptions.frequency_error, AcceptanceOptions.response_error),
) -> Plant:  # fmt: skip
    """Any modal table as the plant that the design loop asks for.

    Raises PlantError where the table's parameters are not those of the case.
    """
    if names and not table.names:
        raise PlantError(f"{source}: has no column of theta; add one for each parameter")
    if sorted(names) != sorted(table.names):
        raise PlantError(
            f"{source} has the parameters {', '.join(table.names)}, the case "
            f"{', '.join(names)}; make them agree"
        )
    order = [table.names.index(name) for name in names]
    table = replace(table, names=tuple(names), theta=table.theta[:, order])
    theta, rigid_below = ca.MX.sym("theta", len(names)), 2.0 * np.pi * rigid_below_hz
    numbers, between = np.column_stack([table.cost, table.constraints]), dict[str, Any]()
    if names:
        try:
            modes = InterpolatedModes(table, rigid_below, accepted)
        except PlantError as error:
            raise PlantError(f"{source}: {error}") from error
        scalars = fit_entries(table.theta, numbers)[0](theta)
        between = {
            "evaluate": modes,
            "unknown_between": modes.refusal and f"{source}: {modes.refusal}",
            "references": {NEAREST: lambda at: row_of(table, modes.rigid, modes.nearest(at)[0])},
            "notes": lambda at: _notes(modes, source, at),
            "domain": (table.theta.min(axis=0), table.theta.max(axis=0)),
        }
    else:  # one model, whose forces and sensors [places] may move
        found = row_of(table, int((table.omega[0] < rigid_below).sum()), 0)
        scalars, between = ca.MX(ca.DM(numbers[0])), {"evaluate": lambda theta: found}
    lam = scalars[1:] if scalars.numel() > 1 else ca.MX(0, 1)
    return Plant(
        names=tuple(names),
        constraint_names=table.constraint_names,
        hardware=ca.Function("hardware", [theta], [scalars[0], lam]),
        outputs=table.outputs.shape[2],
        inputs=table.inputs.shape[2],
        **between,
    )


def _notes(modes: InterpolatedModes, source: str, theta: Sequence[float]) -> tuple[str, ...]:
    index, distance = modes.nearest(theta)
    place = named_values(modes.table.names, modes.table.theta[index])
    frequency, response = 100 * modes.left_out.frequency, 100 * modes.left_out.response
    count = len(modes.table.theta)
    here = f"is {100 * distance:.2g} % of the sampled range away from the nearest sample"
    if distance < modes.options.same:
        here = "is one of the samples"
    return (
        f"designs are verified on the model interpolated between the {count} samples of {source}, "
        f"as no other is known between them ({modes.frame.name}); a sample left out is predicted "
        f"to {frequency:.2g} % in frequency and {response:.2g} % in response at worst",
        f"this theta {here}, {place}; analyse its own finite-element model before it is built",
    )


MODAL_TABLE = Model(modal_table, data="table", annotated=True)
SAMPLED_MATRICES = Model(sampled_matrices, data="folder", annotated=True)
