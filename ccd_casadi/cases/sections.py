"""The sections of a case file as frozen dataclasses; each key carries its check and a sentence.

Units are those of the file (Hz where a name says so).
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, replace
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
    signed,
    steps,
    table,
    tables,
    text,
)
from ccd_casadi.support.notebook import Shown


def _key(check: Check, default: Any = MISSING, *, says: str, unit: str = "") -> Any:
    """A key of a section: its check, default, one sentence for a person, and its unit."""
    metadata = {"check": check, "says": says, "unit": unit}
    if default is MISSING:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class PlantSection:
    """[plant]: a model's name or function = "file.py:name"; all other keys are its options."""

    model: str | None
    function: str | None
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Parameter:
    """[theta.NAME]: bounds, start (default: the middle) and unit of one hardware parameter.

    `values`: those that it may have, in rising order, from `lower` to `upper`; none: all between
    the bounds. With one value it is fixed, and no part of θ.
    """

    name: str
    lower: float
    upper: float
    start: float
    unit: str
    values: tuple[float, ...] = ()

    def fixed_at(self, value: float) -> "Parameter":
        """The same at one value."""
        return replace(self, lower=value, upper=value, start=value, values=(value,))

    @property
    def table(self) -> dict[str, Any]:
        """What a case file says of it."""
        if len(self.values) == 1:
            return {"fixed": self.start, "unit": self.unit}
        if self.values:
            return {"values": self.values, "start": self.start, "unit": self.unit}
        return {"lower": self.lower, "upper": self.upper, "start": self.start, "unit": self.unit}


@dataclass(frozen=True)
class ObjectiveSection:
    """[objective] J = w1 f(θ) + w2 ω_b, ω_b in rad/s; of `minimise = "rms_error"` w2 e, m."""

    w1: float = _key(
        number(0.0, math.inf, "give 0 or more: J is minimised", closed=True),
        says="what a unit of the hardware cost f(θ) weighs in J",
    )
    w2: float = _key(
        signed("give a negative number: J must reward bandwidth"),
        says="what bandwidth is worth in J, negative, in 1/(rad/s); of an RMS error positive, 1/m",
    )
    cost_unit: str = _key(text, "", says="of the hardware cost f(θ), for tables and pages")


@dataclass(frozen=True)
class WeightsSection:
    """[weights] of the paper's Table 1; M_K in force over displacement.

    `disturbance` W_d, of the same unit, with "h_infinity_disturbance": so much force weighs as
    much as a reference of one unit of length. Default: ten times M_K.
    """

    M_S: float = _key(
        POSITIVE, says="W_S at high frequency is 1/M_S: the peak of S that the weight lets pass"
    )
    A_S: float = _key(
        FRACTION, says="W_S at zero frequency is 1/A_S: the S that the weight lets pass there"
    )
    c_K: float = _key(ABOVE_ONE, says="W_KS grows by this factor above omega_K")
    omega_K_hz: float = _key(
        POSITIVE, says="W_KS is 1/M_K below this frequency and grows above it", unit="Hz"
    )
    M_K: float = _key(
        POSITIVE,
        says="gain of the controller that W_KS lets pass: about mass times (2π ω_b)²",
        unit="N/m",
    )
    A_l: float = _key(POSITIVE, says="W_T at zero frequency is 1/A_l")
    A_u: float = _key(
        FRACTION, says="W_T at high frequency is 1/A_u: the T that the weight lets pass there"
    )
    disturbance: float | None = _key(
        POSITIVE,
        None,
        says='of "h_infinity_disturbance": weighs as one metre of reference; default 10 M_K',
        unit="N/m",
    )


@dataclass(frozen=True)
class InnerSection:
    """[inner]: constraints on S, the box of the weights' frequencies, and how it is searched.

    With sections: `minimise` what, "bandwidth" (its negative) or the "rms_error" of [budget], that
    at a bandwidth of `bandwidth_least_hz` or more.
    """

    S_max: float = _key(
        number(1.0, math.inf, "give more than 1: a peak of S below 1 contradicts Bode's integral"),
        says="bound of the peak of S, as a ratio: 2 is 6 dB",
    )
    S_low: float = _key(FRACTION, says="bound of |S| at omega_low")
    omega_low_hz: float = _key(POSITIVE, says="where S_low holds", unit="Hz")
    omega_S_hz: tuple[float, float] = _key(
        interval, says="range of the frequency of W_S that is searched", unit="Hz"
    )
    omega_T_hz: tuple[float, float] = _key(
        interval,
        says="range of the frequency of W_T that is searched; with sections its lower end is W_T's",
        unit="Hz",
    )
    gamma_backoff: float = _key(
        number(1.0, 10.0, "give a number above 1 and below 10, such as 1.02"),
        1.02,
        says="controllers are made at this multiple of γ_opt",
    )
    sweep_points: tuple[int, int] = _key(
        points, (20, 20), says='mesh of (omega_S, omega_T) of method "sweep", as the paper has it'
    )
    method: str = _key(
        choice("search", "sweep"),
        "search",
        says="the best pair of weights by a search with exact derivatives, or on a mesh",
    )
    shape: float | None = _key(
        number(1.0, 10.0, "give 1 to 10", closed=True),
        None,
        says="with sections: below ω_b, |S| stays under this times (ω/ω_b)/√2; absent: no bound",
    )
    compliance_max: float | None = _key(
        POSITIVE,
        None,
        says="bound of the peak of GS, the displacement by a force at any frequency",
        unit="m/N",
    )
    minimise: str = _key(
        choice("bandwidth", "rms_error"),
        "bandwidth",
        says="with sections: the negative bandwidth, or the RMS error of [budget]",
    )
    bandwidth_least_hz: float | None = _key(
        POSITIVE,
        None,
        says='with minimise = "rms_error": the bandwidth that is kept at least',
        unit="Hz",
    )


@dataclass(frozen=True)
class SuspensionSection:
    """[suspension]: where rigid-body poles are put, and how many there must be (default: any)."""

    frequency_hz: float = _key(
        POSITIVE,
        0.1,
        says="where the poles of rigid bodies are put, which synthesis needs off the axis",
        unit="Hz",
    )
    damping_ratio: float = _key(POSITIVE, 0.7, says="of these poles")
    rigid_modes: int | None = _key(
        count(0), None, says="how many rigid-body modes there must be; absent: any number"
    )


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
        number(0.0, 0.5, "give a share of the frequency, 0 to 0.5", closed=True),
        0.0,
        says="every flexible frequency may be off by this share, all together",
    )
    shifts: int = _key(
        count(2), 5, says="how many plants are taken over that range (full-order kinds)"
    )
    damping: tuple[float, ...] = _key(factors, (), says="factors of every modal damping, besides 1")
    design_at: str = _key(
        choice("auto", "low", "nominal", "high"),
        "auto",
        says='which plant of the range a full-order controller is made on; "auto" tries all three',
    )
    mode_shift: float = _key(
        number(0.0, 0.5, "give a share of the frequency, 0 to 0.5", closed=True),
        0.0,
        says="with sections: each flexible mode may be off by this share on its own",
    )
    gain: float = _key(
        number(0.0, 0.9, "give a share of the gain, 0 to 0.9", closed=True),
        0.0,
        says="with sections: the plant's gain may be off by this share",
    )
    plants: tuple[str, ...] = _key(
        files, (), says="with sections: TOML files of plant options: other loads, positions, meshes"
    )


@dataclass(frozen=True)
class ChannelSection:
    """[controller.channel.NAME] of a plant with several outputs: what differs from [controller].

    `outputs`: how the channel's measurement is made of the plant's, `inputs`: how its force acts on
    the plant's (default: as `outputs`). Either every channel gives them or none: then the channels
    are those that are found, named "1", "2", …. `like` names a channel with the same parameters, as
    tip and tilt of a square stage may have: then nothing else of the structure is given.

    `S_max`, `M_K` and `bandwidth_ratio` ask more of this channel than of the whole loop.
    """

    outputs: tuple[float, ...] | None = _key(
        direction, None, says="how the channel's measurement is made of the plant's outputs"
    )
    inputs: tuple[float, ...] | None = _key(
        direction,
        None,
        says="how the channel's force acts on the plant's inputs; default: as outputs",
    )
    like: str | None = _key(
        text, None, says="the channel whose parameters this one has: one controller for both"
    )
    integrator: bool | None = _key(flag, None, says="instead of [controller]'s")
    lead: int | None = _key(count(0), None, says="instead of [controller]'s")
    biquads: int | None = _key(count(0), None, says="instead of [controller]'s")
    roll_off: int | None = _key(count(0), None, says="instead of [controller]'s")
    least_damping: float | None = _key(
        number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True),
        None,
        says="instead of [controller]'s",
    )
    S_max: float | None = _key(
        number(1.0, math.inf, "give more than 1, at most [inner]'s S_max"),
        None,
        says="bound of the peak of this channel's S, tighter than [inner]'s, which the whole keeps",
    )
    M_K: float | None = _key(
        POSITIVE,
        None,
        says="of this channel's W_KS, lower than [weights]': its force counts more",
        unit="N/m",
    )
    bandwidth_ratio: float = _key(
        number(1.0, 1000.0, "give 1 or more: ω_b is that of the slowest channel", closed=True),
        1.0,
        says="this channel's bandwidth is at least so many times ω_b, which is the slowest one's",
    )


@dataclass(frozen=True)
class ControllerSection:
    """[controller]: "h_infinity", of full order by mixed sensitivity, "h_infinity_disturbance",
    of full order with an input disturbance beside the reference, or "sections".

    The sections: an integrator, `lead` first-order leads, `biquads` (each a pair of zeros and one
    of poles), a roll-off of order `roll_off`. |W_KS KS| and |W_T T| stay below `weighted_level`.
    The search starts at `starts` places. `channel` overrides the structure of single channels.
    """

    structure: str = _key(
        choice("h_infinity", "h_infinity_disturbance", "sections"),
        "h_infinity",
        says="mixed sensitivity, the same with an input disturbance, or a fixed structure",
    )
    integrator: bool = _key(flag, True, says="of sections: an integrator with a zero")
    lead: int = _key(count(0), 1, says="of sections: how many first-order leads")
    biquads: int = _key(
        count(0),
        2,
        says="of sections: how many pairs of zeros with pairs of poles: notches, skewed notches",
    )
    roll_off: int = _key(count(0), 2, says="of sections: order of the roll-off")
    weighted_level: float | None = _key(
        POSITIVE,
        None,
        says="of sections: bound of |W_KS KS| and |W_T T|; absent: no bound, and results say so",
    )
    least_damping: float = _key(
        number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True),
        0.0,
        says="of sections: least damping ratio of their zeros and poles",
    )
    starts: int = _key(count(1), 24, says="of sections: how many places the search starts from")
    channel: tuple[tuple[str, ChannelSection], ...] = _key(
        table, (), says="tables [controller.channel.NAME] of plants with several outputs"
    )


@dataclass(frozen=True)
class LoopSection:
    """[loop]: sampled with a hold at `rate_hz`; `delay_us` from measurement to force."""

    rate_hz: float | None = _key(
        POSITIVE,
        None,
        says="with sections: the loop is sampled with a hold at this rate; absent: continuous",
        unit="Hz",
    )
    delay_us: float = _key(
        number(0.0, 1e6, "give 0 to 1e6", closed=True),
        0.0,
        says="from reading the sensor to the new force",
        unit="µs",
    )


@dataclass(frozen=True)
class BudgetSection:
    """[budget]: what moves the stage, by where it enters, and the window of MA and MSD in ms.

    Each kind is one table or several of them; their keys are checked in `budget`.
    """

    window_ms: float | None = _key(
        POSITIVE, None, says="window of the moving average and the moving deviation", unit="ms"
    )
    force: tuple[Mapping[str, Any], ...] = _key(tables, (), says="spectra of forces on the stage")
    floor_motion: tuple[Mapping[str, Any], ...] = _key(
        tables, (), says="spectra of the floor's motion"
    )
    sensor_noise: tuple[Mapping[str, Any], ...] = _key(
        tables, (), says="spectra of the sensor's noise"
    )
    setpoint: tuple[Mapping[str, Any], ...] = _key(tables, (), says="spectra of the setpoint")


@dataclass(frozen=True)
class SamplingSection:
    """[sampling]: the offline design over θ; points per axis for grid, in all for the others.

    `lifted_points` designs of (θ, ω_S, ω_T) are sampled for the lifted formulation; 0 chooses.
    """

    design: str = _key(choice("grid", "sobol", "lhs"), "grid", says="how θ is spread for samples")
    points: int = _key(
        count(2), 5, says="of θ: on each axis of a grid, in all for the other designs"
    )
    lifted_points: int = _key(
        count(0), 0, says="designs of (θ, ω_S, ω_T) for the lifted formulation; 0 chooses"
    )


@dataclass(frozen=True)
class OuterSection:
    """[outer]: IPOPT starts, agreement of prediction and truth, rounds of refinement, surrogate.

    `surrogate`: the kernel of the Gaussian processes; "auto" takes, output by output, the one
    that predicts left-out samples best. `box_points`: true inner problems spread over the box of θ
    that a solve ends with a look at, those that it has solved already among them; 0: none.
    """

    starts: int = _key(count(1), 16, says="of IPOPT on the surrogates")
    direct_starts: int = _key(count(1), 4, says="of IPOPT on the true problem")
    tolerance: float = _key(
        FRACTION, 1e-3, says="to which prediction and truth have to agree, relative"
    )
    max_refinements: int = _key(count(0), 12, says="rounds of adding true samples at the optimum")
    surrogate: str = _key(
        choice("matern52", "rbf", "auto"),
        "matern52",
        says='kernel of the Gaussian processes; "auto": what predicts left-out samples best',
    )
    box_points: int = _key(
        count(0), 32, says="θ spread over the box that every solve ends with a look at; 0: none"
    )


@dataclass(frozen=True)
class BaselineSection:
    """[baseline]: the sequential design's first resonance, and the descents' steps and starts.

    `steps` are the first steps tried, as shares of the box; `starts` start points: the case's own
    and a Latin hypercube.
    """

    first_resonance_hz: float = _key(
        POSITIVE,
        250.0,
        says="of the sequential design: its first resonance is at least this",
        unit="Hz",
    )
    steps: tuple[float, ...] = _key(
        steps, (0.02, 0.05, 0.1), says="first steps that the descents try, as shares of the box"
    )
    starts: int = _key(count(1), 3, says="of the descents: the case's own and a Latin hypercube")
    max_iterations: int = _key(count(1), 100, says="of a descent")


@dataclass(frozen=True)
class LimitsSection:
    """[limits]: how long a user's plant function may take at each call, in s."""

    plant_seconds: float = _key(
        POSITIVE,
        60.0,
        says="how long a plant function of one's own may take at each call",
        unit="s",
    )


@dataclass(frozen=True)
class Case(Shown):
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
    fixed: tuple[Parameter, ...] = ()


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
