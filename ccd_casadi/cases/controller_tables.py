"""[controller], [loop], [motor] and [move] of a case file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.cases import checks
from ccd_casadi.cases.checks import NOT_NEGATIVE, Fail, corners_hz, damping_ratios, key, one_or_more
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.lti.wiring import Filters

if TYPE_CHECKING:
    from ccd_casadi.analysis.motor import Motion

Numbers = float | tuple[float, ...] | None
OF_A_MOTOR = ("force_constant", "resistance", "peak_current", "moving_mass")


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

    distance: float | None = key(
        "length of the move, from rest to rest", None, unit="m", needed=True
    )
    velocity: float | None = key("largest", None, unit="m/s", needed=True)
    acceleration: float | None = key(
        "of the move; absent: the largest that the motor allows", None, unit="m/s²"
    )
    jerk: float | None = key("largest", None, unit="m/s³", needed=True)
    snap: float | None = key("largest; absent: jerk/sample", None, unit="m/s⁴")
    settle_band: float | None = key(
        "half width of the window of the error", None, unit="m", needed=True
    )
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
    lists = {name: _list_values(getattr(motor, name)) for name in OF_A_MOTOR}
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


def check_filters(tables: Mapping[str, Any], fail: Fail) -> None:
    """Raise where [actuator] or [sensor] is not known together with another table."""
    inner, structure = tables["inner"], tables["controller"].structure
    given = [name for name in ("actuator", "sensor") if filters_of(tables[name])]
    for name in ("actuator", "sensor"):
        table = tables[name]
        if table.damping != FiltersTable().damping and table.second_order_hz is None:
            raise fail(f"{name}.damping", "has no effect without second_order_hz; give that")
    if not given:
        return
    if inner.minimise != BANDWIDTH.key:
        words = f'is "{inner.minimise}" beside [{given[0]}], whose plants have the bandwidth alone'
        raise fail("inner.minimise", f"{words}; drop one of the two: runs report the other figures")
    if inner.compliance_max is None:
        return
    if structure != "sections":
        words = f"is beside [{given[0]}], of a force on the machine, which full order does not know"
        raise fail("inner.compliance_max", f'{words}; give controller.structure = "sections"')
    for key_of, values in vars(filters_of(tables["sensor"])).items():
        if len(set(values)) > 1:
            words = "differs between sensors, beside inner.compliance_max of a position"
            raise fail(f"sensor.{key_of}", f"{words}; give one for all, or drop that bound")


def filters_of(table: "FiltersTable") -> Filters:
    """[actuator] or [sensor] as filters."""
    second = _list_values(table.second_order_hz)
    return Filters(
        _list_values(table.lag_hz), second, _list_values(table.damping) if second else ()
    )


def motion_problem(
    move: MoveTable, motor: MotorTable, rate_hz: float | None, *, shortest: float = 1e-4
) -> "Motion | None":
    """The move and its motor in SI; None for a case without a move. Jerk changes over `shortest` s
    where neither snap nor a sampling rate is given."""
    if move == MoveTable():
        return None
    from ccd_casadi.analysis.motor import Motion, Motor

    given = {item.name: getattr(move, item.name) for item in fields(move)}
    shortest = shortest if rate_hz is None else 1.0 / rate_hz
    limits = MoveLimits(
        given["distance"], given["velocity"], move.acceleration or float("inf"), given["jerk"],
        move.snap or given["jerk"] / shortest,
    )  # fmt: skip
    k, current = _list_values(motor.force_constant), _list_values(motor.peak_current)
    made = None if motor == MotorTable() else Motor(
        k, _list_values(motor.resistance), current or (Motor.unlimited,) * len(k),
        _list_values(motor.moving_mass) or (0.0,), motor.rms_power, motor.size,
    )  # fmt: skip
    return Motion(limits, given["settle_band"], move.dwell, made)


def _list_values(value: Numbers) -> tuple[float, ...]:
    if value is None:
        return ()
    return tuple(map(float, value)) if isinstance(value, tuple) else (float(value),)


@dataclass(frozen=True)
class ChannelTable:
    """[controller.channel.NAME] of a plant with several outputs: what differs from [controller].

    `outputs`: how the channel's measurement is made of the plant's, `inputs`: how its force acts on
    the plant's (default: as `outputs`). Either every channel gives them or none: then the channels
    are those that are found, named "1", "2", …. `like` names a channel with the same parameters, as
    tip and tilt of a square stage may have: then nothing else of the structure is given.

    `S_max`, `M_K` and `bandwidth_ratio` ask more of this channel than of the whole loop.
    """

    outputs: tuple[float, ...] | None = key(
        "the channel's measurement as weights of the plant's outputs", None, check=checks.direction
    )
    inputs: tuple[float, ...] | None = key(
        "the channel's force as weights of the plant's inputs; default: as outputs",
        None,
        check=checks.direction,
    )
    like: str | None = key("another channel: both have one controller", None)
    integrator: bool | None = key("instead of [controller]'s", None)
    lead: int | None = key("instead of [controller]'s", None)
    biquads: int | None = key("instead of [controller]'s", None)
    roll_off: int | None = key("instead of [controller]'s", None)
    least_damping: float | None = key("instead of [controller]'s", None, check=checks.DAMPING)
    slowest_zero_hz: float | None = key(
        "instead of [controller]'s", None, check=checks.NOT_NEGATIVE
    )
    S_max: float | None = key(
        "bound of this channel's S, tighter than [inner]'s",
        None,
        check=checks.number(1.0, math.inf, "give more than 1, at most [inner]'s S_max"),
    )
    M_K: float | None = key("M_K of this channel, lower than [weights]'", None, unit="N/m")
    bandwidth_ratio: float = key(
        "least ratio of this channel's bandwidth to ω_b",
        1.0,
        check=checks.number(
            1.0, 1000.0, "give 1 or more: ω_b is that of the slowest channel", closed=True
        ),
    )


@dataclass(frozen=True)
class ControllerTable:
    """[controller]: "h_infinity", of full order by mixed sensitivity, "h_infinity_disturbance",
    of full order with an input disturbance beside the reference, or "sections".

    The sections: an integrator, leads, biquads (a pair of zeros and one of poles), a roll-off.
    """

    structure: str = key(
        "mixed sensitivity, the same with an input disturbance, or a fixed structure",
        "h_infinity",
        check=checks.choice("h_infinity", "h_infinity_disturbance", "sections"),
    )
    integrator: bool = key("sections: whether K has an integrator with a zero", True)
    lead: int = key("sections: number of first-order leads", 1)
    biquads: int = key("sections: number of biquads: notches, skewed notches", 2)
    roll_off: int = key("sections: order of the roll-off", 2)
    weighted_level: float | None = key(
        "sections: bound of |W_KS KS| and |W_T T|; absent: no bound, which results report", None
    )
    least_damping: float = key(
        "sections: least damping ratio of zeros and poles", 0.0, check=checks.DAMPING
    )
    slowest_zero_hz: float = key("sections: slowest zero of K", 0.0, check=checks.NOT_NEGATIVE)
    bandwidth_of: str | None = key(
        "sections: of several sensors on one actuator, the channel whose error counts for ω_b", None
    )
    starts: int = key(
        "sections: least number of starts; a search goes on until its best is found twice",
        12,
        check=checks.count(1),
    )
    channel: tuple[tuple[str, ChannelTable], ...] = key(
        "tables [controller.channel.NAME] for plants with several outputs", (), check=checks.table
    )


@dataclass(frozen=True)
class LoopTable:
    """[loop]: a loop sampled with a hold at `rate_hz`; `delay_us` from measurement to force."""

    rate_hz: float | None = key(
        "sections: sampling rate of the loop, with a hold; absent: continuous", None
    )
    delay_us: float = key(
        "delay from reading the sensor to the new force",
        0.0,
        check=checks.number(0.0, 1e6, "give 0 to 1e6", closed=True),
    )


@dataclass(frozen=True)
class DriveTable:
    """[drive]: the industrial drive that `ccd drive` designs a cascade for.

    Other commands refuse a case that has one.
    """

    name: str | None = key(
        "generic, sinamics_s120, beckhoff_ax5000, synapticon, or a file (.toml)", None
    )
    velocity: str | None = key("channel of the motor's sensor; absent: the position's", None)
    lead_mm: float | str | None = key(
        "of a rotary motor's screw; number or [theta]", None, unit="mm", check=checks.coordinate
    )
    coil: tuple[float, ...] | None = key(
        "ohm, H, Hz: designs the current controller",
        None,
        check=checks.every(checks.POSITIVE, "give three numbers above 0: ohm, H, Hz", 3, 3),
    )
    position_rate_hz: float | None = key(
        "rate of a slower position loop",
        None,
        unit="Hz",
        check=checks.number(0.0, 1e9, "give more than 0"),
    )
    filters: int = key("filters of the current command", 3, check=checks.count(0))
    setpoint_filters: int = key("filters of the velocity setpoint", 0, check=checks.count(0))
    filter_gain: float = key(
        "most that filters raise at any frequency",
        10.0,
        check=checks.number(1.0, 1e6, "give 1 to 1e6", closed=True),
    )
    filters_above: float = key(
        "least frequency of a filter over ω_b",
        2.0,
        check=checks.number(1.0, 1e3, "give 1 to 1000", closed=True),
    )
    decay: float = key(
        "largest ω_b Tn and ω_b/Kv",
        4.0,
        check=checks.number(0.1, 1e9, "give 0.1 to 1e9", closed=True),
    )
    compliance_hz: float | None = key(
        "inner.compliance_max holds up to this",
        None,
        unit="Hz",
        check=checks.number(0.0, 1e9, "give more than 0"),
    )


@dataclass(frozen=True)
class FiltersTable:
    """[actuator] before the forces, [sensor] behind the sensors: low passes, one or one of each
    channel."""

    lag_hz: Numbers = key("corner of first order, of static gain 1", None, check=corners_hz)
    second_order_hz: Numbers = key(
        "natural frequency of second order, of static gain 1", None, check=corners_hz
    )
    damping: Numbers = key("damping ratio of second_order_hz", 0.7, check=damping_ratios)


@dataclass(frozen=True)
class SamplingTable:
    """[sampling]: the sampling plan over θ."""

    design: str = key("sampling plan over θ", "grid", check=checks.choice("grid", "sobol", "lhs"))
    points: int = key(
        "number of θ: along each axis of a grid, in total for other plans", 5, check=checks.count(2)
    )
    lifted_points: int = key(
        "number of designs (θ, ω_S, ω_T) for lifted; 0: chosen by the program", 0
    )


@dataclass(frozen=True)
class OuterTable:
    """[outer]: numbers of the search over θ, of the refinement and of the global check."""

    starts: int = key("starts of IPOPT on the surrogates", 16, check=checks.count(1))
    direct_starts: int = key("local solves on the true problem", 4, check=checks.count(1))
    tolerance: float = key(
        "largest relative difference of prediction and truth", 1e-3, check=checks.FRACTION
    )
    max_refinements: int = key("most rounds of adding true samples", 12)
    surrogate: str = key(
        'kernel of the Gaussian processes; "auto": the one with the least left-out error',
        "matern52",
        check=checks.choice("matern52", "rbf", "auto"),
    )
    box_points: int = key("number of θ in the global check at the end; 0: none", 32)
    minutes: float = key(
        "time budget of `solve`: the best design found in it is judged", 5.0, unit="min"
    )


@dataclass(frozen=True)
class BaselineTable:
    """[baseline]: the sequential design's first resonance, and the descents' steps and starts."""

    first_resonance_hz: float = key("least first resonance of the sequential design", 250.0)
    steps: tuple[float, ...] = key(
        "first steps of the descents, as shares of the box", (0.02, 0.05, 0.1), check=checks.steps
    )
    starts: int = key(
        "starts of the descents: the case's own, then a Latin hypercube", 3, check=checks.count(1)
    )
    max_iterations: int = key("most iterations of a descent", 100, check=checks.count(1))


@dataclass(frozen=True)
class LimitsTable:
    """[limits]: how long a user's plant function may take at each call, in s."""

    plant_seconds: float = key("time limit of each call of your own plant function", 60.0, unit="s")
