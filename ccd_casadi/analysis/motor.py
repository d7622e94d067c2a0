"""A linear motor and the move that it makes over and over: force and heat of a cycle.

    F = g(θ) r̈,   i = F/k_f,   P = R/k_f² · 1/T_c ∫ F² dt,   T_c = duration of the move + dwell

g (m,) are the forces per unit acceleration of the output that moves: the mass, of one motor. A
longer motor has k_f, R and its own moving mass in proportion and the same peak current, so that
k_f/√R grows with √mass: F ∝ √(mass · P). A catalogue is interpolated over its moving masses.

The move has the acceleration that is required; where none is, the largest that peak current and
heat let it have. All of it is analytic in g and the mass: a step along the imaginary axis gives
derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from ccd_casadi.analysis.feedforward import feedforward_slopes
from ccd_casadi.analysis.move_limits import MoveLimits
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

STEP = 1e-30  # along the imaginary axis
UNLIMITED = 1e12  # A: a peak current that is none
HELD = 1e-6  # of the moving force: a plant that holds its output by more has a spring


@dataclass(frozen=True)
class Motor:
    """One motor, or a catalogue in rising order of the moving mass: N/A, ohm, A, kg.

    `rms_power` in W of all motors together, None: any. `size` names the parameter of θ that is the
    moving mass, which is added to the plant at every input: M + mass b bᵀ.
    """

    force_constant: tuple[float, ...]
    resistance: tuple[float, ...]
    peak_current: tuple[float, ...] = (UNLIMITED,)
    moving_mass: tuple[float, ...] = (0.0,)
    rms_power: float | None = None
    size: str = ""

    def at(self, mass: Any) -> tuple[Any, Any, Any]:
        """k_f, R and the peak current of the motor with this moving mass."""
        own, columns = self.moving_mass, (self.force_constant, self.resistance, self.peak_current)
        if len(own) == 1:
            longer = mass / own[0] if self.size else 1.0
            return columns[0][0] * longer, columns[1][0] * longer, columns[2][0]
        i = int(np.clip(np.searchsorted(own, np.real(mass)) - 1, 0, len(own) - 2))
        share = (mass - own[i]) / (own[i + 1] - own[i])
        k, R, i_peak = ((1.0 - share) * row[i] + share * row[i + 1] for row in columns)
        return k, R, i_peak


@dataclass(frozen=True)
class Motion:
    """A move in SI and its motor: `limits` (acceleration inf: what the motor allows), `window` in
    which it has settled, `dwell` from its end to the next. The first output moves."""

    limits: MoveLimits
    window: float
    dwell: float = 0.0
    motor: Motor | None = None

    @property
    def required(self) -> bool:
        """Whether the acceleration is given."""
        return bool(np.isfinite(self.limits.acceleration))


@dataclass(frozen=True)
class Cycle:
    """The setpoint, the largest and the RMS force of any motor, the heat of all.

    `peak_share` and `heat_share` of what the motor allows; `limits` of the move in words.
    """

    profile: Setpoint
    peak_force: Any
    rms_force: Any
    power: Any = 0.0
    peak_share: Any = 0.0
    heat_share: Any = 0.0
    limits: tuple[str, ...] = ()


def cycle_of(motion: Motion, forces: Array, mass: Any = 0.0) -> Cycle:
    """The cycle with `forces` g (m,) per unit acceleration and a motor of this moving mass."""
    allowed, motor = motion.limits, motion.motor
    acceleration, why = allowed.acceleration, "acceleration"
    if motor is not None and not motion.required:
        k, _, i_peak = motor.at(mass)
        acceleration, why = k * i_peak / _largest(forces), "peak force"
        if np.real(_cycle(motion, acceleration, forces, mass).heat_share) > 1.0:
            acceleration, why = _heated(motion, np.real(acceleration), forces, mass), "heat"
    found = _cycle(motion, acceleration, forces, mass)
    reached = (
        ("velocity", found.profile.velocity, allowed.velocity),
        (why, found.profile.acceleration, acceleration),
        ("jerk", found.profile.jerk, allowed.jerk),
    )
    limits = tuple(name for name, value, most in reached if np.real(value / most) > 1.0 - 1e-9)
    return replace(found, limits=limits)


def _cycle(motion: Motion, acceleration: Any, forces: Array, mass: Any) -> Cycle:
    """With an acceleration of so much at most."""
    profile, motor = setpoint(replace(motion.limits, acceleration=acceleration)), motion.motor
    mean = profile.squared_acceleration / (profile.durations.sum() + motion.dwell)
    largest = _largest(forces)
    found = Cycle(profile, largest * profile.acceleration, largest * mean**0.5)
    if motor is None:
        return found
    k, R, i_peak = motor.at(mass)
    power = R / k**2 * (forces**2).sum() * mean
    heat_share = power / (motor.rms_power or np.inf)
    return replace(found, power=power, peak_share=found.peak_force / (k * i_peak),
                   heat_share=heat_share)  # fmt: skip


def _largest(forces: Array) -> Any:
    """The largest of their sizes."""
    found = max(forces, key=lambda force: abs(np.real(force)))
    return found if np.real(found) > 0.0 else -found


def _heated(motion: Motion, most: float, forces: Array, mass: Any) -> Any:
    """The acceleration below `most` with which the heat is all that is allowed.

    Newton's last step, at the root, gives its derivatives too.
    """

    def share(acceleration: Any) -> Any:
        return _cycle(motion, acceleration, np.real(forces), np.real(mass)).heat_share

    low = most  # far below it durations are so long that rounding fills them
    while np.real(share(low)) > 1.0:
        low *= 0.1
    a = float(scipy.optimize.brentq(lambda a: np.real(share(a)) - 1.0, low, most, xtol=1e-14 * low))
    slope = np.imag(share(a + 1j * STEP)) / STEP
    return a - (_cycle(motion, a, forces, mass).heat_share - 1.0) / slope


@dataclass(frozen=True)
class MotionAt:
    """A move of a plant at one θ, with a motor of this `mass`: its cycle, those with each parameter
    a `STEP` along the imaginary axis away, and the feedforward F (5, m) per derivative of the
    setpoint with its slopes."""

    motion: Motion
    mass: float
    cycle: Cycle
    stepped: tuple[Cycle, ...]
    forward: Array
    forward_slopes: Array

    def slopes(self, read: Callable[[Cycle], Any]) -> Array:
        """Derivatives (n,) of a figure of the cycle."""
        return np.array([np.imag(read(item)) / STEP for item in self.stepped], float)


def motion_at(
    motion: Motion, free: ScaledPlant, mass: float, place: int | None, sampling: Sampling | None
) -> MotionAt:
    """Of a plant with its rigid bodies free, square; `mass` of the motor is parameter `place` of θ.

    Raises UserError where a spring holds the output.
    """
    hold = (0.0, 0.0) if sampling is None else (sampling.period, sampling.delay)
    F, dF = feedforward_slopes(free.plant_si(), free.changes_si(), *hold)
    ahead, slopes = F[:, :, 0], dF[:, :, :, 0]
    found = cycle_of(motion, ahead[2], mass)
    if np.abs(ahead[0]).max() * motion.limits.stroke > HELD * found.peak_force:
        raise UserError("move: a spring holds the output that moves, and its force is not counted")
    stepped = tuple(
        cycle_of(motion, ahead[2] + 1j * STEP * slope[2], mass + 1j * STEP * (i == place))
        for i, slope in enumerate(slopes)
    )
    return MotionAt(motion, mass, found, stepped, ahead, slopes)
