"""Drives as data files: blocks, parameters in the drive's words and units, limits and steps; and
their filters by these parameters: response, slopes, and coefficients of the difference equation.

A filter is a product of factors over another one, each of a frequency f, of second order with a
damping D or of first order without one:

    q = 1 + 2 D u x + (u x)²,   r = 1 + u x

    bilinear    x = (1 - 1/z)/(1 + 1/z),  u = 1/(π f T)
    prewarped   the same x,               u = 1/tan(π f T): exact at f
    backward    x = 1 - 1/z,              u = 1/(2π f T)
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text

Factor = tuple[str, ...]  # names of f and D, or of f alone


class Rule(StrEnum):
    """The rule by which a drive makes a difference equation of a filter."""

    BILINEAR = "bilinear"
    PREWARPED = "prewarped"
    BACKWARD = "backward"


class Number(StrEnum):
    """The numbers that a drive's filters compute with."""

    DOUBLE = "double"
    SINGLE = "single"
    FIXED_30 = "fixed30"


@dataclass(frozen=True)
class Form:
    """A filter's factors above and below the line, by names of their parameters."""

    above: tuple[Factor, ...]
    below: tuple[Factor, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, each once."""
        return tuple(dict.fromkeys(name for part in (*self.above, *self.below) for name in part))


FORMS = {
    "general": Form((("f_Z", "D_Z"),), (("f_N", "D_N"),)),
    "notch": Form((("f", "D_Z"),), (("f", "D_N"),)),
    "pt2": Form((), (("f", "D"),)),
    "pt1": Form((), (("f",),)),
    "lead_lag": Form((("f_Z",),), (("f_N",),)),
}


@dataclass(frozen=True)
class Filter:
    """One filter of a drive."""

    form: Form
    rule: Rule
    number: Number
    period: float  # T, s
    of_fixed: ClassVar[float] = 2.0**30  # that many steps in one
    largest_fixed: ClassVar[float] = 2.0  # 32 bits with a sign

    def response(self, values: dict[str, float], z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F (k,) on the unit circle and ∂ln F/∂ln p (n, k), p in the order of the form."""
        x = 1.0 - 1.0 / z
        if self.rule is not Rule.BACKWARD:
            x = x / (1.0 + 1.0 / z)
        F, slopes = np.ones(len(z), complex), np.zeros((len(self.form.names), len(z)), complex)
        for sign, factors in ((1, self.form.above), (-1, self.form.below)):
            for f, *damping in factors:
                u, steep = self._scale(values[f])
                v, D = u * x, values[damping[0]] if damping else 0.0
                part = 1.0 + 2.0 * D * v + v * v if damping else 1.0 + v
                F = F * part if sign > 0 else F / part
                by_f = (2.0 * D * v + 2.0 * v * v if damping else v) / part
                slopes[self.form.names.index(f)] += sign * steep * by_f
                if damping:
                    slopes[self.form.names.index(damping[0])] += sign * 2.0 * D * v / part
        return F, slopes

    def _scale(self, f: float) -> tuple[float, float]:
        """u of a frequency in Hz, and d ln u/d ln f."""
        turn = np.pi * f * self.period
        if self.rule is Rule.BILINEAR:
            return 1.0 / turn, -1.0
        if self.rule is Rule.BACKWARD:
            return 0.5 / turn, -1.0
        return 1.0 / np.tan(turn), -2.0 * turn / np.sin(2.0 * turn)

    def coefficients(self, values: dict[str, float]) -> tuple[Array, Array]:
        """b (3,) and a (3,) of powers of 1/z, a_0 = 1, rounded to the drive's numbers:
        y_k = b_0 u_k + b_1 u_{k-1} + b_2 u_{k-2} - a_1 y_{k-1} - a_2 y_{k-2}."""
        b, a = (self._product(values, part) for part in (self.form.above, self.form.below))
        order = max(len(b), len(a))
        if self.rule is not Rule.BACKWARD:
            b, a = (np.convolve(p, np.poly(-np.ones(order - len(p)))) for p in (b, a))
        b, a = (np.pad(p, (0, 3 - len(p))) for p in (b, a))
        return self._round(b / a[0]), self._round(a / a[0])

    def _product(self, values: dict[str, float], factors: tuple[Factor, ...]) -> Array:
        found = np.ones(1)
        for f, *damping in factors:
            u = self._scale(values[f])[0]
            away = np.array([1.0, -1.0])  # 1 - 1/z
            whole = np.array([1.0, 0.0 if self.rule is Rule.BACKWARD else 1.0])
            part = whole + u * away
            if damping:
                D = values[damping[0]]
                part = np.convolve(whole, whole) + 2.0 * D * u * np.convolve(whole, away)
                part = part + u * u * np.convolve(away, away)
            found = np.convolve(found, part)
        return np.asarray(found)

    def _round(self, c: Array) -> Array:
        if self.number is Number.SINGLE:
            return np.asarray(c.astype(np.float32), float)
        if self.number is Number.FIXED_30:
            return np.asarray(np.rint(c * self.of_fixed) / self.of_fixed)
        return c

    def fits(self, values: dict[str, float]) -> bool:
        """Whether the drive's numbers hold every coefficient."""
        b, a = self.coefficients(values)
        most = self.largest_fixed if self.number is Number.FIXED_30 else np.inf
        return bool(max(np.abs(b).max(), np.abs(a).max()) < most)


@dataclass(frozen=True)
class Setting:
    """A parameter as the drive has it."""

    name: str  # in the drive's words
    step: float  # of its grid, in its unit
    least: float  # in its unit
    most: float  # in its unit
    unit: str = ""  # in the drive's words
    number: str = ""  # empty where no stored manual has it
    per_si: float = 1.0  # its value per SI (1/s, N s/m, s, Hz)
    rotary: str = ""  # its unit where a rotary motor counts (N m s/rad, kg m²): `behind_screw`

    def round_value(self, value: float, by: int = 0) -> float:
        """The nearest grid value in SI, `by` steps beside it, within the limits."""
        at = round(value * self.per_si / self.step) + by
        first, last = -(-self.least // self.step), self.most // self.step
        return self.format_steps(min(max(at, first), last)) / self.per_si

    def format_steps(self, steps: float) -> float:
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
    """The settings that a drive accepts."""

    title: str
    loop: str  # "cascade": P position over PI velocity
    rule: Rule  # of its filters
    number: Number  # of its filters
    position: Setting  # Kv, 1/s
    velocity: Setting  # gain, N s/m
    integral: Setting  # action time, s
    slots: tuple[Slot, ...]  # filters, in the order in which they are used
    sources: tuple[str, ...]  # what manuals say
    chosen: tuple[str, ...]  # what is this file's choice
    unknown: tuple[str, ...]  # what no manual was found for
    speed_feedforward: Setting | None = None  # of the setpoint's velocity, 1: all of it
    force_feedforward: Setting | None = None  # of its acceleration, kg
    current: Setting | None = None  # gain of the current controller, V/A
    current_integral: Setting | None = None  # its integral time, s
    travel: float | None = None  # of the axis by a turn of a rotary motor, m/rad

    def places(self, place: str) -> tuple[Slot, ...]:
        """Return its filters at a place."""
        return tuple(slot for slot in self.slots if slot.place == place)

    def behind_screw(self, travel: float) -> "Drive":
        """The drive of a rotary motor that moves the axis by `travel` m per rad: with T = F travel
        and v = ω travel a gain of x N s/m is x travel² N m s/rad, and a mass an inertia alike."""
        turned = {
            name: replace(own, unit=own.rotary, per_si=own.per_si * travel**2)
            for name in ("velocity", "force_feedforward")
            if (own := getattr(self, name)) is not None
        }
        if not all(own.unit for own in turned.values()):
            raise UserError(f"{self.title} has no units of a rotary motor; drop lead_mm")
        return replace(self, travel=travel, **turned)


PLACES = ("current", "setpoint")


def read_drive(name: str, folder: Path = Path()) -> Drive:
    """Read a drive that ships with the package, or the path of a file, relative to `folder`."""
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
    for key in ("speed_feedforward", "force_feedforward", "current", "current_integral"):
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
