"""Columns of a log by name: from text and binary files, as numbers over samples."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ccd_casadi.extensions.records.signal_names import unit_factor
from ccd_casadi.extensions.records.tdms import tdms_columns
from ccd_casadi.extensions.records.twincat import is_scope, scope_columns
from ccd_casadi.plants.table_columns import npz_arrays, texts_of
from ccd_casadi.support.errors import UserError, described
from ccd_casadi.support.json_files import mat_variables
from ccd_casadi.support.text_table import (
    cells,
    decimal_comma,
    is_number,
    number_in,
    separator,
    text_of,
)

RATES = ("rate", "rate_hz", "fs", "sampling_rate", "sample_rate")
PERIODS = ("dt", "ts", "period", "sampling_time")
Columns = dict[str, np.ndarray]


def read_columns(path: Path) -> tuple[Columns, float | None, list[str]]:
    """Read the columns of a log.

    Parameters
    ----------
    path : Path
        Of FORMATS, or a text table with a header.

    Returns
    -------
    dict of str to array (n,)
    float or None
        Sampling rate in Hz where the file states it beside the columns.
    list of str
        What of the file's form is to be reported.

    Raises
    ------
    UserError
        The file cannot be read, or holds no columns of equal length.
    """
    suffix = path.suffix.lower()
    columns, rate, notes = FORMATS.get(suffix, _of_text)(path)
    if not columns:
        raise UserError(f"{path}: holds no signals; give t, the excitation, the force and position")
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        each = ", ".join(f"{name} {len(values)}" for name, values in columns.items())
        raise UserError(f"{path}: its signals have different lengths: {each}; give them one length")
    return columns, rate, notes


Read = tuple[Columns, float | None, list[str]]


def _of_npz(path: Path) -> Read:
    return _of_arrays(path, npz_arrays(path))


def _of_mat(path: Path) -> Read:
    return _of_arrays(path, _one_struct(mat_variables(path)))


def _of_arrays(path: Path, content: Mapping[str, np.ndarray]) -> Read:
    columns, rate = dict[str, np.ndarray](), None
    for name, value in content.items():
        numbers = np.asarray(value)
        if name.startswith("__") or texts_of(value) or not numbers.size:
            continue
        if numbers.dtype.kind not in "biuf":
            raise UserError(f"{path}: {name}: holds no real numbers; drop it")
        if numbers.size == 1:
            rate = _stated_rate(path, name, float(numbers.ravel()[0])) or rate
        elif numbers.size == max(numbers.shape):
            columns[name] = numbers.ravel().astype(float)
        else:
            raise UserError(f"{path}: {name}: {numbers.shape} is not one signal; give each signal "
                            "as its own array")  # fmt: skip
    return columns, rate, []


def _one_struct(content: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The fields of the only struct of a .mat file, if it has one."""
    arrays = {name: np.asarray(value) for name, value in content.items() if name[:2] != "__"}
    structs = [value for value in arrays.values() if value.dtype.names]
    if len(structs) != 1 or structs[0].size != 1:
        return content
    return {name: structs[0].ravel()[0][name] for name in structs[0].dtype.names or ()}


def _stated_rate(path: Path, name: str, value: float) -> float | None:
    known = name.casefold()
    if known not in (*RATES, *PERIODS):
        return None
    if not 0.0 < value < np.inf:
        raise UserError(f"{path}: {name}: is {value:g}; give it above 0")
    return value if known in RATES else 1.0 / value


def _of_wav(path: Path) -> Read:
    from scipy.io import wavfile  # slow to import, and few logs are sound

    try:
        rate, values = wavfile.read(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as WAV: {described(error)}") from None
    notes = []
    if values.dtype.kind in "iu":
        offset = 128 if values.dtype.kind == "u" else 0
        values = (values.astype(float) - offset) / (2.0 ** (8 * values.dtype.itemsize - 1))
        notes = ["full scale is 1"]
    table = values.reshape(len(values), -1).astype(float)
    return {str(i): own for i, own in enumerate(table.T, 1)}, float(rate), notes


def _of_text(path: Path) -> Read:
    text, notes = text_of(path)
    if is_scope(text):
        channels, own = scope_columns(path, text)
        return channels, None, [*notes, *own]
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip(" \t,;|")]
    if not lines:
        raise UserError(f"{path}: is empty; it needs a header and lines of numbers")
    mark = separator(lines[-1][1])
    head = [(i, cells(line, mark)) for i, line in lines[:200]]
    comma, form = decimal_comma(path, [*head, *((i, cells(line, mark)) for i, line in lines[-50:])],
                                mark)  # fmt: skip
    full = (len(row) > 1 and all(is_number(cell, comma) for cell in row) for _, row in head)
    first = next((k for k, found in enumerate(full) if found), None)
    if first is None:
        raise UserError(f"{path}: is not a table of numbers with a header of names")
    if first == 0:
        raise UserError(f"{path}: line {lines[0][0]}: has no header above it; name the columns")
    notes, at, names = [*notes, *form], first - 1, head[first - 1][1]
    names = [name.lstrip("#% ") for name in names]
    if at and all(unit_factor(name) is not None for name in names) and (
        len(head[at - 1][1]) == len(names)
    ):  # fmt: skip
        notes.append(f"line {head[at][0]} holds the units")
        at -= 1
        above = [name.lstrip("#% ") for name in head[at][1]]
        names = [f"{name} ({unit.strip('[]()')})" for name, unit in zip(above, names, strict=True)]
    if at:
        notes.append(f"what is above the header in line {head[at][0]} is left out")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"{path}: column {twice!r} is there twice; keep one")
    body = lines[first:]
    found = _numbers(path, body, mark, comma, len(names))
    return dict(zip(names, found.T, strict=True)), None, notes


def _numbers(
    path: Path, body: Sequence[tuple[int, str]], mark: str | None, comma: bool, count: int
) -> np.ndarray:
    """The table (n, columns); a line that is not numbers is named."""
    text = [line.replace(",", ".") if comma else line for _, line in body]
    try:
        ends = [line.rstrip(" \t;,|") for line in text]
        found = np.loadtxt(ends, delimiter=mark, ndmin=2, comments=None)
        if found.shape[1] == count and np.isfinite(found).all():
            return found
    except ValueError:
        pass
    for i, line in body:
        row = cells(line, mark)
        if len(row) != count:
            raise UserError(f"{path}: line {i}: has {len(row)} cells and the header {count}")
        for cell in row:
            number_in(path, i, cell, comma)
    raise UserError(f"{path}: is not a table of real numbers with a header of names")


FORMATS: Mapping[str, Callable[[Path], Read]] = {
    ".npz": _of_npz, ".mat": _of_mat, ".wav": _of_wav, ".tdms": tdms_columns,
}  # fmt: skip
