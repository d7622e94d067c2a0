"""Records of a loop: excitation, force and position over time, found by the names of columns."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ccd_casadi.extensions.records.log_files import UNITS, Columns, read_columns, split_unit
from ccd_casadi.support.arrays import Array
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
SI = {"time": "s", "force": "N", "position": "m"}


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


@dataclass(frozen=True)
class SamplingOptions:
    """Numbers of the test whether a record is sampled evenly."""

    jitter: float = 1e-3  # deviation of a step over the period, up to which it is not named
    refused: float = 0.05  # that from which the record is refused


@dataclass(frozen=True)
class SignalNames:
    """Columns that the user states; None: found by their names.

    Attributes
    ----------
    injected, reference, force, position, time : str or None
        Of the excitation one of the first two.
    rate_hz : float or None
        Where no column holds the time.
    open_loop : bool
        The force is the excitation.
    add_injected : bool
        The force of the file is the controller's alone, and the plant's is that plus the injected.
    """

    injected: str | None = None
    reference: str | None = None
    force: str | None = None
    position: str | None = None
    time: str | None = None
    rate_hz: float | None = None
    open_loop: bool = False
    add_injected: bool = False


@dataclass(frozen=True)
class TimeSeries:
    """A record of one axis; SI."""

    period: float  # s, from sample to sample
    excitation: Array  # (n,) in open loop the force
    force: Array  # (n,)
    position: Array  # (n,)
    injected: bool = True  # whether the excitation is added to the controller's force
    words: str = ""  # how the file was understood


def read_record(path: Path, names: SignalNames = SignalNames()) -> TimeSeries:
    """Read a record from CSV, .npz, .mat or WAV.

    Raises UserError where a column is missing or may be one of two, a unit is not known, or samples
    are missing.
    """
    columns, rate, notes = read_columns(path)
    if names.injected and names.reference:
        raise UserError("give --injected or --reference: one of them is the excitation")
    period, timing = _period(path, columns, names, rate)
    force, position = (_column(path, columns, role, getattr(names, role))
                       for role in ("force", "position"))  # fmt: skip
    stated = names.injected or names.reference
    if names.open_loop:
        if stated:
            raise UserError("--open-loop: the force is the excitation; drop the other option")
        excitation: str | None = force
    else:
        excitation = column_of(path, "excitation", columns, stated)
    if excitation is None:
        raise UserError(
            f"{path}: no column is an excitation, and {force!r} over {position!r} is the plant in "
            "open loop alone, in closed loop it is not; state --open-loop, or the column with "
            "--injected or --reference"
        )
    if len({force, position, excitation}) < (2 if names.open_loop else 3):
        raise UserError(f"{path}: two signals are the same column; state three")
    injected = not names.open_loop and (
        names.injected is not None
        or (names.reference is None and split_unit(excitation)[0] not in REFERENCES)
    )
    scaled, units = [], []
    for role, name in (("position", position), ("force", force)):
        factor, unit = factor_of(path, role, name)
        scaled.append(factor * columns[name])
        units.append(f"{role} {name!r} in {unit}")
    if names.open_loop:
        loop, drive = "open loop", scaled[1]
    else:
        role = "force" if injected else "position"
        factor, unit = factor_of(path, role, excitation)
        drive = factor * columns[excitation]
        kind = "injected force" if injected else "reference"
        loop = f"closed loop, {kind} {excitation!r} in {unit}"
    if names.add_injected and not injected:
        raise UserError("--add-injected: no force is injected; drop it or state --injected")
    if names.add_injected:
        scaled[1] = scaled[1] + drive
        units[1] += " plus what is injected"
    words = "; ".join([f"{len(drive)} samples at {1.0 / period:.6g} Hz", loop, *reversed(units),
                       *timing, *notes])  # fmt: skip
    return TimeSeries(period, drive, scaled[1], scaled[0], injected, words)


def _column(path: Path, columns: Columns, role: str, stated: str | None) -> str:
    found = column_of(path, role, columns, stated)
    if found is None:
        raise UserError(
            f"{path}: no column is a {role} by its name; state it with --{role}: it has "
            f"{', '.join(columns)}"
        )
    return found


def _period(
    path: Path, columns: Columns, names: SignalNames, rate: float | None,
    options: SamplingOptions = SamplingOptions(),
) -> tuple[float, list[str]]:  # fmt: skip
    """Period in s, and what is to be reported of it."""
    name = column_of(path, "time", columns, names.time)
    if name is None:
        stated = names.rate_hz or rate
        if stated is None:
            raise UserError(f"{path}: no column is the time; name it t, or state --rate-hz")
        return 1.0 / stated, []
    factor, _ = factor_of(path, "time", name)
    t = factor * columns[name]
    steps = np.diff(t)
    if len(steps) < 2 or not (steps > 0.0).all():
        row = int(np.argmax(steps <= 0.0)) + 2 if len(steps) else 1
        raise UserError(f"{path}: {name}: does not rise at sample {row}; give each sample once")
    period = float(np.median(steps))
    whole = np.round(steps / period)
    gaps = np.flatnonzero(whole > 1.0)
    if len(gaps):
        lost, where = int((whole[gaps] - 1.0).sum()), t[gaps[0]]
        raise UserError(f"{path}: {lost} samples are missing, the first after {where:.6g} s; give "
                        "the part of the record between gaps")  # fmt: skip
    period = float(t[-1] - t[0]) / len(steps)
    off = float(np.abs(steps / period - 1.0).max())
    if off > options.refused:
        at = t[int(np.abs(steps / period - 1.0).argmax())]
        raise UserError(f"{path}: a step of {name} is {100.0 * off:.3g} % off the period, the "
                        f"largest at {at:.6g} s; sample evenly")  # fmt: skip
    if names.rate_hz and abs(names.rate_hz * period - 1.0) > options.jitter:
        raise UserError(f"{path}: {name} has {1.0 / period:.6g} Hz and --rate-hz is "
                        f"{names.rate_hz:.6g}; drop the option")  # fmt: skip
    return period, [f"steps of {name} off by {100.0 * off:.2g} %"] if off > options.jitter else []
