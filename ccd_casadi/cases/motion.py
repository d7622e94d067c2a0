"""[motor] and [move] of a case file: what they may say, and the move in SI."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ccd_casadi.analysis.motor import UNLIMITED, Motion, Motor
from ccd_casadi.analysis.move_limits import MoveLimits
from ccd_casadi.cases.checks import NOT_NEGATIVE, Fail, key, one_or_more

Numbers = float | tuple[float, ...] | None
OF_A_MOTOR = ("force_constant", "resistance", "peak_current", "moving_mass")
SHORTEST = 1e-4  # s in which jerk changes, where neither snap nor a sampling rate is given


@dataclass(frozen=True)
class MotorTable:
    """[motor]: one motor, or a catalogue as lists in rising order of the moving mass."""

    force_constant: Numbers = key(
        "force per current, a list for a catalogue", None, check=one_or_more, unit="N/A"
    )
    resistance: Numbers = key("of the warm coil", None, check=one_or_more, unit="ohm")
    peak_current: Numbers = key(
        "largest short-time current; absent: no limit", None, check=one_or_more, unit="A"
    )
    moving_mass: Numbers = key(
        "added to the plant where each force enters", None, check=one_or_more, unit="kg"
    )
    rms_power: float | None = key(
        "largest heat of all motors together, mean over a cycle", None, unit="W"
    )
    size: str = key("name of the [theta] parameter that is the moving mass", "")


@dataclass(frozen=True)
class MoveTable:
    """[move]: a setpoint of third or fourth order, made over and over."""

    distance: float | None = key("length of the move, from rest to rest", None, unit="m")
    velocity: float | None = key("largest", None, unit="m/s")
    acceleration: float | None = key(
        "of the move; absent: the largest that the motor allows", None, unit="m/s²"
    )
    jerk: float | None = key("largest", None, unit="m/s³")
    snap: float | None = key("largest; absent: jerk/sample", None, unit="m/s⁴")
    settle_band: float | None = key("half width of the window of the error", None, unit="m")
    dwell: float = key("pause between two moves", 0.0, check=NOT_NEGATIVE, unit="s")


def check_motion(tables: Mapping[str, Any], theta: Mapping[str, Any], fail: Fail) -> None:
    """Raise where [move] and [motor] do not go together, or with the rest of the case."""
    move, motor = tables["move"], tables["motor"]
    given, timed = motor != MotorTable(), tables["inner"].minimise == "move_time"
    if move == MoveTable():
        if given or timed:
            words = 'is missing: [motor] and minimise = "move_time" are about one; add a table'
            raise fail("move", f"{words} [move]")
        return
    for name in ("distance", "velocity", "jerk", "settle_band"):
        if getattr(move, name) is None:
            raise fail(f"move.{name}", "is missing; add it")
    if timed and tables["loop"].rate_hz is None:
        raise fail("loop.rate_hz", 'is missing: minimise = "move_time" counts samples; add it')
    if move.acceleration is None and not (motor.peak_current or motor.rms_power):
        words = "is missing, and neither peak_current nor rms_power of [motor] bounds it"
        raise fail("move.acceleration", f"{words}; give one of them")
    if not given:
        return
    lists = {name: _listed(getattr(motor, name)) for name in OF_A_MOTOR}
    for name, values in lists.items():
        if len(values) != len(lists["force_constant"]) and (values or name == "resistance"):
            raise fail(f"motor.{name}", "has not as many entries as force_constant; give as many")
    mass = lists["moving_mass"]
    least, most = theta.get(motor.size, (0.0, 0.0))
    if not lists["force_constant"] or (len(lists["force_constant"]) > 1 and not motor.size):
        words = "force_constant, or of a list the [theta] that chooses, is missing; add it"
        raise fail("motor", words)
    if not motor.size:
        return
    if not mass or list(mass) != sorted(set(mass)):
        raise fail("motor.moving_mass", "gives no motor to choose; list them in rising order")
    if len(mass) > 1 and not mass[0] <= least <= most <= mass[-1]:
        words = f"reaches beyond the catalogue's moving masses {mass[0]:g} to {mass[-1]:g}"
        raise fail(f"theta.{motor.size}", f"{words}; narrow it")


def motion_problem(move: MoveTable, motor: MotorTable, rate_hz: float | None) -> Motion | None:
    """The move and its motor in SI; None for a case without a move."""
    if move == MoveTable():
        return None
    given = {item.name: getattr(move, item.name) for item in fields(move)}
    shortest = SHORTEST if rate_hz is None else 1.0 / rate_hz
    limits = MoveLimits(
        given["distance"], given["velocity"], move.acceleration or float("inf"), given["jerk"],
        move.snap or given["jerk"] / shortest,
    )  # fmt: skip
    k, current = _listed(motor.force_constant), _listed(motor.peak_current)
    made = None if motor == MotorTable() else Motor(
        k, _listed(motor.resistance), current or (UNLIMITED,) * len(k),
        _listed(motor.moving_mass) or (0.0,), motor.rms_power, motor.size,
    )  # fmt: skip
    return Motion(limits, given["settle_band"], move.dwell, made)


def _listed(value: Numbers) -> tuple[float, ...]:
    if value is None:
        return ()
    return tuple(map(float, value)) if isinstance(value, tuple) else (float(value),)
