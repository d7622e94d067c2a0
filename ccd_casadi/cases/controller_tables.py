"""[controller] and [loop] of a case file: what the controller is, and how it runs; and [sampling],
[outer], [baseline] and [limits]: how a run goes about it."""

import math
from dataclasses import dataclass

from ccd_casadi.cases import checks
from ccd_casadi.cases.checks import key


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
    S_max: float | None = key(
        "bound of the peak of this channel's S, tighter than the whole loop's in [inner]",
        None,
        check=checks.number(1.0, math.inf, "give more than 1, at most [inner]'s S_max"),
    )
    M_K: float | None = key(
        "M_K of this channel's W_KS, lower than that of [weights]: its force counts more",
        None,
        unit="N/m",
    )
    bandwidth_ratio: float = key(
        "least ratio of this channel's bandwidth to ω_b, which is that of the slowest channel",
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
    biquads: int = key(
        "sections: number of biquads, pairs of zeros and poles: notches, skewed notches", 2
    )
    roll_off: int = key("sections: order of the roll-off", 2)
    weighted_level: float | None = key(
        "sections: bound of |W_KS KS| and |W_T T|; absent: no bound, which results report", None
    )
    least_damping: float = key(
        "sections: least damping ratio of zeros and poles", 0.0, check=checks.DAMPING
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
    """[loop]: sampled with a hold at `rate_hz`; `delay_us` from measurement to force."""

    rate_hz: float | None = key(
        "sections: sampling rate of the loop, with a hold; absent: continuous", None
    )
    delay_us: float = key(
        "delay from reading the sensor to the new force",
        0.0,
        check=checks.number(0.0, 1e6, "give 0 to 1e6", closed=True),
    )


@dataclass(frozen=True)
class SamplingTable:
    """[sampling]: the plan over θ."""

    design: str = key("sampling plan over θ", "grid", check=checks.choice("grid", "sobol", "lhs"))
    points: int = key(
        "number of θ: along each axis of a grid, in total for other plans", 5, check=checks.count(2)
    )
    lifted_points: int = key(
        "number of designs (θ, ω_S, ω_T) for lifted; 0: chosen by the program", 0
    )


@dataclass(frozen=True)
class OuterTable:
    """[outer]: starts, agreement of prediction and truth, rounds of refinement, global check."""

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
    box_points: int = key(
        "number of θ over the box in the global check at the end; 0: no check", 32
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
