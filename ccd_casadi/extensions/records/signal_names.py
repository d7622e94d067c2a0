"""What the names of a log's columns mean: time, excitation, force, position, and their units."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from ccd_casadi.support.errors import UserError

ROLES: Mapping[str, tuple[str, ...]] = {
    "time": ("t", "time", "timestamp", "seconds"),
    "excitation": (
        "injected", "injection", "inject", "excitation", "excitation force", "disturbance", "noise",
        "reference", "ref", "setpoint", "r", "noiseout", "sweep", "chirp",
    ),
    "force": (
        "force", "force command", "command", "control", "u", "torque", "torque command", "thrust",
        "servoout", "controller output", "input", "voltage",
    ),
    "position": (
        "position", "pos", "y", "displacement", "encoder", "actual position", "actpos", "angle",
        "output", "x",
    ),
}  # fmt: skip
OPTIONS = {"time": "--time", "excitation": "--injected or --reference", "force": "--force",
           "position": "--position"}  # fmt: skip
REFERENCES = ("reference", "ref", "setpoint")
UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "force": {"n": 1.0, "mn": 1e-3, "kn": 1e3, "n m": 1.0, "nm": 1.0, "n*m": 1.0, "v": 1.0},
    "position": {
        "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9, "rad": 1.0, "mrad": 1e-3,
        "urad": 1e-6, "µrad": 1e-6,
    },
}  # fmt: skip
SI = {"time": "s", "force": "N", "position": "m"}


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


def column_of(path: Path, role: str, names: Iterable[str], stated: str | None) -> str | None:
    """Find the column of a role of ROLES among all names; None where no column has a name of it.

    `stated` is by an option. Raises UserError where that column is not there, or two may be meant.
    """
    names = list(names)
    if stated is not None:
        exact = [name for name in names if stated in (name, split_unit(name)[0])]
        if len(exact) != 1:
            words = "is there more than once" if exact else "is not there"
            raise UserError(f"{path}: column {stated!r} {words}; it has {', '.join(names)}")
        return exact[0]
    found = [name for name in names if split_unit(name)[0] in ROLES[role]]
    if len(found) > 1:
        both = " or ".join(repr(name) for name in found)
        raise UserError(f"{path}: the {role} may be {both}; state which with {OPTIONS[role]}")
    return found[0] if found else None


def factor_of(path: Path, role: str, name: str) -> tuple[float, str]:
    """Find the factor of a column to SI by the unit in its name, and that unit in words, such as
    "m, as no unit is named". Raises UserError where it is not a unit of the role.
    """
    unit = split_unit(name)[1]
    if unit in ("", "-", "1"):
        return 1.0, f"{SI[role]}, as no unit is named"
    known = UNITS[role]
    if unit not in known:
        raise UserError(f"{path}: {name!r}: the unit {unit!r} is not one of a {role}; it may be "
                        f"{', '.join(known)}")  # fmt: skip
    written = re.search(re.escape(unit), name, re.IGNORECASE)
    return known[unit], written[0] if written else unit
