"""Columns of a log by name, with units, as numbers over samples: text, binary, LabVIEW, TwinCAT.

.tdms is read by npTDMS: every channel of one length and one sampling time. The text export of a
TwinCAT scope has groups of channels, each behind its time in ms.
"""

import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ccd_casadi.plants.table_columns import npz_arrays, texts_of
from ccd_casadi.support.errors import UserError, describe, require
from ccd_casadi.support.json_files import mat_variables
from ccd_casadi.support.text_table import (
    cells,
    decimal_comma,
    is_number,
    number_in,
    separator,
    text_of,
)

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "force": {"n": 1.0, "mn": 1e-3, "kn": 1e3, "n m": 1.0, "nm": 1.0, "n*m": 1.0, "v": 1.0},
    "position": {
        "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "rad": 1.0, "mrad": 1e-3,
        "urad": 1e-6, "µrad": 1e-6,
    },
}  # fmt: skip


def unit_factor(text: str) -> float | None:
    """Find the factor of a cell that holds a unit alone; None where it is not a unit.

    >>> unit_factor("[ms]"), unit_factor("speed")
    (0.001, None)
    """
    plain = _plain(text.strip("[]() "))
    if plain in ("", "-", "1"):
        return 1.0
    return next((units[plain] for units in UNITS.values() if plain in units), None)


def _plain(text: str) -> str:
    micro = text.replace("\N{GREEK SMALL LETTER MU}", "µ")
    return " ".join(micro.replace("_", " ").split()).casefold()


def split_unit(name: str) -> tuple[str, str]:
    """Part the name of a column from its unit, both in small letters; "" where there is no unit.

    >>> parts = "Position [mm]", "force_command", "pos_um", "ActPosUm[0]"
    >>> tuple(map(split_unit, parts))
    (('position', 'mm'), ('force command', ''), ('pos', 'um'), ('actpos', 'um'))
    """
    name = re.sub(r"\[\d+\]$", "", name.strip())  # the number of an axis
    camel = re.fullmatch(r"(\w*[a-z])(Um|Mm|Mrad|Urad|N)", name)
    if camel:
        return _plain(camel[1]), _plain(camel[2])
    plain = _plain(name)
    bracket = re.fullmatch(r"(.*?)\s*[(\[]\s*(.*?)\s*[)\]]", plain)
    if bracket:
        return bracket[1], bracket[2]
    base, _, last = plain.rpartition(" ")
    if base and any(last in units for units in UNITS.values()):
        return base, last
    return plain, ""


class _Kept(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.words: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.words.append(record.getMessage())


@contextmanager
def _heard() -> Iterator[list[str]]:
    """The warnings of npTDMS, which reads on where a file is cut off, instead of its printing."""
    kept = _Kept()
    logs = [logging.getLogger(name) for name in (*logging.root.manager.loggerDict,)
            if name.partition(".")[0] == "nptdms"]  # fmt: skip
    before = [log.handlers for log in logs]
    for log in logs:
        log.handlers = [kept]
    try:
        yield kept.words
    finally:
        for log, own in zip(logs, before, strict=True):
            log.handlers = own


def tdms_columns(path: Path) -> tuple[dict[str, np.ndarray], float | None, list[str]]:
    """Read the channels of numbers.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict of str to array (n,)
        By name, with the unit where the file has one; by group and name where two are alike.
    float or None
        Sampling rate in Hz where the channels are waveforms.
    list of str
        What is to be reported.

    Raises
    ------
    UserError
        The file cannot be read, or its channels begin or are sampled differently.
    """
    nptdms = require("nptdms", "tdms")
    try:
        with _heard() as found, path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
            every = [one for group in file.groups() for one in group.channels()]
            read = [(one, np.asarray(one[:])) for one in every]
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # a damaged file fails anywhere inside the reader
        raise UserError(f"{path}: is not a readable .tdms file: {describe(error)}") from None
    if found:
        raise UserError(f"{path}: is cut off or damaged: {found[0]}; export it again")
    kept = [(one, own) for one, own in read if own.dtype.kind in "biuf" and own.size]
    names = [one.name for one, _ in kept]
    columns, clocks = dict[str, np.ndarray](), set()
    for one, own in kept:
        name = one.name if names.count(one.name) == 1 else f"{one.group_name}/{one.name}"
        unit = str(one.properties.get("unit_string", "")).strip()
        columns[f"{name} ({unit})" if unit else name] = own.astype(float)
        step, start = (one.properties.get(f"wf_{key}") for key in ("increment", "start_offset"))
        clocks.add((step, start or 0.0) if step else None)
    if len(clocks) > 1:
        words = ", ".join(sorted(f"{own[0]:g} s from {own[1]:g} s" if own else "none"
                                 for own in clocks))  # fmt: skip
        raise UserError(f"{path}: its channels have different sampling times: {words}; "
                        "export channels of one")  # fmt: skip
    clock = next(iter(clocks), None)
    left = [one.name for one, own in read if own.dtype.kind not in "biuf"]
    notes = [f"not numbers and left out: {', '.join(left)}"] if left else []
    return columns, None if clock is None else 1.0 / float(clock[0]), notes


RATE, NAME, FILE, UNIT = "SampleTime[ms]", "Name", "File", "Unit"


def is_scope(text: str) -> bool:
    """Whether a text is such an export."""
    lines = text.splitlines()[:30]
    return len(lines) > 1 and lines[0].startswith(NAME) and lines[1].startswith(FILE + _mark(lines))


def scope_columns(path: Path, text: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read the channels of the sampling time that most of them have: "t (ms)" and the channels with
    their units, as the scope has scaled them; and what is to be reported.

    Raises UserError where the separator occurs inside cells, or a line is not numbers.
    """
    try:
        return _columns(path, [line.rstrip("\r") for line in text.splitlines()])
    except UserError:
        raise
    except (StopIteration, ValueError, IndexError):
        words = "is cut off or changed: it needs names, sampling times, an empty line and numbers"
        raise UserError(f"{path}: as a TwinCAT scope it {words}; export it again") from None


def _columns(path: Path, lines: list[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    mark = _mark(lines)
    top = max(i for i, line in enumerate(lines[:30]) if line.split(mark)[0].strip('"') == NAME)
    at = next((i for i, line in enumerate(lines[:30]) if line.startswith(RATE)), top)
    names, rates = (_trim(lines[i].split(mark)) for i in (top, at))
    head = RATE if at > top else NAME  # without the channels' properties all are of one time
    units = next((line.split(mark) for line in lines[at:] if line.startswith(UNIT + mark)), [])
    times = [i for i, cell in enumerate(rates) if cell == head]
    if [i for i, name in enumerate(names) if name == NAME] != times or len(names) != len(rates):
        words = "is its separator and also within a name or a decimal; export with tabs"
        raise UserError(f"{path}: line {at + 1}: {mark!r} {words}")
    of = {i: max(t for t in times if t < i) for i in range(len(rates)) if i not in times}
    steps = {i: float(rates[i].replace(",", ".")) if at > top else 0.0 for i in of}
    most = max(set(steps.values()), key=lambda step: (list(steps.values()).count(step), -step))
    kept = [i for i in of if steps[i] == most]
    first = next(i for i in range(at, len(lines)) if not lines[i].strip(mark + " ")) + 1
    body = [(i, lines[i].split(mark)) for i in range(first, len(lines))
            if lines[i].strip() not in ("", "EOF")]  # fmt: skip
    clock = _column(path, body, of[kept[0]], len(rates))
    if not len(clock):
        raise ValueError
    found = {"t (ms)": clock}
    for i in kept:
        if of[i] != of[kept[0]]:
            own = _column(path, body, of[i], len(rates))
            if len(own) != len(clock) or np.abs(own - clock).max() > 0.0:
                raise UserError(f"{path}: {names[i]!r} has other times than {names[kept[0]]!r}; "
                                "export one start for all")  # fmt: skip
        name = _name(names[i], units[i] if i < len(units) else "")
        if name in found:
            raise UserError(f"{path}: column {name!r} is there twice; keep one")
        found[name] = _column(path, body, i, len(rates))
    notes = ["a TwinCAT scope, as scaled there"]
    other = [names[i] for i in of if i not in kept]
    if other:
        notes.append(f"of another sampling time than {most:g} ms and left out: {', '.join(other)}")
    return found, notes


def _mark(lines: Sequence[str]) -> str:
    """Return the separator, which follows the first word of the file."""
    return lines[0].removeprefix(NAME)[:1] or "\t"


def _trim(row: list[str]) -> list[str]:
    while row and not row[-1].strip():
        row.pop()
    return row


def _name(name: str, unit: str) -> str:
    word = unit.strip().split(" ")[0]
    return name if word in ("", "(None)") else f"{name} ({word})"


def _column(path: Path, body: Sequence[tuple[int, list[str]]], i: int, count: int) -> np.ndarray:
    """A column down to where its group ends."""
    found = []
    for line, row in body:
        while len(row) > count and not row[-1].strip():
            row.pop()
        if len(row) > count:
            words = f"has {len(row)} cells and the header {count}: its separator is in a decimal"
            raise UserError(f"{path}: line {line + 1}: {words}; export with tabs")
        cell = row[i].strip() if i < len(row) else ""
        if not cell:
            break
        try:
            found.append(float(cell.replace(",", ".")))
        except ValueError:
            raise UserError(f"{path}: line {line + 1}: {cell[:40]!r} is not a number") from None
    return np.array(found)


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
        raise UserError(f"{path}: cannot be read as WAV: {describe(error)}") from None
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
