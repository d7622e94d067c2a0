"""Tables of a frequency response: what each column means, exactly, or a refusal that names it.

A column that may change the plant and is not understood is refused. Two readings that are both
possible (radians under the name of degrees, decibels under that of magnitude) are refused too.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError, described
from ccd_casadi.support.json_files import mat_variables
from ccd_casadi.support.text import HZ

NAMES = {
    "f": "f", "freq": "f", "frequency": "f",
    "re": "re", "real": "re", "real part": "re",
    "im": "im", "imag": "im", "imaginary": "im", "imaginary part": "im",
    "magnitude": "size", "mag": "size", "amplitude": "size",
    "phase": "angle", "angle": "angle",
    "g": "G", "response": "G",
    "spread": "spread", "coherence": "coherence",
}  # fmt: skip
COMPLIANCE = {"": 1.0, "m/n": 1.0, "mm/n": 1e-3, "um/n": 1e-6, "µm/n": 1e-6, "nm/n": 1e-9}
UNITS = {
    "f": {"hz": 1.0, "khz": 1e3, "rad/s": 1.0 / HZ, "rad s": 1.0 / HZ},
    "size": COMPLIANCE | {"db": -1.0},  # a size in decibels
    "angle": dict.fromkeys(("deg", "degree", "degrees", "°"), np.pi / 180.0)
    | dict.fromkeys(("rad", "radian", "radians"), 1.0),
    "re": COMPLIANCE, "im": COMPLIANCE, "G": COMPLIANCE, "spread": COMPLIANCE,
    "coherence": {"": 1.0},
}  # fmt: skip
WANTED = (
    "f_hz and re, im (or magnitude or magnitude_db, and phase_deg or phase_rad, or a complex G)"
)
READ = "CSV, .npz and .mat are read"
FEW_DEGREES = 30.0  # a phase that stays within them may as well be in radians
TURNS = 4.0 * np.pi  # radians beyond which a phase may as well be in degrees
DIGITS = "0123456789+-."
PLACES, DELAYS = 200, 60  # of the test by Bode's relation: places over ln f, delays tried
MISFIT, BETTER = (
    np.radians(20.0),
    0.85,
)  # of a reading that is doubted, and of one that is as likely


@dataclass(frozen=True)
class ResponseTable:
    """G (k,) or (k, p, m) in m/N at `hz` (k,), the `spread`, and `words`: what was understood."""

    hz: Array
    G: np.ndarray
    spread: Array | None
    words: str


def read_table(path: Path) -> ResponseTable:
    """The response in a .csv, .npz or .mat file. Raises UserError that names what is not clear."""
    suffix, notes = path.suffix.lower(), list[str]()
    if suffix == ".npz":
        columns = _variables(path, _npz(path))
    elif suffix == ".mat":
        columns = _variables(path, mat_variables(path))
    else:
        columns, notes = _csv(path)
    return _understood(path, columns, notes)


def holds_lines(names: Sequence[str]) -> bool:
    """Whether one of these variables is a frequency."""
    return any((found := _meaning(name)) and found[0] == "f" for name in names)


def _npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or described(error)
        raise UserError(f"{path}: cannot be read as a frequency response: {reason}") from None


@dataclass(frozen=True)
class Column:
    """Values under a name; `rows`: the numbers of the lines of the file they are from."""

    name: str
    values: np.ndarray
    rows: tuple[int, ...] = ()


def _variables(path: Path, content: Mapping[str, Any]) -> list[Column]:
    """Those that hold numbers; texts are notes."""
    found = []
    for name, value in content.items():
        numbers = np.asarray(value.toarray() if scipy.sparse.issparse(value) else value)
        if name.startswith("__") or numbers.dtype.kind in "US" or not numbers.size:
            continue
        if numbers.dtype.kind not in "biufc":
            raise UserError(f"{path}: {name}: holds no numbers; drop it")
        if _meaning(name) is None and not numbers.any():
            continue
        if numbers.ndim != 3:
            if numbers.ndim > 1 and numbers.size != max(numbers.shape):
                words = "is no response: give (lines,) for one channel or (lines, outputs, inputs)"
                raise UserError(f"{path}: {name}: {numbers.shape} {words}")
            numbers = numbers.ravel()
        found.append(Column(name, numbers))
    return found


def _csv(path: Path) -> tuple[list[Column], list[str]]:
    """The columns of a text table, and what of its form is to be reported."""
    text, notes = _text(path)
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1)
             if line.strip(" \t,;") and not line.lstrip().startswith(("#", "%"))]  # fmt: skip
    if not lines:
        raise UserError(f"{path}: is empty; it needs a header and lines of numbers")
    if lines[0][1].strip() == "-1" or path.suffix.lower() in (".uff", ".unv"):
        raise UserError(f"{path}: is a universal file; {READ}: write it as one of them")
    last = lines[-1][1]
    mark = next((mark for mark in "\t;," if mark in last), None)
    rows = [(i, _cells(line, mark)) for i, line in lines]
    comma, note = _decimal_comma(path, rows, mark)
    notes += note
    numeric = (len(row) > 1 and all(_is_number(cell, comma) for cell in row) for _, row in rows)
    first = next((k for k, found in enumerate(numeric) if found), None)
    if first is None:
        bad = next((cell for cell in rows[-1][1] if not _is_number(cell, comma)), last.strip())
        words = f"is not a table of numbers with a header: {bad!r} in line {rows[-1][0]}"
        raise UserError(f"{path}: {words} is no number; {READ}")
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
        names = [_with_unit(path, rows[at][0], name, unit)
                 for name, unit in zip(rows[at - 1][1], names, strict=True)]  # fmt: skip
        notes.append(f"line {rows[at][0]} holds the units")
        at -= 1
    if at:
        notes.append(f"what is above the header in line {rows[at][0]} is left out")
    table = []
    for i, row in rows[first:]:
        if len(row) != len(names):
            words = f"has {len(row)} cells and the header {len(names)}"
            if mark == "," and len(row) == 2 * len(names):
                words += ": are its decimals commas too? separate the columns by semicolons"
            raise UserError(f"{path}: line {i}: {words}")
        table.append([_number(path, i, cell, comma) for cell in row])
    numbers = tuple(i for i, _ in rows[first:])
    values = np.array(table)
    parts = [values[:, j] if values[:, j].imag.any() else values[:, j].real
             for j in range(len(names))]  # fmt: skip
    return [Column(n, part, numbers) for n, part in zip(names, parts, strict=True)], notes


def _text(path: Path) -> tuple[str, list[str]]:
    try:
        raw = path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"{path}: cannot be read as a frequency response: {reason}") from None
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return raw.decode("utf-16"), ["encoded as UTF-16"]
        except UnicodeDecodeError:
            raise UserError(f"{path}: is not a table of numbers; {READ}") from None
    if b"\0" in raw:
        raise UserError(f"{path}: is not a table of numbers but a binary file; {READ}")
    try:
        return raw.decode("utf-8-sig"), []
    except UnicodeDecodeError:
        return raw.decode("latin-1"), ["encoded as Latin-1"]


def _cells(line: str, mark: str | None) -> list[str]:
    parts = [part.strip().strip('"').strip() for part in line.split(mark)]
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    return parts


def _decimal_comma(
    path: Path, rows: Sequence[tuple[int, list[str]]], mark: str | None
) -> tuple[bool, list[str]]:
    """Whether its decimals are commas, and what is to be reported of its form."""
    word = {"\t": "tabs", ";": "semicolons", None: "spaces"}.get(mark, "")
    notes = [f"separated by {word}"] if word else []
    if mark == ",":
        return False, notes
    cells = [
        (i, c) for i, row in rows for c in row if c and set(c.casefold()) <= set(DIGITS + ",e")
    ]
    with_comma = [(i, c) for i, c in cells if "," in c]
    if not with_comma:
        return False, notes
    both = next((i for i, c in with_comma if "." in c or c.count(",") > 1), None)
    if both is None and any("." in c for _, c in cells):
        both = with_comma[0][0]
    thousands = all(re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", c) for _, c in with_comma)
    if both is not None or thousands:
        words = "a comma may be a decimal or part thousands; write decimals with a point"
        raise UserError(f"{path}: line {both or with_comma[0][0]}: {words}")
    return True, [*notes, "decimals by commas"]


def _is_number(cell: str, comma: bool) -> bool:
    try:
        _parsed(cell, comma)
    except ValueError:
        return False
    return True


def _parsed(cell: str, comma: bool) -> complex:
    cell = cell.replace(",", ".") if comma else cell
    return complex(re.sub(r"(?<=[\d.])[iI]$", "j", cell.replace(" ", "")))


def _number(path: Path, line: int, cell: str, comma: bool) -> complex:
    try:
        found = _parsed(cell, comma)
    except ValueError:
        raise UserError(f"{path}: line {line}: {cell!r} is not a number") from None
    if not np.isfinite(found):
        raise UserError(f"{path}: line {line}: {cell!r} is not a finite number; drop the line")
    return found


def _meaning(name: str) -> tuple[str, str] | None:
    """The quantity under a name, and its unit as it is written; None where it is not known."""
    name = " ".join(name.replace("_", " ").split()).casefold()
    if name == "hz":
        return "f", "hz"
    if name in NAMES:
        return NAMES[name], ""
    bracket = re.fullmatch(r"(.*?)\s*[(\[]\s*(.*?)\s*[)\]]", name)
    base, unit = bracket.groups() if bracket else name.split(" ", 1) if " " in name else (name, "")
    if base not in NAMES:
        return None
    unit = "" if bracket and unit in ("-", "1", "abs", "linear") else unit
    return NAMES[base], unit


def _with_unit(path: Path, line: int, name: str, unit: str) -> str:
    """The name of a column with the unit that a line below it states."""
    found = _meaning(name)
    if not unit or found is None or not found[1]:
        return f"{name} ({unit})" if unit else name
    factors = [UNITS[found[0]].get(word) for word in (found[1], unit.casefold())]
    if factors[0] != factors[1]:
        raise UserError(f"{path}: line {line}: gives {name!r} the unit {unit!r}; keep one")
    return name


def _understood(path: Path, columns: Sequence[Column], notes: Sequence[str]) -> ResponseTable:
    """The response that the columns state."""
    known = dict(_quantities(path, columns))
    if "f" not in known:
        raise UserError(f"{path}: has no column f_hz; give the frequencies that name")
    hz, rows = known["f"][0].values.real.astype(float) * known["f"][1], known["f"][0].rows
    given = known.keys() - {"f", "spread", "coherence"}
    if given not in ({"re", "im"}, {"size", "angle"}, {"G"}, {"G", "angle"}):
        names = ", ".join(known[key][0].name for key in sorted(given)) or "nothing else"
        raise UserError(f"{path}: needs re and im, or magnitude and phase, or G alone: has {names}")
    parts = {key: np.asarray(column.values) for key, (column, _) in known.items()}
    for key in parts.keys() - {"f", "coherence"}:
        if parts[key].ndim == 1 and parts[key].shape != hz.shape:
            words = f"has {len(parts[key])} values and {known['f'][0].name} {len(hz)}"
            raise UserError(f"{path}: {known[key][0].name}: {words}")
        if key != "G" and np.iscomplexobj(parts[key]):
            raise UserError(f"{path}: {known[key][0].name}: is complex; name it G")
    G: np.ndarray
    if given == {"re", "im"}:
        if known["re"][1] != known["im"][1]:
            raise UserError(f"{path}: re and im have different units; give both in m/N")
        G = (parts["re"] + 1j * parts["im"]) * known["re"][1]
    elif given == {"G"}:
        G = parts["G"] * known["G"][1]
        if not np.iscomplexobj(G) or not G.imag.any():
            words = f"{known['G'][0].name}: is real, so its phase is missing; give a complex G"
            raise UserError(f"{path}: {words}, or re and im")
    else:
        G = _of_size_and_angle(path, hz, known)
    spread = parts.get("spread")
    if spread is not None:
        spread = spread * known["spread"][1]
    if G.ndim == 3:
        if len(G) == len(hz) == G.shape[-1]:
            raise UserError(f"{path}: lines may be the first or the last index of G; drop a line")
        if len(G) != len(hz):  # lines last, as MATLAB has them
            G = np.moveaxis(G, -1, 0)
            spread = spread if spread is None else np.moveaxis(spread, -1, 0)
    kept = hz != 0.0
    where = [f"line {rows[i]}" if rows else "the line" for i in np.flatnonzero(~kept)]
    notes = [*notes, *(f"{word} at 0 Hz is left out" for word in where)]
    down = np.flatnonzero(np.diff(hz) <= 0.0)
    if (hz < 0.0).any() or len(down):
        i = int(down[0]) + 1 if len(down) else 0
        how = "repeats" if len(down) and hz[i] == hz[i - 1] else "falls to"
        word = f"line {rows[i]}" if rows else f"value {i + 1} of f_hz"
        raise UserError(f"{path}: {word} {how} {hz[i]:.6g} Hz; frequencies have to rise")
    hz, G, spread = hz[kept], G[kept], spread if spread is None else spread[kept]
    left = [known["coherence"][0].name + " is left out"] if "coherence" in known else []
    names = ", ".join(known[key][0].name for key in known if key != "coherence")
    span = f"{len(hz)} lines from {hz[0]:.4g} to {hz[-1]:.4g} Hz" if len(hz) else "no line"
    return ResponseTable(hz, G, spread, "; ".join([f"{span} of {names}", *notes, *left]))


def _quantities(
    path: Path, columns: Sequence[Column]
) -> Iterator[tuple[str, tuple[Column, float]]]:
    """Each quantity with its column and the factor to SI; -1 of decibels."""
    seen: dict[str, str] = {}
    for column in columns:
        found = _meaning(column.name)
        if found is None:
            words = "is not understood and may change the plant; drop it, or name"
            raise UserError(f"{path}: {column.name!r}: {words} {WANTED}")
        quantity, unit = found
        if quantity in seen:
            first = seen[quantity]
            words = f"column {first!r} is there twice" if first == column.name else (
                f"{first!r} and {column.name!r} are the same quantity")  # fmt: skip
            raise UserError(f"{path}: {words}; keep one")
        seen[quantity] = column.name
        if unit not in UNITS[quantity]:
            usual = {"f": ("hz", "rad/s"), "angle": ("deg", "rad")}
            choices = " or ".join(filter(None, usual.get(quantity, UNITS[quantity])))
            words = f"has the unit {unit!r}" if unit else "names no unit"
            raise UserError(f"{path}: {column.name!r}: {words}; it may be {choices}")
        yield quantity, (column, UNITS[quantity][unit])


def _of_size_and_angle(
    path: Path, hz: Array, known: Mapping[str, tuple[Column, float]]
) -> np.ndarray:
    """G of a magnitude and a phase. Raises UserError where another reading is as possible."""
    (sized, factor), (turned, to_rad) = known.get("size") or known["G"], known["angle"]
    if np.iscomplexobj(sized.values) or sized.values.ndim != 1:
        raise UserError(
            f"{path}: {sized.name}: is complex or of several channels; drop {turned.name}"
        )
    size, angle = sized.values.astype(float), turned.values.astype(float)
    if factor > 0.0 and (size < 0.0).any():
        words = "is negative at a line; if it is in decibels name it magnitude_db"
        raise UserError(f"{path}: {sized.name}: {words}")
    largest, degrees = np.abs(angle).max(initial=0.0), to_rad != 1.0
    decibels = 10.0 ** (np.clip(size, -6e3, 6e3) / 20.0)
    named = decibels if factor < 0.0 else size * factor
    own = _bode_misfit(hz, named, angle * to_rad)
    turned_other = _bode_misfit(hz, named, angle * (1.0 if degrees else np.pi / 180.0))
    clear = own < MISFIT and turned_other > own / BETTER
    odd = 0.0 < largest <= FEW_DEGREES if degrees else largest > TURNS and not clear
    if odd or (own > MISFIT and turned_other < BETTER * own):
        words = f"is {largest:.4g} at most: {'radians' if degrees else 'degrees'} may be meant"
        raise UserError(f"{path}: {turned.name}: {words}; give re and im, or name it "
                        f"{'phase_rad' if degrees else 'phase_deg'}")  # fmt: skip
    doubted = factor > 0.0 and own > MISFIT
    if doubted and _bode_misfit(hz, decibels, angle * to_rad) < BETTER * own:
        words = "decibels may be meant, with which phase and slope agree"
        raise UserError(f"{path}: {sized.name}: {words}; name it magnitude_db, or give re and im")
    return np.asarray(named * np.exp(1j * angle * to_rad))


def least_phase(y: Array, x: Array) -> Array:
    """Phase (rad) of the stable minimum-phase G with ln|G| = y at even x = ln f: Bode's weight of
    the slope, which is taken to go on beyond the ends."""
    slope = np.pad(np.gradient(y, x), len(x), mode="edge")
    v = (np.arange(-len(x), len(x) + 1) + 0.5 / len(x)) * (x[1] - x[0])
    weight = np.log(1.0 / np.tanh(0.5 * np.abs(v)))
    smooth = np.convolve(slope, weight / weight.sum(), mode="same")[len(x) : -len(x)]
    return np.asarray(0.5 * np.pi * smooth)


def _bode_misfit(hz: Array, size: Array, angle: Array) -> float:
    """Mean |φ - φ₀| (rad) over ln f, φ₀ = `least_phase`, for either sign of G and behind the delay
    that fits best."""
    good = (hz > 0.0) & (size > 0.0)
    x, y = np.log(hz[good]), np.log(size[good])
    if len(x) < 5 or not (np.diff(x) > 0.0).all():
        return 0.0
    places = np.linspace(x[0], x[-1], PLACES)
    off = np.interp(places, x, np.unwrap(angle[good])) - least_phase(
        np.interp(places, x, y), places
    )
    lag = np.append(0.0, np.geomspace(0.1, 100.0, DELAYS))[:, None] * np.exp(places - places[-1])
    apart = np.abs(np.angle(np.exp(1j * (off + lag)))).mean(axis=1)
    opposite = np.abs(np.angle(-np.exp(1j * (off + lag)))).mean(axis=1)
    return float(np.minimum(apart, opposite).min())
