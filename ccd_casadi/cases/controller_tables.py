"""[controller] and [loop] of a case file: what the controller is, and how it runs; and [sampling],
[outer], [baseline] and [limits]: how a run goes about it."""

import math
from dataclasses import dataclass

from ccd_casadi.cases.checks import (
    FRACTION,
    POSITIVE,
    choice,
    count,
    direction,
    flag,
    key,
    number,
    steps,
    table,
    text,
)


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
        direction, None, says="the channel's measurement as weights of the plant's outputs"
    )
    inputs: tuple[float, ...] | None = key(
        direction,
        None,
        says="the channel's force as weights of the plant's inputs; default: as outputs",
    )
    like: str | None = key(text, None, says="another channel: both have one controller")
    integrator: bool | None = key(flag, None, says="instead of [controller]'s")
    lead: int | None = key(count(0), None, says="instead of [controller]'s")
    biquads: int | None = key(count(0), None, says="instead of [controller]'s")
    roll_off: int | None = key(count(0), None, says="instead of [controller]'s")
    least_damping: float | None = key(
        number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True),
        None,
        says="instead of [controller]'s",
    )
    S_max: float | None = key(
        number(1.0, math.inf, "give more than 1, at most [inner]'s S_max"),
        None,
        says="bound of the peak of this channel's S, tighter than the whole loop's in [inner]",
    )
    M_K: float | None = key(
        POSITIVE,
        None,
        says="M_K of this channel's W_KS, lower than that of [weights]: its force counts more",
        unit="N/m",
    )
    bandwidth_ratio: float = key(
        number(1.0, 1000.0, "give 1 or more: ω_b is that of the slowest channel", closed=True),
        1.0,
        says="least ratio of this channel's bandwidth to ω_b, which is that of the slowest channel",
    )


@dataclass(frozen=True)
class ControllerTable:
    """[controller]: "h_infinity", of full order by mixed sensitivity, "h_infinity_disturbance",
    of full order with an input disturbance beside the reference, or "sections".

    The sections: an integrator, `lead` first-order leads, `biquads` (each a pair of zeros and one
    of poles), a roll-off of order `roll_off`. |W_KS KS| and |W_T T| stay below `weighted_level`.
    The search starts at `starts` places. `channel` overrides the structure of single channels.
    """

    structure: str = key(
        choice("h_infinity", "h_infinity_disturbance", "sections"),
        "h_infinity",
        says="mixed sensitivity, the same with an input disturbance, or a fixed structure",
    )
    integrator: bool = key(flag, True, says="sections: whether K has an integrator with a zero")
    lead: int = key(count(0), 1, says="sections: number of first-order leads")
    biquads: int = key(
        count(0),
        2,
        says="sections: number of biquads, pairs of zeros and poles: notches, skewed notches",
    )
    roll_off: int = key(count(0), 2, says="sections: order of the roll-off")
    weighted_level: float | None = key(
        POSITIVE,
        None,
        says="sections: bound of |W_KS KS| and |W_T T|; absent: no bound, which results report",
    )
    least_damping: float = key(
        number(0.0, 1.0, "give a damping ratio from 0 to below 1", closed=True),
        0.0,
        says="sections: least damping ratio of zeros and poles",
    )
    starts: int = key(count(1), 12, says="sections: number of starts of the search")
    channel: tuple[tuple[str, ChannelTable], ...] = key(
        table, (), says="tables [controller.channel.NAME] for plants with several outputs"
    )


@dataclass(frozen=True)
class LoopTable:
    """[loop]: sampled with a hold at `rate_hz`; `delay_us` from measurement to force."""

    rate_hz: float | None = key(
        POSITIVE,
        None,
        says="sections: sampling rate of the loop, with a hold; absent: continuous",
        unit="Hz",
    )
    delay_us: float = key(
        number(0.0, 1e6, "give 0 to 1e6", closed=True),
        0.0,
        says="delay from reading the sensor to the new force",
        unit="µs",
    )


@dataclass(frozen=True)
class SamplingTable:
    """[sampling]: the offline design over θ; points per axis for grid, in all for the others.

    `lifted_points` designs of (θ, ω_S, ω_T) are sampled for the lifted formulation; 0 chooses.
    """

    design: str = key(choice("grid", "sobol", "lhs"), "grid", says="sampling plan over θ")
    points: int = key(
        count(2), 5, says="number of θ: along each axis of a grid, in total for other plans"
    )
    lifted_points: int = key(
        count(0), 0, says="number of designs (θ, ω_S, ω_T) for lifted; 0: chosen by the program"
    )


@dataclass(frozen=True)
class OuterTable:
    """[outer]: IPOPT starts, agreement of prediction and truth, rounds of refinement, surrogate.

    `surrogate`: the kernel of the Gaussian processes; "auto" takes, output by output, the one
    that predicts left-out samples best. `box_points`: true inner problems spread over the box of θ
    that a solve ends with a look at, those that it has solved already among them; 0: none.
    """

    starts: int = key(count(1), 16, says="starts of IPOPT on the surrogates")
    direct_starts: int = key(count(1), 4, says="local solves on the true problem")
    tolerance: float = key(
        FRACTION, 1e-3, says="largest relative difference of prediction and truth"
    )
    max_refinements: int = key(count(0), 12, says="most rounds of adding true samples")
    surrogate: str = key(
        choice("matern52", "rbf", "auto"),
        "matern52",
        says='kernel of the Gaussian processes; "auto": the one with the least left-out error',
    )
    box_points: int = key(
        count(0), 32, says="number of θ over the box in the global check at the end; 0: no check"
    )


@dataclass(frozen=True)
class BaselineTable:
    """[baseline]: the sequential design's first resonance, and the descents' steps and starts.

    `steps` are the first steps tried, as shares of the box; `starts` start points: the case's own
    and a Latin hypercube.
    """

    first_resonance_hz: float = key(
        POSITIVE, 250.0, says="least first resonance of the sequential design", unit="Hz"
    )
    steps: tuple[float, ...] = key(
        steps, (0.02, 0.05, 0.1), says="first steps of the descents, as shares of the box"
    )
    starts: int = key(count(1), 3, says="starts of the descents: the case's own, a Latin hypercube")
    max_iterations: int = key(count(1), 100, says="most iterations of a descent")


@dataclass(frozen=True)
class LimitsTable:
    """[limits]: how long a user's plant function may take at each call, in s."""

    plant_seconds: float = key(
        POSITIVE, 60.0, says="time limit of each call of your own plant function", unit="s"
    )
