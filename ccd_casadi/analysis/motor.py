"""Motors and the cycle of a move: its forces and heat within what they allow."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import scipy

from ccd_casadi.analysis import Loads, MoveLimits
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class MotionOptions:
    """Numbers of a motion and its derivatives."""

    complex_step: float = 1e-30  # along the imaginary axis: derivatives exact to rounding
    spring: float = 1e-6  # of the moving force: a plant that holds its output by more has a spring
    nodes: int = 5  # of Gauss and Legendre in each interval of a setpoint: exact for squares
    shares: int = 17  # instants in each interval, where Newton's step to a peak force begins
    instants: int = 2000  # of a continuous move, at which its feedforward is examined
    inside: tuple[float, ...] = (0.25, 0.5, 0.75)  # of what varies: loads beside its corners
    beside: float = 1e-9  # of the duration: how far beside a jump of the snap, too


@dataclass(frozen=True)
class Motor:
    """One motor, or a catalogue in rising order of the moving mass.

    Attributes
    ----------
    force_constant, resistance, peak_current, moving_mass : tuple of float
        N/A, ohm, A and kg of each; the mass is added to the plant at every input: M + mass b bᵀ.
    rms_power : float or None
        Of all motors together, W; None: any.
    size : str
        Names the parameter of θ that is the moving mass.
    unlimited : float
        A peak current that does not limit, A.
    """

    unlimited: ClassVar[float] = 1e12

    force_constant: tuple[float, ...]
    resistance: tuple[float, ...]
    peak_current: tuple[float, ...] = (unlimited,)
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
    """A move of the first output and its motor.

    Attributes
    ----------
    limits : MoveLimits
        SI; an infinite acceleration is what the motor allows.
    window : float
        In which the move has settled, m.
    dwell : float
        From its end to the next, s.
    motor : Motor or None
        None: it does not limit.
    output : tuple of float (p,)
        Of several sensors on one actuator: uᵀy moves; empty: the first output.
    loads : Loads
        That its motor has to move; what identifies a plant has them of their own.
    """

    limits: MoveLimits
    window: float
    dwell: float = 0.0
    motor: Motor | None = None
    output: tuple[float, ...] = field(default=(), repr=False)  # which the controller says, too
    loads: Loads = field(default=Loads(), repr=False)

    @property
    def required(self) -> bool:
        """Whether the acceleration is given."""
        return bool(np.isfinite(self.limits.acceleration))


@dataclass(frozen=True)
class Cycle:
    """The setpoint, and on the worst plant the largest and the RMS force of any motor, the heat of
    all.

    `peak_share` and `heat_share` of what the motor allows; `limits` of the move in words.
    """

    profile: Setpoint
    peak_force: Any
    rms_force: Any
    power: Any = 0.0
    peak_share: Any = 0.0
    heat_share: Any = 0.0
    limits: tuple[str, ...] = ()


def cycle_of(motion: Motion, forces: Array, mass: Any = 0.0, holding: Array | None = None) -> Cycle:
    """Compute the cycle of a motion within what its motor allows.

    Of free bodies F = g r̈. Where springs or magnets hold the output, F = h r + d ṙ + g r̈: the
    cycle leads from the place without force, r = 0, to `distance`, and back after a dwell. The way
    back has these forces in reverse order with -d, since r(t) + r(T - t) = `distance`. Of several
    plants one setpoint: the peak is that of the plant where it is largest, and so is the heat.

    Parameters
    ----------
    motion : Motion
        With its limits.
    forces : (m,) or (c, m) array
        g per unit acceleration, kg; of each of c plants.
    mass : float
        Moving mass of the motor, kg; complex for derivatives.
    holding : (2, m) or (2, c, m) array, optional
        h and d per unit of the position and its velocity, N/m and N s/m.

    Returns
    -------
    Cycle
        With the largest acceleration.

    Raises
    ------
    UserError
        The output is held, and the motor is to find the acceleration.
    """
    forces = np.atleast_2d(forces)
    if holding is not None:
        if not motion.required:
            words = "is missing: a spring or a magnet holds the output, whose force the motor needs"
            raise UserError(f"move.acceleration: {words} besides; give it")
        return _compute_held(motion, forces, mass, holding.reshape(2, *forces.shape))
    allowed, motor = motion.limits, motion.motor
    acceleration, why = allowed.acceleration, "acceleration"
    if motor is not None and not motion.required:
        k, _, i_peak = motor.at(mass)
        acceleration, why = k * i_peak / _largest(forces), "peak force"
        if np.real(_cycle(motion, acceleration, forces, mass).heat_share) > 1.0:
            acceleration, why = _limit_heat(motion, np.real(acceleration), forces, mass), "heat"
    found = _cycle(motion, acceleration, forces, mass)
    reached = (
        ("velocity", found.profile.velocity, allowed.velocity),
        (why, found.profile.acceleration, acceleration),
        ("jerk", found.profile.jerk, allowed.jerk),
    )
    limits = tuple(name for name, value, most in reached if np.real(value / most) > 1.0 - 1e-9)
    return replace(found, limits=limits)


def _compute_held(
    motion: Motion, forces: Array, mass: Any, holding: Array,
    options: MotionOptions = MotionOptions(),
) -> Cycle:  # fmt: skip
    """Compute the cycle of an output that is held, h and d (2, c, m) per unit of place and
    velocity."""
    free = replace(motion, motor=None)
    found = cycle_of(free, forces)
    profile, plants = found.profile, [*zip(*holding, forces, strict=True)]
    means = [_mean_squares(profile, motion, h, d, g, options) for h, d, g in plants]
    peaks = [_peak(profile, h, way * d, g, motion.limits.stroke, options) for plant in plants
             for h, d, g in zip(*plant, strict=True) for way in (1.0, -1.0)]  # fmt: skip
    found = replace(found, peak_force=_largest(np.array(peaks)),
                    rms_force=_largest(np.array(means)) ** 0.5)  # fmt: skip
    if motion.motor is None:
        return found
    k, R, i_peak = motion.motor.at(mass)
    power = R / k**2 * _largest(np.array([mean.sum() for mean in means]))
    return replace(found, power=power, peak_share=found.peak_force / (k * i_peak),
                   heat_share=power / (motion.motor.rms_power or np.inf))  # fmt: skip


def _mean_squares(
    profile: Setpoint, motion: Motion, h: Array, d: Array, g: Array, options: MotionOptions
) -> Any:
    """The mean square of each motor's force, there and back with dwells, N²."""
    x, weights = np.polynomial.legendre.leggauss(options.nodes)
    r, v, a, *_ = profile.inside(0.5 * (1.0 + x))
    rest = 0.5 * motion.dwell * (h * motion.limits.stroke) ** 2  # every second dwell: at `distance`
    h, d, g = (each[:, None, None] for each in (h, d, g))
    squares = (h * r + g * a) ** 2 + (d * v) ** 2  # what else d adds there it takes on the way back
    there = (squares @ (0.5 * weights)) @ profile.durations
    return (there + rest) / (profile.durations.sum() + motion.dwell)


def _peak(profile: Setpoint, h: Any, d: Any, g: Any, far: float, options: MotionOptions) -> Any:
    """Find the largest |h r + d ṙ + g r̈| of a move, or |h| `far` at rest, by Newton's step to
    f' = 0."""
    shares = np.linspace(0.0, 1.0, options.shares)
    r, v, a, j, s = profile.inside(shares).real
    h_, d_, g_ = np.real([h, d, g])
    f, slope, bend = (h_ * x + d_ * y + g_ * z for x, y, z in ((r, v, a), (v, a, j), (a, j, s)))
    size = np.maximum(profile.durations.real, 1e-300)[:, None]
    far_off = np.abs(slope) >= shares[1] * np.abs(bend) * size  # a step beyond the next instant
    step = np.divide(-slope, bend * size, out=np.zeros_like(f), where=~far_off)
    near = np.clip(shares + step, 0.0, 1.0)
    r, v, a, *_ = profile.inside(near)
    found = np.append((h * r + d * v + g * a).ravel(), h * far)
    return found[np.abs(np.real(found)).argmax()]


def _cycle(motion: Motion, acceleration: Any, forces: Array, mass: Any) -> Cycle:
    """Compute the cycle with this acceleration at most."""
    profile, motor = setpoint(replace(motion.limits, acceleration=acceleration)), motion.motor
    mean = profile.squared_acceleration / (profile.durations.sum() + motion.dwell)
    largest = _largest(forces)
    found = Cycle(profile, largest * profile.acceleration, largest * mean**0.5)
    if motor is None:
        return found
    k, R, i_peak = motor.at(mass)
    squares = _largest(np.array([(row**2).sum() for row in forces]))
    power = R / k**2 * squares * mean
    heat_share = power / (motor.rms_power or np.inf)
    return replace(found, power=power, peak_share=found.peak_force / (k * i_peak),
                   heat_share=heat_share)  # fmt: skip


def _largest(forces: Array) -> Any:
    """The largest of their sizes."""
    found = max(forces.ravel(), key=lambda force: abs(np.real(force)))
    return found if np.real(found) > 0.0 else -found


def _limit_heat(motion: Motion, most: float, forces: Array, mass: Any) -> Any:
    """The acceleration below `most` with which the heat is all that is allowed.

    Newton's last step, at the root, gives its derivatives too.
    """

    def share(acceleration: Any) -> Any:
        return _cycle(motion, acceleration, np.real(forces), np.real(mass)).heat_share

    low = most  # far below it durations are so long that rounding fills them
    while np.real(share(low)) > 1.0:
        low *= 0.1
    a = float(scipy.optimize.brentq(lambda a: np.real(share(a)) - 1.0, low, most, xtol=1e-14 * low))
    step = MotionOptions().complex_step
    slope = np.imag(share(a + 1j * step)) / step
    return a - (_cycle(motion, a, forces, mass).heat_share - 1.0) / slope
