"""Drives as data files: blocks, parameters in the drive's words and units, limits and steps."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ccd_casadi.extensions.drives.forms import FORMS, Number, Rule
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text


@dataclass(frozen=True)
class Setting:
    """A parameter as the drive has it.

    Attributes
    ----------
    name, number, unit : str
        In the drive's words; the number is empty where no stored manual has it.
    per_si : float
        Its value per SI (1/s, N s/m, s, Hz).
    step : float
        Of its grid, in its unit.
    least, most : float
        In its unit.
    """

    name: str
    step: float
    least: float
    most: float
    unit: str = ""
    number: str = ""
    per_si: float = 1.0

    def rounded(self, value: float, by: int = 0) -> float:
        """The nearest grid value in SI, `by` steps beside it, within the limits."""
        at = round(value * self.per_si / self.step) + by
        first, last = -(-self.least // self.step), self.most // self.step
        return self.shown(min(max(at, first), last)) / self.per_si

    def shown(self, steps: float) -> float:
        """A number of steps in the drive's unit, as its decimals have it."""
        return float(f"{steps * self.step:.12g}")

    @property
    def range(self) -> tuple[float, float]:
        """The limits in SI, the lower one above zero."""
        return max(self.least, self.step) / self.per_si, self.most / self.per_si


@dataclass(frozen=True)
class Slot:
    """A place for a filter: on the `current` command or on the speed `setpoint`."""

    place: str
    form: str
    name: str
    settings: Mapping[str, Setting]


@dataclass(frozen=True)
class Drive:
    """What a drive accepts.

    Attributes
    ----------
    title : str
    loop : str
        "cascade": P position over PI velocity.
    rule, number : Rule, Number
        Of its filters.
    position, velocity, integral : Setting
        Kv in 1/s, velocity gain in N s/m, integral action time in s.
    slots : tuple of Slot
        Filters, in the order in which they are used.
    speed_feedforward, force_feedforward : Setting or None
        Of the setpoint's velocity, 1 for all of it, and of its acceleration, kg.
    sources, chosen, unknown : tuple of str
        What manuals say, what is this file's choice, and what no manual was found for.
    """

    title: str
    loop: str
    rule: Rule
    number: Number
    position: Setting
    velocity: Setting
    integral: Setting
    slots: tuple[Slot, ...]
    sources: tuple[str, ...]
    chosen: tuple[str, ...]
    unknown: tuple[str, ...]
    speed_feedforward: Setting | None = None
    force_feedforward: Setting | None = None

    def places(self, place: str) -> tuple[Slot, ...]:
        """Its filters at a place."""
        return tuple(slot for slot in self.slots if slot.place == place)


PLACES = ("current", "setpoint")


def read_drive(name: str, folder: Path = Path()) -> Drive:
    """Read a drive's data file.

    Parameters
    ----------
    name : str
        One that ships with the package, or the path of a file, relative to `folder`.
    folder : Path

    Returns
    -------
    Drive

    Raises
    ------
    UserError
        There is none, or what is wrong in it.
    """
    path = folder / name
    try:
        if name.endswith(".toml"):
            text = path.read_text("utf-8")
        else:
            text = package_text(f"extensions/drives/data/{name}.toml")
    except (OSError, UnicodeDecodeError):
        there = ", ".join(known_drives())
        raise UserError(f"drive {name!r} is not there; give one of {there}, or a file") from None
    try:
        return _drive(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"drive {name}: is not valid TOML: {error}; correct that line") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"drive {name}: {error}; compare generic.toml") from None


def known_drives() -> list[str]:
    """Names of the files that ship with the package."""
    return sorted(path.stem for path in (Path(__file__).parent / "data").glob("*.toml"))


def _drive(data: dict[str, Any]) -> Drive:
    unknown = set(data) - {field.name for field in fields(Drive)} - {"filter"}
    if unknown:
        raise ValueError(f"unknown key {min(unknown)}")
    slots = [slot for entry in data.pop("filter", []) for slot in _slots(dict(entry))]
    own: dict[str, Any] = {key: tuple(data.pop(key, ()))
                           for key in ("sources", "chosen", "unknown")}  # fmt: skip
    for key in ("position", "velocity", "integral"):
        own[key] = _setting(key, data.pop(key))
    for key in ("speed_feedforward", "force_feedforward"):
        own[key] = _setting(key, data.pop(key)) if key in data else None
    rule, number = Rule(data.pop("rule")), Number(data.pop("number"))
    if data["loop"] not in ("cascade", "pid"):
        raise ValueError('loop is neither "cascade" nor "pid"')
    return Drive(rule=rule, number=number, slots=tuple(slots), **own, **data)


def _slots(entry: dict[str, Any]) -> list[Slot]:
    place, form, count = entry.pop("place"), entry.pop("form"), entry.pop("count", 1)
    names, numbers = entry.pop("name"), entry.pop("numbers", [])
    if place not in PLACES or form not in FORMS:
        raise ValueError(f"filter {names!r} has no place or form that is known")
    if set(entry) != set(FORMS[form].names):
        raise ValueError(f"filter {names!r} needs {', '.join(FORMS[form].names)}")
    found = []
    for i in range(count):
        title, own = names.format(i + 1), numbers[i] if i < len(numbers) else {}
        settings = {}
        for key in FORMS[form].names:
            setting = {**entry[key], "name": f"{title}, {entry[key]['name']}"}
            settings[key] = _setting(key, {**setting, "number": own.get(key, "")})
        found.append(Slot(place, form, title, settings))
    return found


def _setting(key: str, entry: Mapping[str, Any]) -> Setting:
    found = Setting(**entry)
    if not (found.step > 0.0 and 0.0 <= found.least < found.most and found.per_si > 0.0):
        raise ValueError(f"{key}: step, least, most or per_si is out of order")
    return found
