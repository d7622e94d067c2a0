"""What a loop-shaper reads first: crossover, margins, a step, and where the loop is too sharp.

Margins are of the loops cut one at a time at the plant's inputs, the least over the plants that
are given; steps are of the model and of the plants where the margins are least.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_view import frequency_and_damping
from ccd_casadi.lti.loop import Loop, Sampling, constant_drive
from ccd_casadi.lti.state_space import StateSpace, equivalent_open_loop
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
    """Numbers of steps and warnings.

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
    octaves : float
        Above ω_b, within which growth of |S| is a warning.
    growth : float
        That growth.
    dip : float
        Of ω_b, that a dip of |S| adds: a warning.
    light : float
        Damping of a root of K within `near` of ω_b that is a warning; less than the bound 0.1.
    near : float
        Relative.
    ringing : float
        Damping of a root of the loop within an octave of ω_b: 2 % are left after 12 periods.
    reach : float
        Factor to both sides of a range of frequencies, within which a resonance of the plant is.
    around : int
        Points within an octave of ω_b, on both sides: 0.7 % apart.
    """

    periods: float = 160.0
    coarser: int = 16
    fewer: int = 4
    at_rest: float = 1e-3
    per_period: int = 100
    band: float = 0.02
    octaves: float = 0.1
    growth: float = 1.5
    dip: float = 0.03
    light: float = 0.1 * (1.0 - 1e-6)
    near: float = 0.2
    ringing: float = 0.05
    reach: float = 1.25
    around: int = 201

    @property
    def closely(self) -> int:
        """Instants that follow one another."""
        return int(self.periods * self.per_period)

    @property
    def places(self) -> Array:
        """ω/ω_b around the bandwidth."""
        return np.asarray(2.0 ** np.linspace(-1.0, 1.0, self.around))

    @property
    def above(self) -> Array:
        """ω/ω_b where growth of |S| is measured."""
        return np.asarray(2.0 ** np.linspace(0.0, self.octaves, 30))


@dataclass(frozen=True)
class ForceStep:
    """The largest displacement by a step of 1 N: `size` in m after `seconds`, of output `output` by
    actuator `actuator` on plant `plant`, all from 0 on."""

    size: float
    seconds: float
    output: int
    actuator: int
    plant: int

    @property
    def pair(self) -> str:
        """Counted from 1, as a reader does."""
        return f"output {self.output + 1} by actuator {self.actuator + 1}"

    def entry(self, scalar: bool) -> dict[str, Any]:
        """Of result.json; of several channels with the pair in words."""
        pair = {} if scalar else {"pair": self.pair}
        return {"seconds": self.seconds, "plant": self.plant + 1, **pair}


def until_rest(
    loop: Loop, longest: float, seconds: float, drives: Array,
    options: LoopFigureOptions = LoopFigureOptions(),
) -> tuple[Array, Array]:  # fmt: skip
    """Times (k,) in s and y (m, p, k) from rest under each of the constant inputs `drives` (n, m),
    B_r or B_d of the loop over `longest` s; exact at the instants.

    The first instants follow one another, as the options have it; from there on, to `seconds`, they
    are `coarser` times as far apart, and so on: what is fast has decayed by then.
    """
    steps, count = loop.over_a_step(longest), options.closely
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
    """Of a unit step of each reference in turn the worst: the overshoot, and the last time outside
    2 % in s (inf: it ends there)."""
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
    return until_rest(loop, longest, seconds, loop.over_a_step(longest).B_d, options)


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
        actuator, output, k = map(int, np.unravel_index(np.abs(y).argmax(), y.shape))
        size = abs(float(y[actuator, output, k]))
        found.append(ForceStep(size, float(times[k]), output, actuator, plant))
    return max(found, key=lambda step: step.size)


def ringing(
    poles: np.ndarray, bandwidth: float, least: float = LoopFigureOptions().ringing
) -> tuple[float, float] | None:
    """Frequency in rad/s and damping of the least damped of `poles` within an octave of ω_b, if
    that damping is below the `least`."""
    found = zip(*frequency_and_damping(poles), strict=True)
    near = [(float(w), float(d)) for w, d in found if bandwidth <= 2.0 * w <= 4.0 * bandwidth]
    return min((root for root in near if root[1] < least), key=lambda r: r[1], default=None)


def light_roots(
    controller: StateSpace, bandwidth: float, options: LoopFigureOptions = LoopFigureOptions()
) -> tuple[tuple[float, float, str], ...]:
    """Poles and zeros of K that are lightly damped and near ω_b, ascending."""
    return tuple(sorted(
        (float(w), float(d), word)
        for word, roots in (("zero", controller.zeros(bandwidth)), ("pole", controller.poles))
        for w, d in zip(*frequency_and_damping(roots), strict=True)
        if abs(w / bandwidth - 1.0) <= options.near and abs(d) < options.light
    ))  # fmt: skip


def bandwidth_dip(
    loops: Sequence[Loop], bandwidth: float, options: LoopFigureOptions = LoopFigureOptions()
) -> float:
    """By which factor the largest σ_max(S) is above the line ω/(√2 ω_b) on both sides of it, within
    an octave; at least 1."""
    places = bandwidth * options.places
    return _dip([np.linalg.norm(one.sensitivity(places), 2, (1, 2)) for one in loops], options)


def _dip(sizes: Sequence[Array], options: LoopFigureOptions = LoopFigureOptions()) -> float:
    """The same of σ_max(S) of every loop at the `places` around ω_b.

    A pair of a zero and a pole beside ω_b makes such a dip: without it ω_b is lower by about that
    factor. |S| that rises more slowly than ω throughout, or faster, has none.
    """
    slope = np.sqrt(2.0) * np.max(sizes, axis=0) / options.places
    middle = options.around // 2
    return max(1.0, min(float(slope[:middle].max()), float(slope[middle + 1 :].max())))


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


@dataclass(frozen=True)
class SecondCrossover:
    """Frequencies `low` to `high` in rad/s above the crossover, where |L| exceeds 1 again, by
    `peak` at most, and the plant does not raise it."""

    low: float
    high: float
    peak: float


def second_crossover(
    omega: Array, L: np.ndarray, plant: Array, crossover: float, light: Array,
    options: LoopFigureOptions = LoopFigureOptions(),
) -> SecondCrossover | None:  # fmt: skip
    """Find where the controller takes |L| above 1 again beyond the crossover.

    A resonance of the plant that takes |L| above 1 is common practice where its phase is known. In
    such a range |G| has its largest value inside, not at an end. Elsewhere, or beside a lightly
    damped pole of K, the controller raises |L|: stability then rests on the plant's gain and phase
    at frequencies that the bandwidth does not need, and for which the model is rarely made.

    Parameters
    ----------
    omega : (n,) array
        Ascending, rad/s.
    L : (n,) array
        The loop that is cut at one actuator or sensor, complex.
    plant : (n,) array
        |G| there: of that actuator over all outputs, or of that sensor over all actuators.
    crossover : float
        In rad/s, as `ClassicalMargins` has it.
    light : array
        Frequencies in rad/s of lightly damped poles of K.
    options : LoopFigureOptions

    Returns
    -------
    SecondCrossover or None
        The one with the largest peak.
    """
    if not np.isfinite(crossover):
        return None
    size = np.where(omega > crossover, np.abs(L), 0.0)
    inside = np.concatenate([[False], size > 1.0, [False]])
    first, end = np.flatnonzero(np.diff(inside.astype(int))).reshape(-1, 2).T
    # the crossover lies between two points of the grid: what is above 1 from there on is no return
    returns = [(a, b) for a, b in zip(first, end, strict=True) if omega[a - 1] > crossover]
    found = []
    for a, b in returns:
        low, high = omega[a], omega[b - 1]
        own = ((light > low * (1.0 - options.near)) & (light < high * (1.0 + options.near))).any()
        around = (omega >= low / options.reach) & (omega <= high * options.reach)
        top = plant[around].argmax()
        resonance = 0 < top < np.count_nonzero(around) - 1
        if own or not resonance:
            found.append(SecondCrossover(float(low), float(high), float(size[a:b].max())))
    return max(found, key=lambda one: one.peak, default=None)


def light_poles(
    controller: StateSpace, options: LoopFigureOptions = LoopFigureOptions()
) -> Array:  # fmt: skip
    """Frequencies in rad/s of the poles of K with less damping than `light`."""
    w, damping = frequency_and_damping(controller.poles)
    return np.asarray(w[np.abs(damping) < options.light])


def _second_crossover_of(loop: Loop, options: LoopFigureOptions) -> SecondCrossover | None:
    """The largest of the loops that are cut one at a time at the plant's inputs."""
    omega, light = loop.grid(), light_poles(loop.controller, options)
    G, K = loop.responses(omega)
    found = []
    for i in range(G.shape[2]):
        L = equivalent_open_loop(K @ G, i)
        at = classical_margins(partial(_cut, loop, i), omega).crossover
        sizes = np.linalg.norm(G[:, :, i], axis=1)
        found.append(second_crossover(omega, L, sizes, at, light, options))
    return _largest(found)


def _cut(loop: Loop, i: int, omega: Array) -> np.ndarray:
    G, K = loop.responses(omega)
    return equivalent_open_loop(K @ G, i)


def _largest(found: Sequence[SecondCrossover | None]) -> SecondCrossover | None:
    return max((one for one in found if one), key=lambda one: one.peak, default=None)


def loop_warnings(
    growth: float, dip: float, controller: StateSpace, bandwidth: float,
    rings: tuple[float, float] | None = None,
    again: SecondCrossover | None = None,
    options: LoopFigureOptions = LoopFigureOptions(),
) -> list[str]:  # fmt: skip
    """What an engineer would not build, in words: ω_b that is held by something narrow, or rings,
    or |L| that the controller takes above 1 again.

    `growth`: the largest factor by which σ_max(S) grows within a tenth of an octave above ω_b.
    `dip`: as `bandwidth_dip` has it.
    """
    hz = bandwidth / HZ
    words = []
    if growth > options.growth:
        words.append(
            f"|S| grows by a factor of {growth:.3g} within a tenth of an octave above "
            f"{hz:.4g} Hz: the bandwidth is held by something narrow"
        )
    if dip > 1.0 + options.dip:
        words.append(
            f"|S|/frequency dips by {100.0 * (1.0 - 1.0 / dip):.2g} % at the bandwidth: a filter "
            f"there buys it, and {hz / dip:.4g} Hz would be left without"
        )
    words += [
        f"the controller has a {word} at {w / HZ:.4g} Hz with damping {d:.3g}, within 20 % of the "
        f"bandwidth"
        for w, d, word in light_roots(controller, bandwidth, options)
    ]
    if rings is not None:
        words.append(
            f"the closed loop rings at {rings[0] / HZ:.4g} Hz with damping {rings[1]:.3g}, within "
            "an octave of the bandwidth"
        )
    if again is not None:
        words.append(
            f"|L| exceeds 1 again from {again.low / HZ:.4g} to {again.high / HZ:.4g} Hz, by "
            f"{again.peak:.3g} at most: the controller raises it, by a light pole of its own or "
            "where the plant has no resonance"
        )
    return words


def measured_entry(
    loops: Sequence[tuple[Array, np.ndarray, Array]], controller: StateSpace, bandwidth: float,
    sensitivity_peak: float, options: LoopFigureOptions = LoopFigureOptions(),
) -> dict[str, Any]:  # fmt: skip
    """As `loop_entry`, of loops that are known on lines of frequency; without steps.

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
        again.append(second_crossover(omega, L, plant, at, light_poles(controller), options))
        S = np.abs(1.0 / (1.0 + response(bandwidth * options.above)))
        growth = max(growth, float((S / S[0]).max()))
        sizes.append(np.abs(1.0 / (1.0 + response(bandwidth * options.places))))
    return _entry(least_of(margins), sensitivity_peak) | {
        "loop_warnings": loop_warnings(
            growth, _dip(sizes, options), controller, bandwidth, None, _largest(again), options
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
    plants: Sequence[StateSpace],
    controller: StateSpace,
    sampling: Sampling | None,
    bandwidth: float,
    sensitivity_peak: float,
    options: LoopFigureOptions = LoopFigureOptions(),
) -> dict[str, Any]:
    """Margins, steps and warnings of a stable loop under the keys of result.json.

    The least margins of all plants, with the crossover of the model, and 1/‖S‖∞ as the modulus
    margin; the worst step of a reference where they are least, that of a force of all.

    Parameters
    ----------
    plants : sequence of StateSpace
        The model first, SI.
    controller : StateSpace
        e in, u out, SI.
    sampling : Sampling or None
        How the loop runs.
    bandwidth, sensitivity_peak : float
        ω_b in rad/s, and ‖S‖∞.
    options : LoopFigureOptions
        Of steps and warnings.

    Returns
    -------
    dict
        JSON values.
    """
    loops = [Loop(plant, controller, sampling) for plant in plants]
    margins = [least_margins(loop.responses, loop.grid()) for loop in loops]
    gain = [gain_margin(m) for m in margins]
    worst = {0, int(np.argmin([m.phase_deg for m in margins])), int(np.argmin(gain))}
    steps = [step_figures(loops[i], bandwidth, options) for i in sorted(worst)]
    overshoot, settling = map(max, zip(*steps, strict=True))
    force = largest_force_step(loops, bandwidth, options)
    above = bandwidth * options.above
    sizes = [np.linalg.norm(loop.sensitivity(above), 2, axis=(1, 2)) for loop in loops]
    growth = max(float((size / size[0]).max()) for size in sizes)
    poles = np.concatenate([loop.poles for loop in loops])
    rings = ringing(poles, bandwidth, options.ringing)
    dip = bandwidth_dip(loops, bandwidth, options)
    again = _largest([_second_crossover_of(loop, options) for loop in loops])
    warnings = loop_warnings(growth, dip, controller, bandwidth, rings, again, options)
    least = replace(least_of(margins), crossover=margins[0].crossover)
    return _entry(least, sensitivity_peak) | {
        "step_overshoot": overshoot,
        "settling_ms": 1e3 * settling,
        "force_step_max": force.size,
        "force_step_at": force.entry(loops[0].plant.D.shape == (1, 1)),
        "loop_warnings": warnings,
    }
