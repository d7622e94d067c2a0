"""What an engineer would not build though it keeps its bounds: a bandwidth that something narrow
holds, a loop that rings, and |L| that the controller takes above 1 again beyond the crossover."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ccd_casadi.analysis.loop_view import frequency_and_damping
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace, equivalent_open_loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import classical_margins


@dataclass(frozen=True)
class LoopWarningOptions:
    """Thresholds of the warnings about a loop.

    Attributes
    ----------
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

    octaves: float = 0.1
    growth: float = 1.5
    dip: float = 0.03
    light: float = 0.1 * (1.0 - 1e-6)
    near: float = 0.2
    ringing: float = 0.05
    reach: float = 1.25
    around: int = 201

    @property
    def places(self) -> Array:
        """ω/ω_b around the bandwidth."""
        return np.asarray(2.0 ** np.linspace(-1.0, 1.0, self.around))

    @property
    def above(self) -> Array:
        """ω/ω_b where growth of |S| is measured."""
        return np.asarray(2.0 ** np.linspace(0.0, self.octaves, 30))


def ringing(
    poles: np.ndarray, bandwidth: float, least: float = LoopWarningOptions().ringing
) -> tuple[float, float] | None:
    """Frequency in rad/s and damping of the least damped of `poles` within an octave of ω_b, if
    that damping is below the `least`."""
    found = zip(*frequency_and_damping(poles), strict=True)
    near = [(float(w), float(d)) for w, d in found if bandwidth <= 2.0 * w <= 4.0 * bandwidth]
    return min((root for root in near if root[1] < least), key=lambda r: r[1], default=None)


def light_roots(
    controller: StateSpace, bandwidth: float, options: LoopWarningOptions = LoopWarningOptions()
) -> tuple[tuple[float, float, str], ...]:
    """Poles and zeros of K that are lightly damped and near ω_b, ascending."""
    return tuple(sorted(
        (float(w), float(d), word)
        for word, roots in (("zero", controller.zeros(bandwidth)), ("pole", controller.poles))
        for w, d in zip(*frequency_and_damping(roots), strict=True)
        if abs(w / bandwidth - 1.0) <= options.near and abs(d) < options.light
    ))  # fmt: skip


def bandwidth_dip(
    loops: Sequence[Loop], bandwidth: float, options: LoopWarningOptions = LoopWarningOptions()
) -> float:
    """Compute the factor, at least 1, by which max σ_max(S) exceeds the line ω/(√2 ω_b) on both
    sides of it, within an octave."""
    places = bandwidth * options.places
    return dip_of([np.linalg.norm(one.sensitivity(places), 2, (1, 2)) for one in loops], options)


def dip_of(sizes: Sequence[Array], options: LoopWarningOptions = LoopWarningOptions()) -> float:
    """The same of σ_max(S) of every loop at the `places` around ω_b.

    A pair of a zero and a pole beside ω_b makes such a dip: without it ω_b is lower by about that
    factor. |S| that rises more slowly than ω throughout, or faster, has none.
    """
    slope = np.sqrt(2.0) * np.max(sizes, axis=0) / options.places
    middle = options.around // 2
    return max(1.0, min(float(slope[:middle].max()), float(slope[middle + 1 :].max())))


@dataclass(frozen=True)
class SecondCrossover:
    """Frequencies `low` to `high` in rad/s above the crossover, where |L| exceeds 1 again, by
    `peak` at most, and the plant does not raise it."""

    low: float
    high: float
    peak: float


def second_crossover(
    omega: Array, L: np.ndarray, plant: Array, crossover: float, light: Array,
    options: LoopWarningOptions = LoopWarningOptions(),
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
    options : LoopWarningOptions

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
    controller: StateSpace, options: LoopWarningOptions = LoopWarningOptions()
) -> Array:  # fmt: skip
    """Frequencies in rad/s of the poles of K with less damping than `light`."""
    w, damping = frequency_and_damping(controller.poles)
    return np.asarray(w[np.abs(damping) < options.light])


def second_crossover_of(loop: Loop, options: LoopWarningOptions) -> SecondCrossover | None:
    """The largest of the loops that are cut one at a time at the plant's inputs."""
    omega, light = loop.grid(), light_poles(loop.controller, options)
    G, K = loop.responses(omega)
    found = []
    for i in range(G.shape[2]):
        L = equivalent_open_loop(K @ G, i)
        at = classical_margins(partial(_cut, loop, i), omega).crossover
        sizes = np.linalg.norm(G[:, :, i], axis=1)
        found.append(second_crossover(omega, L, sizes, at, light, options))
    return largest_of(found)


def _cut(loop: Loop, i: int, omega: Array) -> np.ndarray:
    G, K = loop.responses(omega)
    return equivalent_open_loop(K @ G, i)


def largest_of(found: Sequence[SecondCrossover | None]) -> SecondCrossover | None:
    return max((one for one in found if one), key=lambda one: one.peak, default=None)


def loop_warnings(
    growth: float, dip: float, controller: StateSpace, bandwidth: float,
    rings: tuple[float, float] | None = None,
    again: SecondCrossover | None = None,
    options: LoopWarningOptions = LoopWarningOptions(),
) -> list[str]:  # fmt: skip
    """Warn in words of what an engineer would not build: an ω_b that something narrow holds,
    ringing, or a |L| that the controller raises above 1 again.

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
            f"|L| exceeds 1 again from {again.low / HZ:.4g} to {again.high / HZ:.4g} Hz, and is "
            f"{again.peak:.3g} there at most: the controller raises it, by a light pole of its own "
            "or where the plant has no resonance"
        )
    return words
