"""A table of modal models at samples of θ, as CSV, and modes of neighbouring samples matched.

One row a mode of a sample. Columns: the parameters of θ (any other name than these), `mode`,
`frequency_hz`, `damping` (ratio), `in:NAME` and `out:NAME` (the mode's displacement along each
actuator's force and each sensor), optionally `shape:NAME` (displacements elsewhere, for matching
only), `modal_mass` (1 where mode shapes are mass-normalised), `hardware_cost`, `constraint:NAME`.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.distance import cdist

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

KNOWN = ("mode", "frequency_hz", "damping", "modal_mass", "hardware_cost")
Rows = dict[str, dict[str, str]]  # cells by column, by the row's place: `FILE: line N`
PREFIXES = ("in:", "out:", "shape:", "constraint:")


@dataclass(frozen=True)
class ModalTable:
    """N samples of r mass-normalised modes, in order of frequency.

    Attributes
    ----------
    names, input_names, output_names, constraint_names : tuple of str
        Of θ, inputs, outputs and λ.
    theta : array (N, n)
        Samples, SI.
    omega, zeta : arrays (N, r)
        Natural frequencies in rad/s, damping ratios.
    inputs, outputs, shapes : arrays (N, r, m), (N, r, p), (N, r, q)
        Displacements in 1/√kg.
    cost : array (N,)
        f at the samples.
    constraints : array (N, k)
        λ at the samples.
    """

    names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    constraint_names: tuple[str, ...]
    theta: Array
    omega: Array
    zeta: Array
    inputs: Array
    outputs: Array
    shapes: Array
    cost: Array
    constraints: Array


def read_modal_table(path: Path) -> ModalTable:
    """The table in a CSV file. Raises PlantError naming the line, column and remedy."""
    rows = [_mode(place, cells) for place, cells in read_rows(path).items()]
    header = list(rows[0])
    groups = {prefix: [name for name in header if name.startswith(prefix)] for prefix in PREFIXES}
    theta_names = [name for name in header if name not in KNOWN and not name.startswith(PREFIXES)]
    for name in ("mode", "frequency_hz", "damping"):
        if name not in header:
            raise PlantError(f"{path}: has no column {name}; add it")
    for prefix, what in (("in:", "actuator"), ("out:", "sensor")):
        if not groups[prefix]:
            raise PlantError(f"{path}: has no column {prefix}NAME; add one for each {what}")
    samples: dict[tuple[float, ...], list[dict[str, float]]] = {}
    for row in rows:
        samples.setdefault(tuple(row[name] for name in theta_names), []).append(row)
    counts = {theta: len(modes) for theta, modes in samples.items()}
    if len(set(counts.values())) > 1:
        few = min(counts, key=lambda theta: counts[theta])
        words = ", ".join(f"{n} = {v:g}" for n, v in zip(theta_names, few, strict=True))
        raise PlantError(
            f"{path}: the sample {words} has {counts[few]} modes, another has "
            f"{max(counts.values())}; give every sample as many"
        )
    ordered = [sorted(modes, key=lambda row: row["frequency_hz"]) for modes in samples.values()]

    at = {name: np.array([[row[name] for row in modes] for modes in ordered]) for name in header}
    shape = len(ordered), len(ordered[0])
    masses = at.get("modal_mass", np.ones(shape))

    def block(names: Sequence[str]) -> Array:
        values = np.array([at[name] for name in names]).reshape(-1, *shape)
        return np.asarray(np.moveaxis(values / np.sqrt(masses), 0, -1))

    def of_sample(name: str) -> Array:
        table = at.get(name, np.zeros(shape))
        if (np.abs(table - table[:, :1]) > 1e-9 * np.abs(table[:, :1])).any():
            raise PlantError(f"{path}: {name} differs between the modes of a sample; give one")
        return np.asarray(table[:, 0])

    columns = [of_sample(name) for name in groups["constraint:"]]
    return ModalTable(
        names=tuple(theta_names),
        input_names=_strip(groups["in:"]),
        output_names=_strip(groups["out:"]),
        constraint_names=_strip(groups["constraint:"]),
        theta=np.array(list(samples)),
        omega=2.0 * np.pi * at["frequency_hz"],
        zeta=at["damping"],
        inputs=block(groups["in:"]),
        outputs=block(groups["out:"]),
        shapes=block(groups["shape:"]),
        cost=of_sample("hardware_cost"),
        constraints=np.array(columns).T.reshape(len(samples), len(columns)),
    )


def write_modal_table(path: Path, table: ModalTable) -> None:
    """Write a table that `read_modal_table` returns again, numbers to the last digit.

    Parameters
    ----------
    path : Path
        CSV file.
    table : ModalTable
    """
    groups = {
        "in:": (table.input_names, table.inputs),
        "out:": (table.output_names, table.outputs),
        "shape:": (tuple(str(i + 1) for i in range(table.shapes.shape[2])), table.shapes),
    }
    names = [prefix + name for prefix, (own, _) in groups.items() for name in own]
    extra = ["hardware_cost", *("constraint:" + name for name in table.constraint_names)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*table.names, "mode", "frequency_hz", "damping", *names, *extra])
        for s, theta in enumerate(table.theta):
            for i in range(table.omega.shape[1]):
                shapes = np.concatenate([values[s, i] for _, values in groups.values()])
                own = [table.omega[s, i] / (2.0 * np.pi), table.zeta[s, i], *shapes, table.cost[s]]
                writer.writerow([*theta.tolist(), i + 1, *map(float, own),
                                 *table.constraints[s].tolist()])  # fmt: skip


def _mode(place: str, cells: dict[str, str]) -> dict[str, float]:
    """A row as numbers. Raises PlantError where one is none, or out of its range."""
    row = {name: number_in(place, name, cell) for name, cell in cells.items()}
    if row.get("frequency_hz", 0.0) < 0.0:
        raise PlantError(f"{place}: frequency_hz: is negative; give 0 for a rigid-body mode")
    if not 0.0 <= row.get("damping", 0.0) < 1.0:
        raise PlantError(f"{place}: damping: is {row['damping']:g}; give a ratio from 0 to 1")
    if not row.get("modal_mass", 1.0) > 0.0:
        raise PlantError(f"{place}: modal_mass: is not positive; give kg")
    return row


def _strip(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name.split(":", 1)[1] for name in names)


def read_rows(path: Path) -> Rows:
    """The rows under a header; lines that start with # are remarks.

    Raises PlantError where it cannot be read, holds no rows, or a row has not the header's columns.
    """
    try:
        lines = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
        kept = [(i, line) for i, line in lines if line.strip() and not line.startswith("#")]
        parsed = list(csv.reader((line for _, line in kept), skipinitialspace=True))
    except (OSError, UnicodeDecodeError) as error:
        raise PlantError(f"{path}: cannot be read: {error}; name a CSV file in UTF-8") from None
    except csv.Error as error:
        raise PlantError(f"{path}: is not a CSV: {error}; separate cells by commas") from None
    if len(parsed) < 2:
        raise PlantError(f"{path}: holds no rows; give a header and rows below it")
    header, *rows = ([cell.strip() for cell in cells] for cells in parsed)
    if len(set(header)) < len(header) or not all(header):
        raise PlantError(f"{path}: line {kept[0][0]}: a column's name is empty or twice there")
    found = {}
    for (number, _), cells in zip(kept[1:], rows, strict=False):
        place = f"{path}: line {number}"
        if len(cells) != len(header):
            words = f"has {len(cells)} columns, the header {len(header)}"
            raise PlantError(f"{place}: {words}; correct it")
        found[place] = dict(zip(header, cells, strict=True))
    return found


def number_in(place: str, key: str, text: str) -> float:
    """A cell as a finite number. Raises PlantError."""
    try:
        value = float(text)
    except ValueError:
        raise PlantError(f"{place}: {key}: {text[:40]!r} is not a number; give one") from None
    if not math.isfinite(value):
        raise PlantError(f"{place}: {key}: {text[:40]!r} is not finite; give a number")
    return value


Index = NDArray[np.int64]
Groups = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class FrameOptions:
    """Numbers of the matching of modes."""

    close: float = 0.15  # relative distance of frequencies within which modes are one group
    frequency_weight: float = 1.0  # weight of |ln f_i/f_j| against 1 - MAC
    tie: float = 1e-3  # share of the shapes' size that keeps an open rotation near the identity


@dataclass(frozen=True)
class Frame:
    """Q (N, r, r): Q[s] turns sample s's modes into the frame; `groups` of modes that K couples."""

    name: str
    Q: Array
    groups: Groups


def frames(table: ModalTable, rigid: int, *, options: FrameOptions = FrameOptions()) -> list[Frame]:
    """The frames worth trying: modes by order, matched, and matched with groups turned.

    The first `rigid` modes are one group in each: rigid-body modes have no order of their own.
    """
    count = table.omega.shape[1]
    shapes = np.concatenate([table.inputs, table.outputs, table.shapes], axis=2)
    order, parents = _tree(table.theta)
    ordered = np.tile(np.arange(count), (len(table.theta), 1))
    matched = _match(table, shapes, order, parents, rigid, options.frequency_weight)
    free: Groups = (tuple(range(rigid)),) if rigid else ()
    single: Groups = tuple((i,) for i in range(rigid, count))
    name, tie = "modes in order of frequency", options.tie
    found = [_frame(name, shapes, ordered, order, parents, free + single, tie)]
    if (matched != ordered).any():
        found.append(_frame("modes matched", shapes, matched, order, parents, free + single, tie))
    groups = free + _groups(np.take_along_axis(table.omega, matched, 1), rigid, options.close)
    if len(groups) < len(free + single):
        name = "modes matched, close ones turned together"
        found.append(_frame(name, shapes, matched, order, parents, groups, tie))
    return found


def _tree(theta: Array) -> tuple[Index, Index]:
    """The samples in breadth-first order from the most central one, and each one's parent."""
    width = np.ptp(theta, axis=0)
    unit = (theta - theta.min(axis=0)) / np.where(width > 0.0, width, 1.0)
    centre = int(np.linalg.norm(unit - unit.mean(axis=0), axis=1).argmin())
    distance = cdist(unit, unit)
    order, parents = breadth_first_order(minimum_spanning_tree(distance), centre, directed=False)
    return order.astype(np.int64), parents.astype(np.int64)


def _match(
    table: ModalTable, shapes: Array, order: Index, parents: Index, rigid: int, weight: float
) -> Index:
    """(N, r) which mode of each sample is the reference's i-th; flexible modes only move."""
    count = table.omega.shape[1]
    found = np.tile(np.arange(count), (len(table.theta), 1))
    for s in order[1:]:
        before = found[parents[s]][rigid:]
        one, other = shapes[parents[s]][before], shapes[s][rigid:]
        sizes = np.outer((one**2).sum(axis=1), (other**2).sum(axis=1))
        # 0 where a shape vanishes at every point
        mac = np.divide((one @ other.T) ** 2, sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
        ratio = table.omega[parents[s]][before][:, None] / table.omega[s][rigid:]
        found[s, rigid:] = rigid + linear_sum_assignment(1.0 - mac + weight * abs(np.log(ratio)))[1]
    return found


def _groups(omega: Array, rigid: int, close: float) -> Groups:
    """Flexible modes in groups that come close, or cross, at some sample."""
    x = np.log(omega[:, rigid:])
    ratio = x[:, :, None] - x[:, None, :]
    near = (np.abs(ratio).min(axis=0) < close) | (np.ptp(np.sign(ratio), axis=0) > 0.0)
    count, label = connected_components(near, directed=False)
    return tuple(tuple((rigid + np.flatnonzero(label == i)).tolist()) for i in range(count))


def _frame(
    name: str, shapes: Array, permutation: Index, order: Index, parents: Index, groups: Groups,
    tie: float,
) -> Frame:  # fmt: skip
    """Signs along the tree; then each group turned next to the reference sample's."""
    N, r = permutation.shape
    Q = np.zeros((N, r, r))
    for s in range(N):
        Q[s, np.arange(r), permutation[s]] = 1.0
    for s in order[1:]:
        along = ((Q[parents[s]] @ shapes[parents[s]]) * (Q[s] @ shapes[s])).sum(axis=1)
        Q[s] *= np.where(along < 0.0, -1.0, 1.0)[:, None]
    reference = Q[order[0]] @ shapes[order[0]]
    for group in groups:
        if len(group) == 1:
            continue
        rows = list(group)
        for s in order[1:]:
            product = reference[rows] @ (Q[s] @ shapes[s])[rows].T
            U, _, Vh = np.linalg.svd(product + tie * np.linalg.norm(product) * np.eye(len(rows)))
            Q[s, rows] = (U @ Vh) @ Q[s, rows]
    return Frame(name, Q, groups)
