"""A move of the stage: the plant driven by a setpoint, with feedforward, and when it settles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm

from ccd_casadi.analysis.setpoint import Motion, MotionAt, Motor, Setpoint, motion_at
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.plants.differenced import reparametrised
from ccd_casadi.plants.modal import FREE, ModalPlant, modal_plant, without_hidden_rigid_modes
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.arrays import Array, states
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


@dataclass(frozen=True)
class MoveOptions:
    """Numbers of a simulated move.

    Attributes
    ----------
    least_steps, most_steps : float
        Of a continuous loop, in a period of ω_b.
    steps_per_move : int
        Between these.
    tail : float
        Periods of ω_b after the move, doubled until it has settled.
    doublings : int
        At most.
    """

    least_steps: float = 50.0
    most_steps: float = 500.0
    steps_per_move: int = 400
    tail: float = 8.0
    doublings: int = 7


@dataclass(frozen=True)
class Move:
    """A simulated move.

    Attributes
    ----------
    time : (k,) array
        s.
    position : (k,) array
        Of the setpoint, unit of y and s.
    error : (k,) or (k, p) array
        Of the moving output, or of all.
    force : (k, m) array
        N.
    feedforward : bool
        Whether there is any.
    duration, window : float
        When the setpoint ends, s, and where the error has settled, unit of y.
    saturated : float
        Share of the instants at a limit.
    rest : float
        Error of the moving output that stays for ever; NaN where it is not known.
    """

    time: Array
    position: Array
    error: Array
    force: Array
    feedforward: bool
    duration: float
    window: float
    saturated: float = 0.0
    rest: float = np.nan

    @property
    def settled(self) -> float:
        """Time in s from which the error stays within `window`; inf where the last one is not."""
        outside = np.flatnonzero(self._size > self.window)
        if not outside.size:
            return 0.0
        return float(self.time[outside[-1] + 1]) if outside[-1] + 1 < len(self.time) else np.inf

    @property
    def settling(self) -> float:
        """How long after its end the error is outside `window` last, s; 0 where never."""
        if np.isinf(self.settled):
            return np.inf
        outside = np.flatnonzero((self._size > self.window) & (self.time >= self.duration))
        return float(self.time[outside[-1]] - self.duration) if outside.size else 0.0

    @property
    def rms_error(self) -> float:
        """Over the move."""
        return float(self._rms(self._size))

    @property
    def peak_error(self) -> float:
        """The largest."""
        return float(self._size.max())

    def last_error(self, share: float) -> float:
        """The largest over the last share of the time: of a limit cycle its amplitude."""
        return float(self._size[-max(int(len(self.time) * share), 1) :].max())

    @property
    def final_error(self) -> float:
        """The largest over the last eighth of the time after the move."""
        end = self.time[-1]
        return float(self._size[self.time >= end - (end - self.duration) / 8.0].max())

    @property
    def peak_force(self) -> Array:
        """Of each force (m,)."""
        return np.asarray(np.abs(self.force).max(axis=0))

    @property
    def rms_force(self) -> Array:
        """Of each force over the move (m,)."""
        return self._rms(self.force)

    @property
    def words(self) -> str:
        """What takes part in it."""
        return "with mass feedforward" if self.feedforward else "without feedforward"

    def until(self, seconds: float) -> "Move":
        """Its first part."""
        kept = self.time <= seconds
        cut = {name: getattr(self, name)[kept]
               for name in ("time", "position", "acceleration", "error", "force")}  # fmt: skip
        return replace(self, **cut)

    @property
    def _size(self) -> Array:
        size = np.abs(self.error)
        return np.asarray(size if size.ndim == 1 else size.max(axis=1))

    def _rms(self, signal: Array) -> Array:
        where = self.time <= self.duration
        spans = np.gradient(self.time)[where]
        return np.sqrt(np.tensordot(spans / spans.sum(), signal[where] ** 2, 1))


def mass_feedforward(modal: ModalPlant, axis: int) -> Array | None:
    """Forces that accelerate one output alone, by the rigid bodies.

    Parameters
    ----------
    modal : ModalPlant
        SI.
    axis : int
        The output, from 0.

    Returns
    -------
    (m,) array or None
        N per unit acceleration; None where no rigid body moves it so.
    """
    R = modal.C[:, modal.rigid] @ modal.B[modal.rigid]
    wanted = np.eye(len(R))[axis]
    forces = np.linalg.pinv(R) @ wanted if R.size else np.zeros(modal.B.shape[1])
    return forces if np.allclose(R @ forces, wanted, rtol=0.0, atol=1e-6) else None


def moves(
    loops: Sequence[Loop],
    ways: Sequence[Array | None],
    profile: Setpoint,
    *,
    axis: int,
    window: float,
    bandwidth_hz: float,
    options: MoveOptions = MoveOptions(),
) -> list[list[Move]]:
    """A move of each loop in each way.

    Parameters
    ----------
    loops : sequence of Loop
        Closed, SI.
    ways : sequence of arrays or None
        Feedforward as of `simulate`.
    profile, axis, window, bandwidth_hz
        As of `simulate`.
    options : MoveOptions
        Numbers of the method.

    Returns
    -------
    list of list of Move
        One list a way, with a move of each loop.
    """
    return [
        [
            simulate(loop, profile, axis=axis, forces=forces, window=window,
                     bandwidth_hz=bandwidth_hz, options=options)
            for loop in loops
        ]
        for forces in ways
    ]  # fmt: skip


def simulate(
    loop: Loop, profile: Setpoint, *, axis: int, forces: Array | None, window: float,
    bandwidth_hz: float, options: MoveOptions = MoveOptions(),
) -> Move:  # fmt: skip
    """Simulate the move of one output, the others with a setpoint of 0, until it has settled.

    Parameters
    ----------
    loop : Loop
        Closed, SI.
    profile : Setpoint
        Of the output `axis`, from 0.
    axis : int
        See there.
    forces : array or None
        (m,) of `mass_feedforward`, or (5, m) of `feedforward`, by derivative of the setpoint.
    window : float
        Where the error has settled, unit of y.
    bandwidth_hz : float
        Hz.
    options : MoveOptions
        Numbers of the method.

    Returns
    -------
    Move
        Up to the last tail.
    """
    ahead = np.zeros((5, loop.plant.B.shape[1]))
    if forces is not None:
        ahead[2 if forces.ndim == 1 else slice(None)] = forces
    closed, tail = loop.closed, options.tail / bandwidth_hz
    ends = 1.0 / np.array([options.most_steps, options.least_steps]) / bandwidth_hz
    step = loop.period or float(np.clip(profile.duration / options.steps_per_move, *ends))
    A, drive = _over(loop, ahead, axis, step)
    for _ in range(options.doublings):
        time = np.arange(np.ceil((profile.duration + tail) / step) + 1) * step
        r = profile.at(time) if loop.period is None else held_setpoint(profile, time, step)
        driven = r.T @ drive.T
        if loop.period is None:
            _switch(driven, loop, ahead, axis, profile, step)
        x = states(A, driven)
        error = r[0] - x @ closed.C_y[axis]
        if np.abs(error[-len(error) // 4 :]).max() <= 0.5 * window:  # longer than a slow beat
            break
        tail *= 2.0
    force = x @ closed.C_u.T + np.outer(r[0], closed.D_u[:, axis]) + r.T @ ahead
    end = r[0, -1]  # whose derivatives are zero
    rest = end - end * closed.C_y[axis] @ np.linalg.solve(np.eye(len(A)) - A, drive[:, 0])
    return Move(time, r[0], error, force, forces is not None,
                profile.duration, window, rest=abs(float(rest)))  # fmt: skip


def _over(loop: Loop, ahead: Array, axis: int, step: float) -> tuple[Array, Array]:
    """What states, and the setpoint with its derivatives (n, 5), do to the states in a step (s).

    A continuous loop and the four integrators of its setpoint are one linear system.
    """
    closed, n = loop.closed, len(loop.closed.A)
    G = loop.as_run[0]
    drive = np.zeros((n, 5))
    drive[: len(G.A)] = G.B @ ahead.T
    drive[:, 0] += closed.B_r[:, axis]
    if loop.sampling is not None:
        return closed.A, drive
    whole = np.zeros((n + 5, n + 5))
    whole[:n, :n], whole[:n, n:], whole[n:-1, n + 1 :] = closed.A, drive, np.eye(4)
    found = expm(step * whole)
    return found[:n, :n], found[:n, n:]


def _switch(
    driven: Array, loop: Loop, ahead: Array, axis: int, profile: Setpoint, step: float
) -> None:
    """Put right what drives a continuous loop in the steps within which snap jumps."""
    ends = np.cumsum(profile.durations)
    for k in np.unique((ends // step).astype(int)):
        inside = ends[(k * step < ends) & (ends < (k + 1) * step)]
        driven[k] = 0.0
        for start, end in pairwise([k * step, *inside, (k + 1) * step]):
            A, drive = _over(loop, ahead, axis, end - start)
            driven[k] = A @ driven[k] + drive @ profile.at(np.array([start]))[:, 0]


def held_setpoint(profile: Setpoint, time: Array, period: float) -> Array:
    """r and four derivatives (5, N) as a controller that holds them for a period takes them.

    Of each derivative the mean over a period about the instant: a snap that jumps between two
    instants is felt in its share.
    """
    r, half = profile.at(time), 0.5 * period
    r[1:] = (profile.at(time + half)[:4] - profile.at(time - half)[:4]) / period
    return r


def forward_force(
    profile: Setpoint, forward: Array, time: Array, period: float
) -> tuple[Array, Array]:
    """Setpoint (N,) and Σ_i F_i r^(i) (N, m) at `time`, F (5, m) of `feedforward`."""
    r = held_setpoint(profile, time, period)
    return r[0], r.T @ forward
