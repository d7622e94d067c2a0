"""Columns of numbers from CSV, .npz and .mat files, and what their names and units mean."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ccd_casadi.support.errors import UserError, describe
from ccd_casadi.support.text import HZ
from ccd_casadi.support.text_table import (
    READ,
    cells,
    decimal_comma,
    is_number,
    number_in,
    separator,
    text_of,
)

NAMES = {
    "f": "f", "freq": "f", "frequency": "f", "frequenz": "f", "omega": "f", "ω": "f", "w": "f",
    "re": "re", "real": "re", "real part": "re", "realteil": "re",
    "im": "im", "imag": "im", "imaginary": "im", "imaginary part": "im", "imaginärteil": "im",
    "magnitude": "size", "mag": "size", "amplitude": "size", "betrag": "size", "gain": "size",
    "receptance": "size", "mobility": "size", "accelerance": "size", "inertance": "size",
    "phase": "angle", "angle": "angle",
    "g": "G", "response": "G", "responsedata": "G",  # of MATLAB's frd
    "spread": "spread", "coherence": "coherence", "kohärenz": "coherence",
    "averages": "averages", "number of averages": "averages",
}  # fmt: skip
COMPLIANCE = {  # by the casefolded unit, in which both signs of micro are one
    "": 1.0, "m/n": 1.0, "mm/n": 1e-3, "um/n": 1e-6, "\N{GREEK SMALL LETTER MU}m/n": 1e-6,
    "nm/n": 1e-9, "rad/(n m)": 1.0, "rad/n m": 1.0, "rad/nm": 1.0,
}  # fmt: skip
RATES = {  # units of a velocity or an acceleration over a force: the order of the derivative
    "m/s/n": 1, "(m/s)/n": 1, "m/(n s)": 1, "m/(s n)": 1,
    "m/s^2/n": 2, "(m/s^2)/n": 2, "m/s²/n": 2, "(m/s²)/n": 2, "m/s2/n": 2, "1/kg": 2,
}  # fmt: skip
RATE_NAMES = {"mobility": 1, "accelerance": 2, "inertance": 2}
RATE_WORDS = {1: "a mobility, divided by j 2π f", 2: "an accelerance, divided by -(2π f)²"}
ANGULAR = ("omega", "ω", "w")  # in rad/s where no unit is named
OF_RESPONSE = COMPLIANCE | dict.fromkeys(RATES, 1.0)
UNITS = {
    "f": {"hz": 1.0, "khz": 1e3, "rad/s": 1.0 / HZ, "rad s": 1.0 / HZ, "rad/timeunit": 1.0 / HZ},
    "size": OF_RESPONSE | {"db": -1.0},  # a size in decibels
    "angle": dict.fromkeys(("deg", "degree", "degrees", "°"), np.pi / 180.0)
    | dict.fromkeys(("rad", "radian", "radians"), 1.0),
    "re": OF_RESPONSE, "im": OF_RESPONSE, "G": OF_RESPONSE, "spread": COMPLIANCE,
    "coherence": {"": 1.0}, "averages": {"": 1.0},
}  # fmt: skip
AS_WRITTEN = {"f": "Hz or rad/s", "angle": "deg or rad", "size": "m/N, mm/N, µm/N, nm/N or dB"}
MEGA = re.compile(r"(?<![A-Za-z])M[mM]\s*/")  # as a prefix M is mega, never milli
COMMENT = re.compile(r"\s*[#%]+\s*(\w[\w ]*?)\s*[:=]\s*(.*\S)")  # a name and its value
CHANGES = frozenset({"gain", "gains", "scale", "scaling", "factor", "delay", "delays", "lag",
                     "latency", "deadtime", "rate", "period", "dt", "fs", "ts"})  # fmt: skip
UNIT_NAME = re.compile(r"(?:(.*?)[ _]*units?|units?[ _]+(?:of[ _]+)?(.*))", re.IGNORECASE)
SI = ("", "m", "n", "m/n", "rad", "n m", "seconds")  # units that change no column
WANTED = (
    "f_hz and re, im (or magnitude or magnitude_db, and phase_deg or phase_rad, or a complex G)"
)
_PLAIN = ("-", "1", "abs", "linear")  # units of a ratio


def npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a .npz file, without objects.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict of array

    Raises
    ------
    UserError
        The file cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or describe(error)
        raise UserError(f"{path}: cannot be read: {reason}") from None


@dataclass(frozen=True)
class TableColumn:
    """Values under a name; `rows`: the numbers of the lines of the file they are from."""

    name: str
    values: np.ndarray
    rows: tuple[int, ...] = ()


def choices(quantity: str) -> str:
    """The units of a quantity, as people write them."""
    return AS_WRITTEN.get(quantity, "m/N, mm/N, µm/N or nm/N")


def refuse_polynomials(path: Path, names: Iterable[str]) -> None:
    """Refuse a file, or a struct of it, that holds a transfer function.

    Parameters
    ----------
    path : Path
    names : iterable of str
        What it holds.

    Raises
    ------
    UserError
        A numerator and a denominator are among the names.
    """
    given = {name.casefold(): name for name in names}
    for num, den in (("num", "den"), ("numerator", "denominator")):
        if {num, den} <= given.keys():
            words = f"{given[num]} and {given[den]} are a transfer function, which is not read"
            raise UserError(f"{path}: {words}; give A, B, C, D in a .mat file, or f_hz and G")


def columns_of_arrays(path: Path, content: Mapping[str, Any]) -> list[TableColumn]:
    """Find the columns that hold numbers, with the units that texts state; other texts are
    notes."""
    refuse_polynomials(path, content)
    if {"m", "k"} <= {name.casefold() for name in content}:
        words = "M and K are the matrices of a model, not a response"
        raise UserError(f"{path}: {words}; give A, B, C, D in a .mat file, or a case of its own "
                        "(ccd new)")  # fmt: skip
    found = []
    for name, value in content.items():
        numbers = np.asarray(value.toarray() if scipy.sparse.issparse(value) else value)
        if name.startswith("__") or texts_of(value) or not numbers.size:
            continue
        if numbers.dtype.kind not in "biufc":
            raise UserError(f"{path}: {name}: holds no numbers; drop it")
        if meaning_of(name) is None and not numbers.any():
            continue
        if numbers.ndim != 3:
            if numbers.ndim > 1 and numbers.size != max(numbers.shape):
                words = "is no response: give (lines,) for one channel or (lines, outputs, inputs)"
                raise UserError(f"{path}: {name}: {numbers.shape} {words}")
            numbers = numbers.ravel()
        found.append(TableColumn(name, numbers))
    for name, value in sorted(content.items(), key=lambda item: "spread" not in item[0].casefold()):
        stated, units = UNIT_NAME.fullmatch(name), texts_of(value)
        if stated is None or not units:
            continue
        unit = one_text(path, name, units)
        found = _with_stated_unit(path, name, stated[1] or stated[2] or "", unit, found)
    return found


def texts_of(value: Any) -> tuple[str, ...]:
    """Read the texts of an array or a cell of them.

    Parameters
    ----------
    value : any

    Returns
    -------
    tuple of str
        Empty where it holds anything else.
    """
    if scipy.sparse.issparse(value):
        return ()
    found = np.asarray(value)
    if found.dtype.kind == "O":
        parts = [texts_of(part) for part in found.ravel()]
        return tuple(text for part in parts for text in part) if all(parts) else ()
    if found.dtype.kind not in "US":
        return ()
    return tuple(text.decode("latin-1") if isinstance(text, bytes) else str(text)
                 for text in found.ravel())  # fmt: skip


def one_text(path: Path, name: str, texts: Iterable[str]) -> str:
    """Reduce several texts, one a channel, to what they have in common.

    Parameters
    ----------
    path, name : Path, str
        Where they are.
    texts : iterable of str

    Returns
    -------
    str

    Raises
    ------
    UserError
        They differ.
    """
    found = {text.strip() for text in texts}
    if len(found) != 1:
        words = f"holds several texts; give one unit for all channels: {', '.join(sorted(found))}"
        raise UserError(f"{path}: {name}: {words}")
    return found.pop()


def means_a_change(name: str) -> bool:
    """Whether a name is that of a gain, a delay or a rate.

    Parameters
    ----------
    name : str

    Returns
    -------
    bool
    """
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)
    return "delay" in name.casefold() or any(word.casefold() in CHANGES for word in words)


def of_response(name: str) -> bool | None:
    """Whether a name is that of the unit of a response; None where it is no unit.

    Parameters
    ----------
    name : str

    Returns
    -------
    bool or None
    """
    stated = UNIT_NAME.fullmatch(name)
    if stated is None:
        return None
    of = stated[1] or stated[2] or ""
    found = meaning_of(of) if of else ("G", "")
    return found is not None and found[0] in ("G", "re", "im", "size")


def compliance_of(path: Path, name: str, unit: str) -> float:
    """Read the factor of a unit of a response to m/N.

    Parameters
    ----------
    path, name : Path, str
        Where it is.
    unit : str

    Returns
    -------
    float

    Raises
    ------
    UserError
        The unit is not understood.
    """
    key = "" if unit.casefold() in _PLAIN else unit.casefold()
    if key not in COMPLIANCE or MEGA.match(unit):
        raise UserError(f"{path}: {name}: is {unit!r}; it may be {choices('G')}")
    return COMPLIANCE[key]


def _with_stated_unit(
    path: Path, name: str, of: str, unit: str, columns: Sequence[TableColumn]
) -> list[TableColumn]:
    """The columns with the unit in the text `name`: of the quantity `of`, or of the response. A
    spread without its own unit has that of the response."""
    responses = ("G", "re", "im", "size")
    quantity = meaning_of(of) if of else None
    meant = (quantity[0],) if quantity else responses
    also = meant[0] in responses and unit.casefold() != "db"
    if of and quantity is None:
        if unit.casefold() not in SI:
            words = f"is {unit!r} and is not understood; give the unit of the response as unit"
            raise UserError(f"{path}: {name}: {words}")
        return list(columns)
    if unit and unit.casefold() not in {*_PLAIN, *(word for key in meant for word in UNITS[key])}:
        raise UserError(f"{path}: {name}: is {unit!r}; it may be {choices(meant[0])}")
    return [
        replace(column, name=_with_unit(path, name, column.name, unit))
        if (own := meaning_of(column.name))
        and (own[0] in meant or (also and own == ("spread", "")))
        else column
        for column in columns
    ]


def columns_of_csv(path: Path) -> tuple[list[TableColumn], list[str]]:
    """The columns of a text table, and what of its form is to be reported."""
    text, notes = text_of(path)
    lines, comments = list[tuple[int, str]](), list[tuple[int, str]]()
    for i, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith(("#", "%")):
            comments.append((i, line))
        elif line.strip(" \t,;"):
            lines.append((i, line))
    if not lines:
        raise UserError(f"{path}: is empty; it needs a header and lines of numbers")
    if lines[0][1].strip() == "-1":
        raise UserError(f"{path}: is a universal file; name it {path.stem}.uff")
    last = lines[-1][1]
    mark = separator(last)
    rows = [(i, cells(line, mark)) for i, line in lines]
    comma, note = decimal_comma(path, rows, mark)
    notes += note
    numeric = (len(row) > 1 and all(is_number(cell, comma) for cell in row) for _, row in rows)
    first = next((k for k, found in enumerate(numeric) if found), None)
    if first is None:
        bad = next((cell for cell in rows[-1][1] if not is_number(cell, comma)), last.strip())
        words = f"is not a table of numbers with a header: {bad!r} in line {rows[-1][0]}"
        raise UserError(f"{path}: {words} is no number; {READ}")
    above = [(i, line.lstrip(" #%")) for i, line in comments if i < rows[0][0]]
    if first == 0 and above and len(cells(above[-1][1], mark)) == len(rows[0][1]):
        rows, first = [(above[-1][0], cells(above[-1][1], mark)), *rows], 1
        comments = [item for item in comments if item[0] != above[-1][0]]
        notes.append(f"line {above[-1][0]} is the header")
    if first == 0:
        raise UserError(f"{path}: line {rows[0][0]}: has no header above it; name {WANTED}")
    at = first - 1
    names = rows[at][1]
    units = {unit for known in UNITS.values() for unit in known} | {"-", "abs", "linear"}
    if (
        at
        and all(cell.casefold() in units for cell in names)
        and len(rows[at - 1][1]) == len(names)
    ):
        names = [_with_unit(path, f"line {rows[at][0]}", name, unit)
                 for name, unit in zip(rows[at - 1][1], names, strict=True)]  # fmt: skip
        notes.append(f"line {rows[at][0]} holds the units")
        at -= 1
    if at:
        notes.append(f"what is above the header in line {rows[at][0]} is left out")
    table = []
    for i, row in rows[first:]:
        if len(row) != len(names):
            words = f"has {len(row)} cells and the header {len(names)}"
            if mark == "," and len(row) > len(names):
                words += ": are its decimals commas too? separate the columns by semicolons"
            raise UserError(f"{path}: line {i}: {words}")
        table.append([number_in(path, i, cell, comma) for cell in row])
    numbers = tuple(i for i, _ in rows[first:])
    values = np.array(table)
    parts = [values[:, j] if values[:, j].imag.any() else values[:, j].real
             for j in range(len(names))]  # fmt: skip
    columns = [TableColumn(n, part, numbers) for n, part in zip(names, parts, strict=True)]
    for i, comment in comments:
        found = COMMENT.fullmatch(comment.rstrip(" \t,;"))
        stated = UNIT_NAME.fullmatch(found[1]) if found else None
        if found and stated:
            of = stated[1] or stated[2] or ""
            columns = _with_stated_unit(path, f"line {i}, {found[1]}", of, found[2], columns)
            notes.append(f"line {i} gives the unit {found[2]}")
        elif found and means_a_change(found[1]):
            notes.append(f"line {i} is a comment and left out: {found[1]} = {found[2]}")
    return columns, notes


def meaning_of(name: str) -> tuple[str, str] | None:
    """The quantity under a name, and its unit as it is written; None where it is not known."""
    name = " ".join(name.replace("_", " ").split()).casefold()
    if name == "hz":
        return "f", "hz"
    if name in ("db", "deg"):
        return ("size" if name == "db" else "angle"), name
    if name in ANGULAR:
        return "f", "rad/s"
    if name in NAMES and name != "gain":  # which may be a factor
        return NAMES[name], ""
    bracket = re.fullmatch(r"(.*?)\s*[(\[]\s*(.*?)\s*[)\]]", name)
    base, unit = bracket.groups() if bracket else name.split(" ", 1) if " " in name else (name, "")
    if base not in NAMES or (base == "gain" and not unit):
        return None
    unit = "" if bracket and unit in _PLAIN else unit
    return NAMES[base], unit


def rate_order(path: Path, name: str) -> int:
    """Find of which derivative of a displacement a column of a response is, by its name or its
    unit: 0 receptance, 1 mobility, 2 accelerance. Raises UserError where the two differ.
    """
    base = re.split(r"[ _(\[]", name.strip().casefold())[0]
    found = meaning_of(name)
    unit = found[1] if found else ""
    named, stated = RATE_NAMES.get(base), RATES.get(unit)
    if named is not None and unit not in ("", "db") and stated != named:
        raise UserError(f"{path}: {name!r}: a {base} is not in {unit}; name what it is")
    return named or stated or 0


def _with_unit(path: Path, place: str, name: str, unit: str) -> str:
    """The name of a column with the unit that is stated at another place."""
    found = meaning_of(name)
    if not unit or found is None or not found[1]:
        return f"{name} ({unit})" if unit else name
    factors = [UNITS[found[0]].get(word) for word in (found[1], unit.casefold())]
    if factors[0] != factors[1]:
        raise UserError(f"{path}: {place}: gives {name!r} the unit {unit!r}; keep one")
    return name
