"""Tables of a frequency response: what each column means, exactly, or a refusal that names it.

A column that may change the plant and is not understood is refused. Two readings that are both
possible (radians under the name of degrees, decibels under that of magnitude) are refused too. Of
universal files dataset 58 is read, ASCII or binary, by pyuff.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ccd_casadi.plants.table_columns import (
    MEGA,
    RATE_WORDS,
    UNITS,
    WANTED,
    TableColumn,
    choices,
    columns_of_arrays,
    columns_of_csv,
    meaning_of,
    npz_arrays,
    rate_order,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError, describe, require
from ccd_casadi.support.json_files import mat_variables

SUFFIXES = (".uff", ".unv", ".uf", ".bunv")


@dataclass(frozen=True)
class DatasetCodes:
    """Codes of dataset 58 (SDRL, University of Cincinnati)."""

    response_function: int = 4  # function type of an FRF
    frequency: int = 18  # specific data type of an abscissa in Hz
    force: int = 13  # that of a force
    SI: int = 1  # code of dataset 164


# by the specific data type of the ordinate: what it is, and units of it over N by label
ORDINATES: Mapping[int, tuple[str, Mapping[str, str]]] = {
    8: ("displacement", {"": "m/N", "m": "m/N", "mm": "mm/N", "um": "um/N", "nm": "nm/N"}),
    11: ("velocity", {"": "m/s/N", "m/s": "m/s/N"}),
    12: ("acceleration", dict.fromkeys(("", "m/s^2", "m/s2", "m/s²", "m/s**2"), "m/s^2/N")),
}  # fmt: skip
FUNCTIONS = {1: "time responses", 2: "auto spectra", 3: "cross spectra", 6: "coherences",
             9: "power spectral densities"}  # fmt: skip


def columns_of_universal(
    path: Path, codes: DatasetCodes = DatasetCodes()
) -> tuple[list[TableColumn], list[str]]:
    """Read the only frequency response of a universal file: f_hz, G with its unit, what is to be
    reported.

    Raises UserError where pyuff is not installed, or the file holds no single response over a force
    that is understood.
    """
    pyuff = require("pyuff", "uff")
    if not path.exists():
        raise UserError(f"{path}: cannot be read: no such file")
    try:
        file = pyuff.UFF(str(path))
        kinds = [int(kind) for kind in file.get_set_types()]
        at = [i for i, kind in enumerate(kinds) if kind == 58]
        sets = [file.read_sets(i) for i in at]
        units = [file.read_sets(i) for i, kind in enumerate(kinds) if kind == 164]
    except Exception as error:  # a damaged file fails anywhere inside the reader
        raise UserError(f"{path}: is not a readable universal file: {describe(error)}") from None
    found = [one for one in sets if int(one["func_type"]) == codes.response_function]
    if len(found) != 1:
        other = [FUNCTIONS.get(int(one["func_type"]), "other functions") for one in sets]
        other += [f"dataset {kind}" for kind in kinds if kind != 58]
        each = [_place(one) for one in found[:4]] or list(dict.fromkeys(other))[:6]
        words = f"holds {len(found)} frequency responses of dataset 58 ({', '.join(each)})"
        raise UserError(f"{path}: {words}; write one a file")
    one, notes = found[0], [_place(found[0])]
    foreign = next((item for item in units if int(item["units_code"]) != codes.SI), None)
    if foreign is not None:
        named = str(foreign.get("units_description", "")).strip() or foreign["units_code"]
        words = f"dataset 164 has the units {named}, and the response may be in these or in SI"
        raise UserError(f"{path}: {words}; write it in SI")
    if int(one["abscissa_spec_data_type"]) != codes.frequency:
        raise UserError(f"{path}: its abscissa is not a frequency; write a response over Hz")
    over, force = int(one["orddenom_spec_data_type"]), _label(one, "orddenom")
    kind, unit = int(one["ordinate_spec_data_type"]), _label(one, "ordinate")
    if over != codes.force or force not in ("", "n"):
        what = force or (f"data type {over}" if over else "what its header does not name")
        words = f"is over {what}, not over a force in N"
        raise UserError(f"{path}: {words}; write it over N")
    if kind not in ORDINATES:
        raise UserError(f"{path}: its data type {kind} is not a displacement, velocity or "
                        "acceleration; write one of them")  # fmt: skip
    name, known = ORDINATES[kind]
    if unit not in known:
        raise UserError(f"{path}: {unit!r} is not understood as a unit of {name}; it may be "
                        f"{', '.join(key for key in known if key)}")  # fmt: skip
    if not unit:
        notes.append(f"{name} in SI, as no unit is named")
    if len(sets) > 1:
        notes.append(f"{len(sets) - 1} other functions are left out")
    G, hz = np.asarray(one["data"], complex), np.asarray(one["x"], float)
    return [TableColumn("f_hz", hz), TableColumn(f"G ({known[unit]})", G)], notes


def _label(one: Mapping[str, Any], of: str) -> str:
    """The unit of an axis in small letters; empty where none is named."""
    text = str(one.get(f"{of}_axis_units_lab") or "").strip().casefold()
    return "" if text == "none" else text


def _place(one: Mapping[str, Any]) -> str:
    """Describe where a response was measured, as its file has it."""
    ends = [f"{one[f'{of}_node']}:{int(one[f'{of}_dir']):+d}" for of in ("rsp", "ref")]
    return f"node and direction {ends[0]} over {ends[1]}"


BESIDE = ("spread", "coherence", "averages")


@dataclass(frozen=True)
class ReadingOptions:
    """Numbers of the test whether the units of magnitude and phase are as stated."""

    few_degrees: float = 30.0  # a phase within ± as many degrees may be in radians
    many_radians: float = 4.0 * np.pi  # a phase beyond ± as many radians may be in degrees
    bode_points: int = 200  # over ln f, at which Bode's gain-phase relation is evaluated
    bode_delays: int = 60  # that are tried with it
    bode_misfit: float = float(np.radians(20.0))  # rad, in the mean: beyond it a reading is doubted
    bode_gain: float = 0.85  # share of the misfit below which another reading is as likely
    end: float = 1.5  # factor of the end lines within which the slope beyond them is read
    confidence: float = 0.95  # of a spread that coherence and averages give


@dataclass(frozen=True)
class ResponseTable:
    """G (k,) or (k, p, m) in m/N at `hz` (k,), the `spread`, and `words`: what was understood."""

    hz: Array
    G: np.ndarray
    spread: Array | None
    words: str


def read_table(path: Path, *, options: ReadingOptions = ReadingOptions()) -> ResponseTable:
    """The response in a file of any kind. Raises UserError that names what is not clear."""
    suffix, notes = path.suffix.lower(), list[str]()
    if suffix == ".npz":
        content = npz_arrays(path)
        if {"a", "b", "c"} <= {name.casefold() for name in content}:
            words = "holds A, B, C of a model, which is read from .mat"
            raise UserError(f"{path}: {words}; write it with scipy.io.savemat")
        columns = columns_of_arrays(path, content)
    elif suffix == ".mat":
        content = mat_variables(path)
        columns = columns_of_arrays(path, lines_in(content) or content)
    elif suffix in SUFFIXES:
        columns, notes = columns_of_universal(path)
    else:
        columns, notes = columns_of_csv(path)
    return _understood(path, columns, notes, options)


def lines_in(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """The variables of a response in a file, or in its only struct, with what is beside that.

    Parameters
    ----------
    content : mapping
        Variables by name.

    Returns
    -------
    mapping
        Empty where no frequency is among them.
    """
    if _has_frequency(content):
        return content
    structs = {name: value for name, value in content.items()
               if getattr(value, "dtype", np.dtype(float)).names}  # fmt: skip
    if len(structs) != 1:
        return {}
    name, struct = next(iter(structs.items()))
    if struct.size != 1 or not _has_frequency(struct.dtype.names):
        return {}
    beside = {key: value for key, value in content.items() if key != name}
    return beside | {key: struct.ravel()[0][key] for key in struct.dtype.names}


def _has_frequency(names: Iterable[str]) -> bool:
    return any((found := meaning_of(name)) and found[0] == "f" for name in names)


def _understood(
    path: Path, columns: Sequence[TableColumn], notes: Sequence[str], options: ReadingOptions
) -> ResponseTable:
    """The response that the columns state."""
    known = dict(_quantities(path, columns))
    if "f" not in known:
        raise UserError(f"{path}: has no column f_hz; give the frequencies that name")
    hz, rows = known["f"][0].values.real.astype(float) * known["f"][1], known["f"][0].rows
    given = known.keys() - {"f", *BESIDE}
    if given not in ({"re", "im"}, {"size", "angle"}, {"G"}, {"G", "angle"}):
        names = ", ".join(known[key][0].name for key in sorted(given)) or "nothing else"
        raise UserError(f"{path}: needs re and im, or magnitude and phase, or G alone: has {names}")
    parts = {key: np.asarray(column.values) for key, (column, _) in known.items()}
    for key in parts.keys() - {"f", "coherence", "averages"}:
        if parts[key].ndim == 1 and parts[key].shape != hz.shape:
            words = f"has {len(parts[key])} values and {known['f'][0].name} {len(hz)}"
            raise UserError(f"{path}: {known[key][0].name}: {words}")
        if key != "G" and np.iscomplexobj(parts[key]):
            raise UserError(f"{path}: {known[key][0].name}: is complex; name it G")
    orders = {rate_order(path, known[key][0].name) for key in given - {"angle"}}
    if len(orders) > 1:
        raise UserError(f"{path}: re and im are of different derivatives; give both of one")
    G: np.ndarray
    if given == {"re", "im"}:
        if known["re"][1] != known["im"][1]:
            raise UserError(f"{path}: re and im have different units; give both in m/N")
        G = (parts["re"] + 1j * parts["im"]) * known["re"][1]
    elif given == {"G"}:
        with np.errstate(invalid="ignore"):  # what is not finite is refused by its line
            G = parts["G"] * known["G"][1]
        if not np.iscomplexobj(G) or not G.imag.any():
            words = f"{known['G'][0].name}: is real, so its phase is missing; give a complex G"
            raise UserError(f"{path}: {words}, or re and im")
    else:
        G = _of_size_and_angle(path, hz, known, options)
    spread = parts.get("spread")
    if spread is not None:
        spread = spread * known["spread"][1]
    if G.ndim == 3:
        if len(G) == len(hz) == G.shape[-1]:
            raise UserError(f"{path}: lines may be the first or the last index of G; drop a line")
        if len(G) != len(hz):  # lines last, as MATLAB has them
            if G.shape[-1] != len(hz):
                words = f"G is {G.shape}, and there are {len(hz)} frequencies"
                raise UserError(f"{path}: {words}; give G (lines, outputs, inputs)")
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
    order = orders.pop()
    if order:
        rate = ((2j * np.pi * hz) ** order).reshape(-1, *[1] * (G.ndim - 1))
        G, spread = G / rate, spread if spread is None else spread / np.abs(rate)
        notes = [*notes, RATE_WORDS[order]]
    left = [f"{known[key][0].name} is left out" for key in BESIDE[1:] if key in known]
    if spread is None and {"coherence", "averages"} <= known.keys() and G.ndim == 1:
        spread = _of_coherence(path, G, parts["coherence"][kept], parts["averages"], options)
        left = [f"spread of {100.0 * options.confidence:g} % by coherence and averages"]
    names = ", ".join(known[key][0].name for key in known if key not in BESIDE[1:])
    span = f"{len(hz)} lines from {hz[0]:.4g} to {hz[-1]:.4g} Hz" if len(hz) else "no line"
    return ResponseTable(hz, G, spread, "; ".join([f"{span} of {names}", *notes, *left]))


def _of_coherence(
    path: Path, G: np.ndarray, coherence: Array, averages: Array, options: ReadingOptions
) -> Array:
    """The spread |G| sqrt(ln(1/(1 - P)) (1 - γ²)/(γ² n)) of coherence γ² and n averages (Bendat and
    Piersol, Random Data, 4th ed., 2010, section 9.2): Ĝ lies within it with the probability P."""
    count = float(np.min(averages))
    inside = (coherence > 0.0) & (coherence <= 1.0)
    if not (count >= 1.0 and inside.all()):
        words = "coherence has to be in 0 to 1 and averages 1 or more"
        raise UserError(f"{path}: {words}; correct them or drop one")
    wide = np.log(1.0 / (1.0 - options.confidence)) * (1.0 - coherence) / (coherence * count)
    return np.asarray(np.abs(G) * np.sqrt(wide))


def _quantities(
    path: Path, columns: Sequence[TableColumn]
) -> Iterator[tuple[str, tuple[TableColumn, float]]]:
    """Yield each quantity with its column and the factor to SI; -1 of decibels."""
    seen: dict[str, str] = {}
    for column in columns:
        found = meaning_of(column.name)
        if found is None:
            words = "is not understood and may change the plant; drop it, or name"
            raise UserError(f"{path}: {column.name!r}: {words} {WANTED}")
        quantity, unit = found
        if quantity == "size" and np.iscomplexobj(column.values):
            quantity = "G"
        if quantity in seen:
            first = seen[quantity]
            words = f"column {first!r} is there twice" if first == column.name else (
                f"{first!r} and {column.name!r} are the same quantity")  # fmt: skip
            raise UserError(f"{path}: {words}; keep one")
        seen[quantity] = column.name
        if MEGA.search(column.name):
            words = f"is in megametres as it is written; it may be {choices(quantity)}"
            raise UserError(f"{path}: {column.name!r}: {words}")
        if unit not in UNITS[quantity]:
            words = f"has the unit {unit!r}" if unit else "names no unit"
            raise UserError(f"{path}: {column.name!r}: {words}; it may be {choices(quantity)}")
        yield quantity, (column, UNITS[quantity][unit])


def _of_size_and_angle(
    path: Path, hz: Array, known: Mapping[str, tuple[TableColumn, float]], options: ReadingOptions
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
    own = _bode_misfit(hz, named, angle * to_rad, options)
    turned_other = _bode_misfit(hz, named, angle * (1.0 if degrees else np.pi / 180.0), options)
    clear = own < options.bode_misfit and turned_other > own / options.bode_gain
    few, many = options.few_degrees, options.many_radians
    odd = 0.0 < largest <= few if degrees else largest > many and not clear
    if odd or (own > options.bode_misfit and turned_other < options.bode_gain * own):
        words = f"is {largest:.4g} at most: {'radians' if degrees else 'degrees'} may be meant"
        raise UserError(f"{path}: {turned.name}: {words}; give re and im, or name it "
                        f"{'phase_rad' if degrees else 'phase_deg'}")  # fmt: skip
    if (
        factor > 0.0
        and own > options.bode_misfit
        and _bode_misfit(hz, decibels, angle * to_rad, options) < options.bode_gain * own
    ):
        words = "decibels may be meant, with which phase and slope agree"
        raise UserError(f"{path}: {sized.name}: {words}; name it magnitude_db, or give re and im")
    return np.asarray(named * np.exp(1j * angle * to_rad))


def least_phase(y: Array, x: Array, at: Array, *, end: float = ReadingOptions.end) -> Array:
    """Phase of the stable minimum-phase G of a size, by Bode's integral over its slope.

    Parameters
    ----------
    y, x : array (k,)
        ln|G| at rising ln f, straight between them; beyond the ends it goes on as on average within
        a factor `end` of them.
    at : array (n,)
        ln f where the phase is wanted.
    end : float

    Returns
    -------
    array (n,)
        rad.
    """
    low = max(3, int(np.searchsorted(x, x[0] + np.log(end))))
    high = min(len(x) - 3, int(np.searchsorted(x, x[-1] - np.log(end))))
    ends = [np.polyfit(x[part], y[part], 1)[0] for part in (slice(low), slice(high, None))]
    slope = np.concatenate([ends[:1], np.diff(y) / np.diff(x), ends[1:]])
    v = x - at[:, None]
    a = np.exp(-np.abs(v))  # ∫ ln coth|v/2| dv is π²/4 less Legendre's χ₂, twice
    inside = np.sign(v) * (0.25 * np.pi**2 + scipy.special.spence(1.0 + a)
                           - scipy.special.spence(1.0 - a))  # fmt: skip
    most = np.full((len(at), 1), 0.25 * np.pi**2)
    return np.asarray(np.diff(np.hstack([-most, inside, most]), axis=1) @ slope / np.pi)


def _bode_misfit(hz: Array, size: Array, angle: Array, options: ReadingOptions) -> float:
    """Mean |φ - φ₀| (rad) over ln f, φ₀ = `least_phase`, for either sign of G and behind the delay
    that fits best."""
    good = (hz > 0.0) & (size > 0.0)
    x, y = np.log(hz[good]), np.log(size[good])
    if len(x) < 5 or not (np.diff(x) > 0.0).all():
        return 0.0
    places = np.linspace(x[0], x[-1], options.bode_points)
    off = np.interp(places, x, np.unwrap(angle[good])) - least_phase(y, x, places)
    delays = np.append(0.0, np.geomspace(0.1, 100.0, options.bode_delays))[:, None]
    lag = delays * np.exp(places - places[-1])
    apart = np.abs(np.angle(np.exp(1j * (off + lag)))).mean(axis=1)
    opposite = np.abs(np.angle(-np.exp(1j * (off + lag)))).mean(axis=1)
    return float(np.minimum(apart, opposite).min())
