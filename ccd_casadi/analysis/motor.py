"""Motors that are designed with the plant: the cycle of a move, its forces and heat; their mass."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import scipy

from ccd_casadi.analysis import MOTOR_LIMITS, Loads, MoveLimits
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward_slopes, forward_force
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.fixed_parameters import reparametrise
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
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


@dataclass(frozen=True)
class MotionAt:
    """A move of a plant at one θ.

    Attributes
    ----------
    motion, mass : Motion, float
        What moves, and the moving mass of its motor, kg.
    cycle, stepped : Cycle, tuple of Cycle
        Its cycle, and those with each parameter a step along the imaginary axis away.
    forward, forward_slopes : (5, m), (n_θ, 5, m) array
        Feedforward per derivative of the setpoint, and its derivatives to θ.
    inertia, holding : (c, m) array, (2, c, m) array or None
        g, and h and d, of the model and of each other load with a weak motor, of the machine
        itself, without hold, delay, amplifiers and filters; None: nothing holds the output.
    """

    motion: Motion
    mass: float
    cycle: Cycle
    stepped: tuple[Cycle, ...]
    forward: Array
    forward_slopes: Array
    inertia: Array
    holding: Array | None = None

    def body_forces(self, r: Array) -> Array:
        """The forces (N, m) of a setpoint (5, N) that the cycle counts, g r̈ and h r + d ṙ if held,
        on the plant that they heat most."""
        held = np.zeros((2, *self.inertia.shape)) if self.holding is None else self.holding
        each = [np.outer(r[2], g) + r[:2].T @ held[:, i] for i, g in enumerate(self.inertia)]
        return max(each, key=lambda forces: float((forces**2).sum()))

    def forward_force(self, sampling: Sampling | None) -> float:
        """The largest force of the feedforward on any motor, with all its terms.

        Parameters
        ----------
        sampling : Sampling or None
            None: continuous, examined at the ends of the profile's intervals and between.

        Returns
        -------
        float
            N.
        """
        profile = self.cycle.profile
        if sampling is None:
            ends = np.cumsum(profile.durations.real)
            beside = ends[:, None] + profile.duration * MotionOptions().beside * np.array([-1, 1])
            most = np.linspace(0.0, profile.duration, MotionOptions().instants)
            r = profile.at(np.concatenate([beside.ravel(), most]))
            return float(np.abs(r.T @ self.forward).max())
        time = np.arange(np.ceil(profile.duration / sampling.period) + 2) * sampling.period
        return float(np.abs(forward_force(profile, self.forward, time, sampling.period)[1]).max())

    def slopes(self, read: Callable[[Cycle], Any]) -> Array:
        """Derivatives (n,) of a figure of the cycle."""
        return np.array(
            [np.imag(read(item)) / MotionOptions().complex_step for item in self.stepped], float
        )


def motion_at(
    motion: Motion, free: ScaledPlant, mass: float, place: int | None, sampling: Sampling | None,
    loads: Sequence[ScaledPlant] = (), options: MotionOptions = MotionOptions(),
) -> MotionAt:  # fmt: skip
    """Compute the move of a square plant whose rigid bodies are free, with motors for other `loads`
    too; `mass` of the motor is parameter `place` of θ.

    A force constant that is less by the gain's error needs F/(1 - gain), on whatever plant.

    Raises UserError where the output is held and no acceleration is given.
    """
    hold = (0.0, 0.0) if sampling is None else (sampling.period, sampling.delay)
    plants = (free, *loads)

    def forces(plants: Sequence[ScaledPlant], period: float, delay: float) -> tuple[Array, Array]:
        """F (5, c, m) of the first output, and dF (n_θ, 5, c, m)."""
        each = [feedforward_slopes(one.plant_si(), one.changes_si(), period, delay)
                for one in plants]  # fmt: skip
        return (np.stack([F[:, :, 0] for F, _ in each], axis=1),
                np.stack([dF[:, :, :, 0] for _, dF in each], axis=2))  # fmt: skip

    F, dF = forces(plants, *hold)
    ahead, slopes, weak = F[:, 0], dF[:, :, 0], 1.0 - motion.loads.gain
    F, dF, h, dh = F / weak, dF / weak, None, dF[:, :2]
    found = cycle_of(motion, F[2], mass)
    if np.abs(F[0]).max() * motion.limits.stroke > options.spring * found.peak_force:
        # what is late or filtered adds to F₂ where F₀ is not zero
        F, dF = (each / weak for each in forces([one.mechanics or one for one in plants], 0.0, 0.0))
        h, dh = F[:2], dF[:, :2]
        found = cycle_of(motion, F[2], mass, h)
    step = 1j * options.complex_step
    stepped = tuple(
        cycle_of(motion, F[2] + step * dF[i, 2], mass + step * (i == place),
                 None if h is None else h + step * dh[i])
        for i in range(len(slopes))
    )  # fmt: skip
    return MotionAt(motion, mass, found, stepped, ahead, slopes, F[2], h)


class DrivenMechanics:
    """θ to the matrices of a plant with the motors' mass: M + m B Bᵀ.

    Parameters
    ----------
    evaluate : Evaluate
        The plant alone.
    motion : Motion
        What moves.
    place : int or None
        Of the mass among the parameters of θ; None: it is fixed.
    fixed : float
        Then this, kg.
    inputs : int
        Of the plant, each with a motor, the first ones.
    loads : callable
        The plant alone of each option over θ and, last, what varies; called when they are needed.
    """

    keep: Any = None  # what CasADi does not keep

    def __init__(
        self, evaluate: Evaluate, motion: Motion, place: int | None, fixed: float, inputs: int,
        loads: Callable[[], Sequence[Plant]] = tuple,
    ) -> None:  # fmt: skip
        self.evaluate, self.motion, self.place, self.fixed = evaluate, motion, place, fixed
        self.inputs, self.loads = inputs, loads

    def own(self, theta: Sequence[float]) -> tuple[float, ...]:
        """θ of the plant alone."""
        return tuple(float(v) for i, v in enumerate(theta) if i != self.place)

    def mass(self, theta: Sequence[float]) -> float:
        """The moving mass of one motor."""
        return self.fixed if self.place is None else float(theta[self.place])

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        found, m = self.evaluate(self.own(theta)), self.mass(theta)
        if m:
            found.with_mass("the mass of a [motor]")
        B, (dM, dD, dK, dB, dC) = found.B[:, : self.inputs], found.derivatives
        if len(dM):
            own = dB[:, :, : self.inputs]
            dM = dM + m * (own @ B.T + B @ own.transpose(0, 2, 1))
            if self.place is not None:
                new = (B @ B.T, *(0.0 * matrix for matrix in (found.D, found.K, found.B, found.C)))
                dM, dD, dK, dB, dC = (
                    np.insert(slope, self.place, more, axis=0)
                    for slope, more in zip((dM, dD, dK, dB, dC), new, strict=True)
                )
        return replace(found, M=found.M + m * B @ B.T, derivatives=(dM, dD, dK, dB, dC))

    def at(self, theta: Sequence[float], sampling: Sampling | None = None) -> MotionAt:
        """The move at θ. Raises UserError as `motion_at`."""
        model, ranges = self._moved(theta), self.motion.loads.ranges
        wide = self._loaded if self.motion.loads.options or ranges else (self,)
        # with ranges every option is read at its own point alone
        known = (model, *(model if ranges else one._moved(theta) for one in wide[1:]))
        uncertain = UncertainPlant(
            known, 1.0, ranges=ranges,
            along=lambda option, values: wide[option]._moved((*theta, *values.tolist())),
        )  # fmt: skip
        free, *loads = uncertain.plants([*uncertain.corners(), *_inside(uncertain)])
        return motion_at(self.motion, free, self.mass(theta), self.place, sampling, loads)

    @cached_property
    def _loaded(self) -> tuple["DrivenMechanics", ...]:
        """Every option with its motors, over θ and what varies."""
        return tuple(
            DrivenMechanics(plant.evaluate, self.motion, self.place, self.fixed, self.inputs)
            for plant in self.loads()
        )

    def _moved(self, theta: Sequence[float]) -> Mechanics:
        """The matrices with the output that moves."""
        found, row = self(theta), np.array([self.motion.output])
        if not self.motion.output:
            return found
        own = (*found.derivatives[:4], row @ found.derivatives[4])
        wiring = found.wiring.of_output(row[0])
        return replace(found, C=row @ found.C, derivatives=own, wiring=wiring)


def _inside(
    uncertain: UncertainPlant, options: MotionOptions = MotionOptions()
) -> Iterator[tuple[int, Array]]:
    """Points of the box on which one parameter varies: a force may be largest between the ends."""
    lower, upper = uncertain.box
    for option in range(len(uncertain.options)):
        for i in range(len(uncertain.names)):
            for share in options.inside:
                point = uncertain.nominal.copy()
                point[i] = lower[i] + share * (upper[i] - lower[i])
                yield option, point


def with_motion(
    plant: Plant,
    motion: Motion,
    names: Sequence[str],
    held: Mapping[str, float],
    inputs: int | None = None,
    loads: Callable[[], Sequence[Plant]] = tuple,
) -> Plant:
    """A plant with the mass, the power and the peak force of its motors.

    Parameters
    ----------
    plant : Plant
        With as many inputs as outputs.
    motion : Motion
        With a motor or without.
    names : sequence of str
        Of θ: the plant's own parameters and the motor's size where that is one.
    held : mapping
        Fixed parameters by name, SI; the motor's size may be among them.
    inputs : int, optional
        The first ones of the plant, which have motors; left out, all.
    loads : callable
        The plant of each option of `motion.loads`, the model's first, over its own parameters and,
        last, those that vary.

    Returns
    -------
    Plant
        As a function of θ, with constraints of the motors.
    """
    motor = motion.motor
    size = "" if motor is None else motor.size
    place = names.index(size) if size in names else None
    fixed = 0.0 if motor is None else held.get(size, motor.moving_mass[0])

    def of(evaluate: Evaluate) -> DrivenMechanics:
        return DrivenMechanics(evaluate, motion, place, fixed, inputs or plant.inputs, loads)

    own, domain = of(plant.evaluate), plant.domain
    if domain is not None and motor is not None and place is not None:
        ends = (motor.moving_mass[0], motor.moving_mass[-1])
        domain = (np.insert(domain[0], place, ends[0]), np.insert(domain[1], place, ends[1]))
    hardware, limited = _hardware(plant, own, names)
    return reparametrise(
        plant, of, own.own, names=tuple(names), evaluate=own, hardware=hardware, domain=domain,
        constraint_names=(*plant.constraint_names, *limited),
        exact_hessian=plant.exact_hessian and not limited,
    )  # fmt: skip


def _hardware(
    plant: Plant, own: DrivenMechanics, names: Sequence[str]
) -> tuple[ca.Function, list[str]]:
    """(f, λ) of the plant and its motors, and the names of the motors' constraints."""
    theta, motor = ca.MX.sym("theta", len(names)), own.motion.motor
    f, lam = plant.hardware(ca.vertcat(*(theta[i] for i in range(len(names)) if i != own.place)))
    limits: list[str] = []
    if motor is not None and own.motion.required:
        bounded = (motor.peak_current[0] < Motor.unlimited, motor.rms_power is not None)
        limits = [name for name, there in zip(MOTOR_LIMITS, bounded, strict=True) if there]
    if not limits:
        return ca.Function("hardware", [theta], [f, lam]), []
    at = lru_cache(maxsize=64)(own.at)  # f and λ of one θ, and slopes
    figures = [attrgetter(MOTOR_LIMITS[name]) for name in limits]

    def values(x: Array) -> Array:
        return np.array([np.real(read(at(tuple(x.tolist())).cycle)) - 1.0 for read in figures])

    def slopes(x: Array) -> Array:
        return np.array([at(tuple(x.tolist())).slopes(read) for read in figures])

    own.keep = VectorCallback("motors", len(names), len(limits), values, slopes)
    lam = ca.vertcat(lam, own.keep(theta))
    return ca.Function("hardware", [theta], [f, lam]), limits
