"""The plant with the mass of its motors, which are designed with it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.analysis.motor_cycle import Motion, MotionAt, Motor, motion_at
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.fixed_parameters import reparametrised
from ccd_casadi.plants.modal import FREE, modal_plant, without_hidden_rigid_modes
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback


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
    """

    keep: Any = None  # what CasADi does not keep

    def __init__(self, evaluate: Evaluate, motion: Motion, place: int | None, fixed: float) -> None:
        self.evaluate, self.motion, self.place, self.fixed = evaluate, motion, place, fixed

    def own(self, theta: Sequence[float]) -> tuple[float, ...]:
        """θ of the plant alone."""
        return tuple(float(v) for i, v in enumerate(theta) if i != self.place)

    def mass(self, theta: Sequence[float]) -> float:
        """The moving mass of one motor."""
        return self.fixed if self.place is None else float(theta[self.place])

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        found, m = self.evaluate(self.own(theta)), self.mass(theta)
        B, (dM, dD, dK, dB, dC) = found.B, found.derivatives
        if len(dM):
            dM = dM + m * (dB @ B.T + B @ dB.transpose(0, 2, 1))
            if self.place is not None:
                new = (B @ B.T, *(0.0 * matrix for matrix in (found.D, found.K, B, found.C)))
                dM, dD, dK, dB, dC = (
                    np.insert(slope, self.place, more, axis=0)
                    for slope, more in zip((dM, dD, dK, dB, dC), new, strict=True)
                )
        return replace(found, M=found.M + m * B @ B.T, derivatives=(dM, dD, dK, dB, dC))

    def at(self, theta: Sequence[float], sampling: Sampling | None = None) -> MotionAt:
        """The move at θ. Raises UserError where a spring holds the output."""
        free = without_hidden_rigid_modes(modal_plant(self(theta), FREE))
        bare = scale_plant(free, 1.0, bare=True)
        return motion_at(self.motion, bare, self.mass(theta), self.place, sampling)


def with_motion(
    plant: Plant, motion: Motion, names: Sequence[str], held: Mapping[str, float]
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
        return DrivenMechanics(evaluate, motion, place, fixed)

    own, domain = of(plant.evaluate), plant.domain
    if domain is not None and motor is not None and place is not None:
        ends = (motor.moving_mass[0], motor.moving_mass[-1])
        domain = (np.insert(domain[0], place, ends[0]), np.insert(domain[1], place, ends[1]))
    hardware, limited = _hardware(plant, own, names)
    return reparametrised(
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
    limits: dict[str, str] = {}
    if motor is not None and own.motion.required:
        limits = {"peak force": "peak_share"} if motor.peak_current[0] < Motor.unlimited else {}
        limits |= {} if motor.rms_power is None else {"motor power": "heat_share"}
    if not limits:
        return ca.Function("hardware", [theta], [f, lam]), []
    at = lru_cache(maxsize=64)(own.at)  # f and λ of one θ, and slopes
    figures = [attrgetter(name) for name in limits.values()]

    def values(x: Array) -> Array:
        return np.array([np.real(read(at(tuple(x.tolist())).cycle)) - 1.0 for read in figures])

    def slopes(x: Array) -> Array:
        return np.array([at(tuple(x.tolist())).slopes(read) for read in figures])

    own.keep = VectorCallback("motors", len(names), len(limits), values, slopes)
    lam = ca.vertcat(lam, own.keep(theta))
    return ca.Function("hardware", [theta], [f, lam]), list(limits)
