"""A plant with its motors: the move that it makes at a θ, on the worst of its loads, their mass and
their constraints."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.analysis import MOTOR_LIMITS
from ccd_casadi.analysis.motor import Cycle, Motion, MotionOptions, Motor, cycle_of
from ccd_casadi.analysis.setpoint_feedforward import feedforward_slopes, forward_force
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.fixed_parameters import reparametrise
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback


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
