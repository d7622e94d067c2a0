"""The sections of a case file as frozen dataclasses; each key carries its check.

Units are those of the file (Hz where a name says so).
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any

from ccd_casadi.cases.checks import (
    ABOVE_ONE,
    FRACTION,
    POSITIVE,
    Check,
    choice,
    count,
    direction,
    factors,
    files,
    flag,
    interval,
    number,
    points,
    steps,
    table,
    tables,
)


def _key(check: Check, default: Any = MISSING) -> Any:
    if default is MISSING:
        return field(metadata={"check": check})
    return field(default=default, metadata={"check": check})


@dataclass(frozen=True)
class PlantSection:
    """[plant]: a model's name or function = "file.py:name"; all other keys are its options."""

    model: str | None
    function: str | None
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Parameter:
    """[theta.NAME]: bounds, start (default: the middle) and unit of one hardware parameter."""

    name: str
    lower: float
    upper: float
    start: float
    unit: str


@dataclass(frozen=True)
class ObjectiveSection:
    """[objective] J = w1 f(θ) + w2 ω_b, ω_b in rad/s; of `minimise = "rms_error"` w2 e, m."""

    w1: float = _key(number(0.0, math.inf, "give 0 or more: J is minimised", closed=True))
    w2: float = _key(number(-math.inf, math.inf, "give a negative number: J must reward bandwidth"))


@dataclass(frozen=True)
class WeightsSection:
    """[weights] of the paper's Table 1; M_K in force over displacement.

    `disturbance` W_d, of the same unit, with "h_infinity_disturbance": so much force weighs as
    much as a reference of one unit of length. Default: ten times M_K.
    """

    M_S: float = _key(POSITIVE)
    A_S: float = _key(FRACTION)
    c_K: float = _key(ABOVE_ONE)
    omega_K_hz: float = _key(POSITIVE)
    M_K: float = _key(POSITIVE)
    A_l: float = _key(POSITIVE)
    A_u: float = _key(FRACTION)
    disturbance: float | None = _key(POSITIVE, None)


@dataclass(frozen=True)
class InnerSection:
    """[inner]: constraints on S, the box of the weights' frequencies, and how it is searched.

    With sections: `minimise` what, "bandwidth" (its negative) or the "rms_error" of [budget], that
    at a bandwidth of `bandwidth_least_hz` or more.
    """

    S_max: float = _key(
        number(1.0, math.inf, "give more than 1: a peak of S below 1 contradicts Bode's integral")
    )
    S_low: float = _key(FRACTION)
    omega_low_hz: float = _key(POSITIVE)
    omega_S_hz: tuple[float, float] = _key(interval)
    omega_T_hz: tuple[float, float] = _key(interval)
    gamma_backoff: float = _key(
        number(1.0, 10.0, "give a number above 1 and below 10, such as 1.02"), 1.02
    )
    sweep_points: tuple[int, int] = _key(points, (20, 20))
    method: str = _key(choice("search", "sweep"), "search")
    shape: float | None = _key(number(1.0, 10.0, "give 1 to 10", closed=True), None)
    compliance_max: float | None = _key(POSITIVE, None)
    minimise: str = _key(choice("bandwidth", "rms_error"), "bandwidth")
    bandwidth_least_hz: float | None = _key(POSITIVE, None)


@dataclass(frozen=True)
class SuspensionSection:
    """[suspension]: where rigid-body poles are put, and how many there must be (default: any)."""

    frequency_hz: float = _key(POSITIVE, 0.1)
    damping_ratio: float = _key(POSITIVE, 0.7)
    rigid_modes: int | None = _key(count(0), None)


@dataclass(frozen=True)
class RobustSection:
    """[robust]: plants on which the loop has to be stable and ‖S‖∞ within S_max; off by default.

    `resonance_shift` s: flexible frequencies at `shifts` places from -s to +s (relative), each with
    damping times 1 and every factor of `damping`. `design_at`: which end of that range, or its
    middle, the controller is synthesised for; "auto" tries all three and keeps the best.

    With sections the box between these ends counts, searched for its worst plants, and besides:
    `mode_shift` of each flexible mode on its own, `gain` of the whole plant, `plants`: TOML files
    of plant options (loads, positions).
    """

    resonance_shift: float = _key(
        number(0.0, 0.5, "give a share of the frequency, 0 to 0.5", closed=True), 0.0
    )
    shifts: int = _key(count(2), 5)
    damping: tuple[float, ...] = _key(factors, ())
    design_at: str = _key(choice("auto", "low", "nominal", "high"), "auto")
    mode_shift: float = _key(
        number(0.0, 0.5, "give a share of the frequency, 0 to 0.5", closed=True), 0.0
    )
    gain: float = _key(number(0.0, 0.9, "give a share of the gain, 0 to 0.9", closed=True), 0.0)
    plants: tuple[str, ...] = _key(files, ())


@dataclass(frozen=True)
class ChannelSection:
    """[controller.channel.NAME] of a plant with several outputs: what differs from [controller].

    `outputs`: how the channel's measurement is made of the plant's, `inputs`: how its force acts on
    the plant's (default: as `outputs`). Either every channel gives them or none: then the channels
    are those that are found, named "1", "2", ….
    """

    outputs: tuple[float, ...] | None = _key(direction, None)
    inputs: tuple[float, ...] | None = _key(direction, None)
    integrator: bool | None = _key(flag, None)
    lead: int | None = _key(count(0), None)
    biquads: int | None = _key(count(0), None)
    roll_off: int | None = _key(count(0), None)
    least_damping: float | None = _key(
        number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True), None
    )


@dataclass(frozen=True)
class ControllerSection:
    """[controller]: "h_infinity", of full order by mixed sensitivity, "h_infinity_disturbance",
    of full order with an input disturbance beside the reference, or "sections".

    The sections: an integrator, `lead` first-order leads, `biquads` (each a pair of zeros and one
    of poles), a roll-off of order `roll_off`. |W_KS KS| and |W_T T| stay below `weighted_level`.
    The search starts at `starts` places. `channel` overrides the structure of single channels.
    """

    structure: str = _key(choice("h_infinity", "h_infinity_disturbance", "sections"), "h_infinity")
    integrator: bool = _key(flag, True)
    lead: int = _key(count(0), 1)
    biquads: int = _key(count(0), 2)
    roll_off: int = _key(count(0), 2)
    weighted_level: float | None = _key(POSITIVE, None)
    least_damping: float = _key(
        number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True), 0.0
    )
    starts: int = _key(count(1), 24)
    channel: tuple[tuple[str, ChannelSection], ...] = _key(table, ())


@dataclass(frozen=True)
class LoopSection:
    """[loop]: sampled with a hold at `rate_hz`; `delay_us` from measurement to force."""

    rate_hz: float | None = _key(POSITIVE, None)
    delay_us: float = _key(number(0.0, 1e6, "give 0 to 1e6", closed=True), 0.0)


@dataclass(frozen=True)
class BudgetSection:
    """[budget]: what moves the stage, by where it enters, and the window of MA and MSD in ms.

    Each kind is one table or several of them; their keys are checked in `budget`.
    """

    window_ms: float | None = _key(POSITIVE, None)
    force: tuple[Mapping[str, Any], ...] = _key(tables, ())
    floor_motion: tuple[Mapping[str, Any], ...] = _key(tables, ())
    sensor_noise: tuple[Mapping[str, Any], ...] = _key(tables, ())
    setpoint: tuple[Mapping[str, Any], ...] = _key(tables, ())


@dataclass(frozen=True)
class SamplingSection:
    """[sampling]: the offline design over θ; points per axis for grid, in all for the others.

    `lifted_points` designs of (θ, ω_S, ω_T) are sampled for the lifted formulation; 0 chooses.
    """

    design: str = _key(choice("grid", "sobol", "lhs"), "grid")
    points: int = _key(count(2), 5)
    lifted_points: int = _key(count(0), 0)


@dataclass(frozen=True)
class OuterSection:
    """[outer]: IPOPT starts, agreement of prediction and truth, rounds of refinement, surrogate.

    `surrogate`: the kernel of the Gaussian processes; "auto" takes, output by output, the one
    that predicts left-out samples best. `box_points`: true inner problems spread over the box of θ
    that a solve ends with a look at, those that it has solved already among them; 0: none.
    """

    starts: int = _key(count(1), 16)
    direct_starts: int = _key(count(1), 4)
    tolerance: float = _key(FRACTION, 1e-3)
    max_refinements: int = _key(count(0), 12)
    surrogate: str = _key(choice("matern52", "rbf", "auto"), "matern52")
    box_points: int = _key(count(0), 32)


@dataclass(frozen=True)
class BaselineSection:
    """[baseline]: the sequential design's first resonance, and the descents' steps and starts.

    `steps` are the first steps tried, as shares of the box; `starts` start points: the case's own
    and a Latin hypercube.
    """

    first_resonance_hz: float = _key(POSITIVE, 250.0)
    steps: tuple[float, ...] = _key(steps, (0.02, 0.05, 0.1))
    starts: int = _key(count(1), 3)
    max_iterations: int = _key(count(1), 100)


@dataclass(frozen=True)
class LimitsSection:
    """[limits]: how long a user's plant function may take at each call, in s."""

    plant_seconds: float = _key(POSITIVE, 60.0)


@dataclass(frozen=True)
class Case:
    """A checked case file."""

    path: Path
    plant: PlantSection
    theta: tuple[Parameter, ...]
    objective: ObjectiveSection
    weights: WeightsSection
    inner: InnerSection
    suspension: SuspensionSection
    robust: RobustSection
    controller: ControllerSection
    loop: LoopSection
    budget: BudgetSection
    sampling: SamplingSection
    outer: OuterSection
    baseline: BaselineSection
    limits: LimitsSection


SECTIONS: dict[str, type] = {
    "objective": ObjectiveSection,
    "weights": WeightsSection,
    "inner": InnerSection,
    "suspension": SuspensionSection,
    "robust": RobustSection,
    "controller": ControllerSection,
    "loop": LoopSection,
    "budget": BudgetSection,
    "sampling": SamplingSection,
    "outer": OuterSection,
    "baseline": BaselineSection,
    "limits": LimitsSection,
}
