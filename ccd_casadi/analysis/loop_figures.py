"""What a loop-shaper reads first: crossover, margins, a step, and where the loop is too sharp.

Margins are of the loops cut one at a time at the plant's inputs, the least over the plants that
are given; steps are of the model and of the plants where the margins are least.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_warnings import (
    LoopWarningOptions,
    bandwidth_dip,
    dip_of,
    largest_of,
    light_poles,
    loop_warnings,
    ringing,
    second_crossover,
    second_crossover_of,
)
from ccd_casadi.lti.loop import Loop, constant_drive
from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import (
    ClassicalMargins,
    classical_margins,
    least_margins,
    least_of,
)


@dataclass(frozen=True)
class LoopFigureOptions:
    """Numbers of the simulated steps.

    Attributes
    ----------
    periods : float
        Of ω_b that a step is followed for closely.
    coarser, fewer : int
        Beyond, instants are this many times as far apart, and as few.
    at_rest : float
        Of the slowest part of a loop, what counts as at rest.
    per_period : int
        Points of a continuous loop's step in a period of ω_b.
    band : float
        About its end, in which a step has settled.
    decayed : float
        Of its largest displacement, what is left where a step of force has decayed.
    coupled : float
        Of what moves an output most, the least that a force moves it where it is not rounding.
    warnings : LoopWarningOptions
        Of what is warned of.
    """

    periods: float = 160.0
    coarser: int = 16
    fewer: int = 4
    at_rest: float = 1e-3
    per_period: int = 100
    band: float = 0.02
    decayed: float = 0.1
    coupled: float = 1e-6
    warnings: LoopWarningOptions = field(default_factory=LoopWarningOptions)

    @property
    def closely(self) -> int:
        """Instants that follow one another."""
        return int(self.periods * self.per_period)


@dataclass(frozen=True)
class ForceStep:
    """The largest displacement by a step of 1 N: `size` in m after `seconds`, of output `output` by
    actuator `actuator` on plant `plant`, all from 0 on; `names` of what moves and by what, with
    their numbers where there are several. `decay`: the latest time of all pairs in s at which more
    than `decayed` of the pair's largest displacement is left; inf where a force leaves more."""

    decay: float
    size: float
    seconds: float
    output: int
    actuator: int
    plant: int
    names: tuple[str, str]

    @property
    def pair(self) -> str:
        """The output and the input of the step, as `y by u`."""
        return " by ".join(self.names)

    def entry(self, scalar: bool) -> dict[str, Any]:
        """Write the step for result.json, with the pair in words where there are several
        channels."""
        pair = {} if scalar else {"pair": self.pair}
        decay = {"decay_seconds": self.decay} if np.isfinite(self.decay) else {}
        return {"seconds": self.seconds, "plant": self.plant + 1, **decay, **pair}


def until_rest(
    loop: Loop, longest: float, seconds: float, drives: Array,
    options: LoopFigureOptions = LoopFigureOptions(), *, counted: bool = False,
) -> tuple[Array, Array]:  # fmt: skip
    """Times (k,) in s and y (m, p, k) from rest under each of the constant inputs `drives` (n, m),
    B_r or B_d of the loop over `longest` s; exact at the instants. `counted`: y is what a force
    moves.

    The first instants follow one another, as the options have it; from there on, to `seconds`, they
    are `coarser` times as far apart, and so on: what is fast has decayed by then.
    """
    steps, count = loop.over_a_step(longest), options.closely
    if counted:
        steps = replace(steps, C_y=steps.GS.C)
    n, period, first = len(steps.A), steps.period or longest, 0
    P = np.eye(n + drives.shape[1])
    P[:n, :n], P[:n, n:] = steps.A, drives
    times, found = [], []
    while True:
        coarse = replace(steps, A=P[:n, :n])
        y = np.array([constant_drive(coarse, drive, count + 1) for drive in P[:n, n:].T])
        times.append(period * np.arange(first, count + 1))
        found.append(y[:, :, first:])
        if period * count >= seconds:
            return np.concatenate(times), np.concatenate(found, axis=2)
        reached, count = period * count, options.closely // options.fewer
        P, period = np.linalg.matrix_power(P, options.coarser), options.coarser * period
        first = int(reached / period + 0.5) + 1


def rest_time(loop: Loop, options: LoopFigureOptions = LoopFigureOptions()) -> float:
    """Time after which a stable loop is at rest, by its slowest part.

    Parameters
    ----------
    loop : Loop
        Closed.
    options : LoopFigureOptions
        Which share of it is at rest.

    Returns
    -------
    float
        s.
    """
    return float(np.log(1.0 / options.at_rest) / max(-loop.poles.real.max(), 1e-300))


def step_figures(
    loop: Loop, bandwidth: float, options: LoopFigureOptions = LoopFigureOptions()
) -> tuple[float, float]:
    """Compute the worst overshoot and the worst settling time to 2 % of unit steps of the
    references, s; inf: the simulation ends before."""
    longest = HZ / bandwidth / options.per_period
    drives = loop.over_a_step(longest).B_r
    times, found = until_rest(loop, longest, rest_time(loop, options), drives, options)
    own = np.array([y[i] for i, y in enumerate(found)])
    last = [np.flatnonzero(np.abs(y - 1.0) > options.band) for y in own]
    ends = np.append(times, np.inf)
    settling = max(float(ends[outside[-1] + 1]) if len(outside) else 0.0 for outside in last)
    return float(own.max()) - 1.0, settling


def force_response(
    loop: Loop, bandwidth: float, seconds: float,
    options: LoopFigureOptions = LoopFigureOptions(),
) -> tuple[Array, Array]:  # fmt: skip
    """Displacement after a step of 1 N at each actuator in turn.

    Parameters
    ----------
    loop : Loop
        Closed, SI.
    bandwidth, seconds : float
        ω_b in rad/s, and how long.
    options : LoopFigureOptions
        Its instants.

    Returns
    -------
    times, y : (k,), (m, p, k) array
        s and m.
    """
    longest = HZ / bandwidth / options.per_period
    drives = loop.over_a_step(longest).B_d
    return until_rest(loop, longest, seconds, drives, options, counted=True)


def largest_force_step(
    loops: Sequence[Loop], bandwidth: float, options: LoopFigureOptions = LoopFigureOptions()
) -> ForceStep:
    """The largest displacement by a step of 1 N, of every plant, actuator and output.

    Parameters
    ----------
    loops : sequence of Loop
        Closed and stable, SI, one for each plant.
    bandwidth : float
        ω_b in rad/s.
    options : LoopFigureOptions
        Instants, and when a loop is at rest.

    Returns
    -------
    ForceStep
        Until the loop is at rest.
    """
    found = []
    for plant, loop in enumerate(loops):
        times, y = force_response(loop, bandwidth, rest_time(loop, options), options)
        each = np.abs(y).max(axis=2, keepdims=True)
        left = np.abs(y) > np.maximum(options.decayed * each, options.coupled * each.max(axis=0))
        last = int(np.flatnonzero(left.any(axis=(0, 1)))[-1])
        decay = float(times[last]) if last + 1 < len(times) else np.inf
        actuator, output, k = map(int, np.unravel_index(np.abs(y).argmax(), y.shape))
        size = abs(float(y[actuator, output, k]))
        moved = f"{loop.names[0]} {output + 1}"
        if loop.at and loop.names[0] == Loop.names[0]:
            moved = f"channel {loop.at[0].name}"  # whose error counts
        names = moved, f"{loop.names[1]} {actuator + 1}"
        found.append(ForceStep(decay, size, float(times[k]), output, actuator, plant, names))
    largest = max(found, key=lambda step: step.size)
    return replace(largest, decay=max(step.decay for step in found))


def compliance_of(loops: Sequence[Loop], omega_low: float) -> tuple[float, float, float, float]:
    """Compute what disturbing forces move, the largest of all loops.

    Parameters
    ----------
    loops : sequence of Loop
        Closed and stable, SI.
    omega_low : float
        The lowest frequency that counts, rad/s.

    Returns
    -------
    most, at_rest, low, low_hz : float
        m/N, over frequency, at rest and at ω_low, and that in Hz.
    """
    at, rest = np.array([omega_low]), np.zeros(1)
    low = max(float(sigma_max(one.force_responses(at))[0]) for one in loops)
    held = max(float(sigma_max(one.closed.GS.response(rest))[0]) for one in loops)
    return max(one.compliance for one in loops), held, low, omega_low / HZ


def step_response(loop: Loop, direction: Array, seconds: float, points: int) -> tuple[Array, Array]:
    """The response to a unit step of the reference, exact at the instants.

    Parameters
    ----------
    loop : Loop
        Closed, SI.
    direction : (p,) array
        Of the reference.
    seconds : float
        How long.
    points : int
        Of a continuous loop; a sampled one has its own instants.

    Returns
    -------
    times, y : (k,), (k, p) array
        s and the unit of y.
    """
    steps = loop.over_a_step(seconds / (points - 1))
    count = points if loop.sampling is None else int(np.ceil(seconds / steps.period)) + 1
    y = constant_drive(steps, steps.B_r @ direction, count)
    return np.asarray(np.arange(count) * steps.period), y.T


def measured_entry(
    loops: Sequence[tuple[Array, np.ndarray, Array]], controller: StateSpace, bandwidth: float,
    sensitivity_peak: float, options: LoopFigureOptions = LoopFigureOptions(),
) -> dict[str, Any]:  # fmt: skip
    """Write the entry of `loop_entry` for loops that are known at frequencies alone, without steps.

    Between lines ln|L| and its phase are straight over ln ω.

    Parameters
    ----------
    loops : sequence of (ω, L, |G|)
        (k,) in rad/s, L (k,) there, and (k,) the size of the plant's response there.
    controller : StateSpace
        SI.
    bandwidth, sensitivity_peak : float
        ω_b in rad/s, and ‖S‖∞.
    options : LoopFigureOptions
        Of steps and warnings.

    Returns
    -------
    dict
        Keys of result.json.
    """
    margins, growth, sizes, again = [], 1.0, [], []
    for omega, L, plant in loops:
        x, ln_L = np.log(omega), np.log(np.abs(L)) + 1j * np.unwrap(np.angle(L))

        def response(w: Array, x: Array = x, ln_L: np.ndarray = ln_L) -> np.ndarray:
            return np.exp(np.interp(np.log(w), x, ln_L))

        margins.append(classical_margins(response, omega))
        at = margins[-1].crossover
        again.append(
            second_crossover(
                omega, L, plant, at, light_poles(controller, options.warnings), options.warnings
            )
        )
        S = np.abs(1.0 / (1.0 + response(bandwidth * options.warnings.above)))
        growth = max(growth, float((S / S[0]).max()))
        sizes.append(np.abs(1.0 / (1.0 + response(bandwidth * options.warnings.places))))
    return _entry(least_of(margins), sensitivity_peak) | {
        "loop_warnings": loop_warnings(
            growth,
            dip_of(sizes, options.warnings),
            controller,
            bandwidth,
            None,
            largest_of(again),
            options.warnings,
        )
    }


def _entry(margins: ClassicalMargins, sensitivity_peak: float) -> dict[str, Any]:
    return {
        "crossover_hz": margins.crossover / HZ,
        "phase_margin_deg": margins.phase_deg,
        "gain_margin": gain_margin(margins),
        "delay_margin_us": 1e6 * margins.delay,
        "modulus_margin": 1.0 / sensitivity_peak,
    }


def gain_margin(margins: ClassicalMargins) -> float:
    """The least factor, up or down, at which stability is lost."""
    return min(margins.gain_up, 1.0 / margins.gain_down if margins.gain_down else np.inf)


def loop_entry(
    loops: Sequence[Loop],
    bandwidth: float,
    sensitivity_peak: float,
    options: LoopFigureOptions = LoopFigureOptions(),
) -> dict[str, Any]:
    """Margins, steps and warnings of a stable loop under the keys of result.json.

    The least margins of all plants, with the crossover of the model, and 1/‖S‖∞ as the modulus
    margin; the worst step of a reference where they are least, that of a force of all.

    Parameters
    ----------
    loops : sequence of Loop
        As they run, the model's first, SI; margins are the least of all places of a loop.
    bandwidth, sensitivity_peak : float
        ω_b in rad/s, and ‖S‖∞.
    options : LoopFigureOptions
        Of steps and warnings.

    Returns
    -------
    dict
        JSON values.
    """
    controller = loops[0].controller
    margins = [least_of([least_margins(one.responses, one.grid()) for one in loop.places])
               for loop in loops]  # fmt: skip
    gain = [gain_margin(m) for m in margins]
    worst = {0, int(np.argmin([m.phase_deg for m in margins])), int(np.argmin(gain))}
    steps = [step_figures(loops[i], bandwidth, options) for i in sorted(worst)]
    overshoot, settling = map(max, zip(*steps, strict=True))
    force = largest_force_step(loops, bandwidth, options)
    above = bandwidth * options.warnings.above
    sizes = [np.linalg.norm(loop.sensitivity(above), 2, axis=(1, 2)) for loop in loops]
    growth = max(float((size / size[0]).max()) for size in sizes)
    poles = np.concatenate([loop.poles for loop in loops])
    rings = ringing(poles, bandwidth, options.warnings.ringing)
    dip = bandwidth_dip(loops, bandwidth, options.warnings)
    again = largest_of([second_crossover_of(loop, options.warnings) for loop in loops])
    warnings = loop_warnings(growth, dip, controller, bandwidth, rings, again, options.warnings)
    least = replace(least_of(margins), crossover=margins[0].crossover)
    return _entry(least, sensitivity_peak) | {
        "step_overshoot": overshoot,
        "settling_ms": 1e3 * settling,
        "force_step_max": force.size,
        "force_step_at": force.entry(
            loops[0].plant.D.shape == (1, 1) and loops[0].names == Loop.names
        ),
        "loop_warnings": warnings,
    }
