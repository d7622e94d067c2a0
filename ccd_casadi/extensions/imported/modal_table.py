"""A table of modal models at samples of θ: what any finite-element program can export as CSV.

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
        input_names=_stripped(groups["in:"]),
        output_names=_stripped(groups["out:"]),
        constraint_names=_stripped(groups["constraint:"]),
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


def _stripped(names: Sequence[str]) -> tuple[str, ...]:
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
