"""[motor] and [move] of a case file: what they may say, and the move in SI."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from ccd_casadi.analysis.motor import UNLIMITED, Motion, Motor
from ccd_casadi.analysis.move_limits import Limits
from ccd_casadi.cases.checks import POSITIVE, closest, count, key, number, one_or_more, text

Numbers = float | tuple[float, ...] | None
SHORTEST = 1e-4  # s in which jerk changes, where neither snap nor a sampling rate is given


@dataclass(frozen=True)
class MotorSection:
    """[motor]: one motor, or a catalogue as lists in rising order of the moving mass."""

    force_constant: float | tuple[float, ...] | None = key(
        one_or_more, None, says="force per current, a list for a catalogue", unit="N/A"
    )
    resistance: float | tuple[float, ...] | None = key(
        one_or_more, None, says="of the warm coil", unit="ohm"
    )
    peak_current: float | tuple[float, ...] | None = key(
        one_or_more, None, says="the largest for moments", unit="A"
    )
    peak_force: float | tuple[float, ...] | None = key(
        one_or_more, None, says="in place of peak_current", unit="N"
    )
    moving_mass: float | tuple[float, ...] | None = key(
        one_or_more,
        None,
        says="is added to the plant where each force enters; absent: the plant has it already",
        unit="kg",
    )
    rms_power: float | None = key(
        POSITIVE, None, says="heat of all motors together, mean of a cycle, at most", unit="W"
    )
    size: str = key(
        text,
        "",
        says="the name of the [theta] that is the moving mass: a longer motor, or one of the lists",
    )
    price: float = key(
        number(0.0, 1e30, "give 0 or more", closed=True),
        0.0,
        says="what a watt of heat adds to the hardware cost f(θ)",
    )


@dataclass(frozen=True)
class MoveSection:
    """[move]: a setpoint of third or fourth order, made over and over."""

    distance: float | None = key(POSITIVE, None, says="from rest to rest", unit="m")
    velocity: float | None = key(POSITIVE, None, says="at most", unit="m/s")
    acceleration: float | None = key(
        POSITIVE,
        None,
        says="the move has this; peak force and heat are constraints then; absent: the largest "
        "that the motor allows",
        unit="m/s²",
    )
    jerk: float | None = key(POSITIVE, None, says="at most", unit="m/s³")
    snap: float | None = key(
        POSITIVE, None, says="at most; absent: jerk changes within a sample (third order)",
        unit="m/s⁴",
    )  # fmt: skip
    settle_band: float | None = key(
        POSITIVE, None, says="settled while the error stays within ± this", unit="m"
    )
    dwell: float = key(
        number(0.0, 1e6, "give 0 or more", closed=True),
        0.0,
        says="from the end of a move to the start of the next",
        unit="s",
    )
    axis: int = key(count(1), 1, says="the output that moves")


def check_motion(
    sections: Mapping[str, Any], theta: Mapping[str, Any], fail: Callable[[str, str], Exception]
) -> None:
    """Raise where [move] and [motor] do not go together, or with the rest of the case."""
    move, motor = sections["move"], sections["motor"]
    given, timed = motor != MotorSection(), sections["inner"].minimise == "move_time"
    if move == MoveSection():
        if given or timed:
            words = 'is missing: [motor] and minimise = "move_time" are about one; add a table'
            raise fail("move", f"{words} [move]")
        return
    for name in ("distance", "velocity", "jerk", "settle_band"):
        if getattr(move, name) is None:
            raise fail(f"move.{name}", "is missing; add it")
    if timed and sections["loop"].rate_hz is None:
        raise fail("loop.rate_hz", 'is missing: minimise = "move_time" counts samples; add it')
    limited = given and (motor.peak_current or motor.peak_force or motor.rms_power)
    if move.acceleration is None and not limited:
        words = "is missing, and no peak_current, peak_force or rms_power of [motor] bounds it"
        raise fail("move.acceleration", f"{words}; give one of them")
    if not given:
        return
    lists = {item.name: _listed(getattr(motor, item.name)) for item in fields(motor)
             if item.type == Numbers}  # fmt: skip
    for name in ("force_constant", "resistance"):
        if not lists[name]:
            raise fail(f"motor.{name}", "is missing; add it")
    if lists["peak_current"] and lists["peak_force"]:
        raise fail("motor.peak_force", "is given beside peak_current; drop one of them")
    for name, values in lists.items():
        if values and len(values) != len(lists["force_constant"]):
            raise fail(f"motor.{name}", f"has {len(values)} entries, force_constant "
                       f"{len(lists['force_constant'])}; give as many")  # fmt: skip
    mass = lists["moving_mass"]
    if len(lists["force_constant"]) > 1 and not motor.size:
        raise fail("motor.size", "is missing; name the [theta] that chooses from the lists")
    if not motor.size:
        return
    if motor.size not in theta:
        raise fail("motor.size", f"is {motor.size!r}, no table [theta]{closest(motor.size, theta)}")
    if not mass or list(mass) != sorted(set(mass)):
        raise fail("motor.moving_mass", "gives no motor to choose; list them in rising order")
    least, most = theta[motor.size]
    if len(mass) > 1 and not mass[0] <= least <= most <= mass[-1]:
        words = f"reaches beyond the catalogue's moving masses {mass[0]:g} to {mass[-1]:g}"
        raise fail(f"theta.{motor.size}", f"{words}; narrow it")


def motion_problem(move: MoveSection, motor: MotorSection, rate_hz: float | None) -> Motion | None:
    """The move and its motor in SI; None for a case without a move."""
    if move == MoveSection():
        return None
    given = {item.name: getattr(move, item.name) for item in fields(move)}
    shortest = SHORTEST if rate_hz is None else 1.0 / rate_hz
    limits = Limits(
        given["distance"], given["velocity"], move.acceleration or float("inf"), given["jerk"],
        move.snap or given["jerk"] / shortest,
    )  # fmt: skip
    k, current = _listed(motor.force_constant), _listed(motor.peak_current)
    if motor.peak_force is not None:
        current = tuple(F / each for F, each in zip(_listed(motor.peak_force), k, strict=True))
    made = None if motor == MotorSection() else Motor(
        k, _listed(motor.resistance), current or (UNLIMITED,) * len(k),
        _listed(motor.moving_mass) or (0.0,), motor.rms_power, motor.size, motor.price,
    )  # fmt: skip
    return Motion(limits, given["settle_band"], move.dwell, move.axis - 1, made)


def _listed(value: Numbers) -> tuple[float, ...]:
    if value is None:
        return ()
    return tuple(map(float, value)) if isinstance(value, tuple) else (float(value),)
