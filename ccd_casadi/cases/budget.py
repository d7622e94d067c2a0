"""[budget] and [places] of a case file, checked, in SI."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.budget.sources import (
    ErrorBudget,
    ErrorSource,
    ShapedSpectrum,
    SourceKind,
    TabulatedSpectrum,
)
from ccd_casadi.cases import checks
from ccd_casadi.cases.checks import Fail, several, short_repr
from ccd_casadi.cases.tables import BudgetTable, Parameter, PlacesTable
from ccd_casadi.plants.nodes import names_in
from ccd_casadi.plants.places import Places


def check_places(table: PlacesTable, folder: Path, fail: Fail) -> PlacesTable:
    """The table with its nodes as numbers, so that a run's own case needs no other file."""
    if table == PlacesTable():
        return table
    for name in ("nodes", "actuators"):
        if not getattr(table, name):
            raise fail(f"places.{name}", "is missing; add it")
    if table.axes and not table.sensors:
        raise fail("places.sensors", "is missing, and axes are of forces and sensors; add it")
    if (table.quiet or table.damped) and not table.axes:
        raise fail("places.axes", "is false, and quiet and damped modes are of axes; give true")
    if table.reference and (table.axes or not table.sensors):
        raise fail("places.reference", "needs sensors, and has no place beside axes; drop one")
    rows = table.nodes
    if isinstance(rows, str):
        try:
            text = (folder / rows).read_text(encoding="utf-8-sig")
            rows = tuple(tuple(map(float, row)) for row in list(csv.reader(text.splitlines()))[1:])
        except (OSError, ValueError, csv.Error) as error:
            words = f"{short_repr(table.nodes)}: {error}; name a CSV file of numbers after a header"
            raise fail("places.nodes", words) from None
    numbers = tuple(tuple(map(float, row)) for row in rows)
    if not numbers or len({len(row) for row in numbers}) != 1 or len(numbers[0]) not in (1, 2, 3):
        raise fail("places.nodes", "are not rows of as many coordinates, 1 to 3; correct them")
    return replace(table, nodes=numbers)


def check_directions(table: PlacesTable, several_plants: bool, fail: Fail) -> None:
    """Raise where directions that follow modes would differ from plant to plant of a set."""
    for name in ("quiet", "damped") if several_plants else ():
        if getattr(table, name):
            words = "gives each plant of robust.plants, and of a parameter that varies, directions "
            words += "of its own, which no controller can follow; drop it, or these plants"
            raise fail(f"places.{name}", words)


def check_present(table: PlacesTable, theta: Sequence[Parameter], fail: Fail) -> None:
    """Raise where an actuator could be there in part, or shares its parameter with another."""
    for name in table.present:
        if table.present.count(name) > 1:
            raise fail("places.present", f"has {name} twice; give each actuator its own")
        values = next(p.values for p in theta if p.name == name)
        if not values or not {0.0, 1.0}.issuperset(values):
            words = "may be other than 0 and 1, and no part of an actuator can be built"
            raise fail(f"theta.{name}", f"{words}; give values = [0, 1], or fixed")


def names_of(table: PlacesTable) -> tuple[str, ...]:
    """The parameters that its coordinates name."""
    return names_in((*table.actuators, *table.sensors, table.present))


def places_of(table: PlacesTable) -> Places | None:
    """Return the places of a table as plain values; None where the case has none."""
    if table == PlacesTable():
        return None
    values = {item.name: getattr(table, item.name) for item in fields(Places)}
    for name in ("actuators", "sensors", "reference"):
        values[name] = tuple(map(tuple, values[name]))
    return Places(**values)


# Unit -> factor of a density to SI, and whether the number is its square root.
_POSITION = {"m^2/Hz": (1.0, False), "m/rtHz": (1.0, True), "nm/rtHz": (1e-9, True)}
_ACCELERATION = {"(m/s^2)^2/Hz": (1.0, False), "m/s^2/rtHz": (1.0, True)}
UNITS: dict[SourceKind, dict[str, tuple[float, bool]]] = {
    SourceKind.FORCE: {"N^2/Hz": (1.0, False), "N/rtHz": (1.0, True)},
    SourceKind.FLOOR_MOTION: _POSITION | _ACCELERATION,
    SourceKind.SENSOR_NOISE: _POSITION,
    SourceKind.SETPOINT: _POSITION,
}
PATH = ("mass", "damping", "stiffness")


_CORNER = checks.KeyCheck(
    lambda value: "too many" if len(several(value)) > 2 else checks.one_or_more(value),
    {"type": ["number", "array"]},
)
CORNERS = checks.every(_CORNER, "give a list of Hz, or of [Hz, damping ratio], all above 0")
TABLE_CHECKS: dict[str, checks.KeyCheck] = {
    "name": checks.text,
    "unit": checks.text,
    "level": checks.POSITIVE,
    "zeros_hz": CORNERS,
    "poles_hz": CORNERS,
    "psd": checks.rows(2),
    "file": checks.text,
    **dict.fromkeys(PATH, checks.NOT_NEGATIVE),
}


def check_budget(table: BudgetTable, folder: Path, fail: Fail) -> BudgetTable:
    """The table with every entry checked and the files of spectra read into `psd`."""
    found: dict[str, tuple[Mapping[str, Any], ...]] = {}
    for kind in SourceKind:
        given, entries = several(getattr(table, kind.value)), []
        for i, entry in enumerate(given, 1):
            place = f"budget.{kind.value}" + (f" {i}" if len(given) > 1 else "")
            entries.append(_check(entry, kind, place, folder, fail))
        found[kind.value] = tuple(entries)
    if table.window_ms is not None and not any(found.values()):
        words = "has no spectrum to go with; add [budget.force] or another"
        raise fail("budget.window_ms", words)
    return replace(table, **found)  # type: ignore[arg-type]


def error_budget(table: BudgetTable) -> ErrorBudget | None:
    """The sources in SI; None for a case without any."""
    sources = tuple(
        _source(entry, kind) for kind in SourceKind for entry in getattr(table, kind.value)
    )
    if not sources:
        return None
    return ErrorBudget(sources, None if table.window_ms is None else 1e-3 * table.window_ms)


def _check(
    entry: Mapping[str, Any], kind: SourceKind, place: str, folder: Path, fail: Fail
) -> Mapping[str, Any]:
    still = kind is not SourceKind.FLOOR_MOTION
    known = {key: one for key, one in TABLE_CHECKS.items() if not (still and key in PATH)}
    checks.require_good(place, entry, known, fail)
    if entry.get("unit") not in UNITS[kind]:
        choices = ", ".join(f'"{unit}"' for unit in UNITS[kind])
        raise fail(f"{place}.unit", f"is {short_repr(entry.get('unit'))}; choose one of {choices}")
    ways = [key for key in ("level", "psd", "file") if key in entry]
    if len(ways) != 1:
        raise fail(place, "give one of level, psd and file, and not more")
    for key in ("zeros_hz", "poles_hz"):
        if key in entry and ways != ["level"]:
            raise fail(f"{place}.{key}", "goes with level only; drop it")
    entry = dict(entry)
    if "file" in entry:
        entry["psd"] = _read(folder / entry.pop("file"), place, fail)
    try:
        _source(entry, kind)
    except ValueError as error:
        raise fail(place, str(error)) from None
    return entry


def _source(entry: Mapping[str, Any], kind: SourceKind) -> ErrorSource:
    factor, amplitude = UNITS[kind][entry["unit"]]
    power = 2 if amplitude else 1
    spectrum: ShapedSpectrum | TabulatedSpectrum
    if "psd" in entry:
        table = np.array(entry["psd"], float).reshape(-1, 2)
        density = (factor * table[:, 1]) ** power
        if amplitude and (table[:, 1] <= 0.0).any():
            density = np.zeros(len(table))  # a square would hide the sign; refused below
        spectrum = TabulatedSpectrum(tuple(table[:, 0].tolist()), tuple(density.tolist()))
    else:
        spectrum = ShapedSpectrum(
            (factor * float(entry["level"])) ** power,
            _pairs(entry.get("zeros_hz", ())),
            _pairs(entry.get("poles_hz", ())),
        )
    m, c, k = (float(entry.get(name, 0.0)) for name in PATH)
    name = entry.get("name", kind.value.replace("_", " "))
    return ErrorSource(name, kind, spectrum, (m, c, k), entry["unit"] in _ACCELERATION)


def _pairs(value: Any) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, several(item))) for item in value)


def _read(path: Path, place: str, fail: Fail, *, most_rows: int = 20_000) -> list[list[float]]:
    """Rows of Hz and density: two columns of numbers, after lines that start with a letter or #."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise fail(f"{place}.file", f"{short_repr(path.name)} cannot be read: {reason}") from None
    found: list[list[float]] = []
    for i, line in enumerate((re.split(r"[,;\t]", one.split("#")[0].strip()) for one in lines), 1):
        if line == [""] or (not found and line[0].strip()[:1].isalpha()):
            continue
        try:
            hz, density = map(float, line)
        except ValueError:
            words = f"line {i} of {short_repr(path.name)} is not a pair Hz, density; correct it"
            raise fail(f"{place}.file", words) from None
        found.append([hz, density])
    if len(found) > most_rows:
        raise fail(f"{place}.file", f"has more than {most_rows} rows; thin it out")
    return found
