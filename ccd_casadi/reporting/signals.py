"""A design over time: the poles of its loop, a step of the reference, a move."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from ccd_casadi.deployment.discretise import Conversion, discretise
from ccd_casadi.deployment.given_controller import Sampled
from ccd_casadi.deployment.sampled import sampled_plant, sensitivity_loop
from ccd_casadi.deployment.timing import Discretisation
from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_system
from ccd_casadi.lti.closed_loop import ClosedLoop, closed_loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import ModalPlant, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.robust.demands import Demands
from ccd_casadi.robust.move import Move, mass_feedforward, simulate, simulate_sampled
from ccd_casadi.robust.setpoint import setpoint
from ccd_casadi.support.arrays import Array

STEP_POINTS = 240
STEP_PERIODS = 5.0  # of the bandwidth
WATCHED = 2.0  # durations of the move that are shown
AT_ONCE = 1e-6  # a pole z of a delay: it is gone after a sample, and has no frequency
NONE = np.zeros(0)


@dataclass(frozen=True)
class Moved:
    """Error in m of the first output over s in the default move of `robustness`, ending at `end`.

    With mass feedforward where a rigid body can be moved; `free`: on the plant without suspension.
    """

    time: Array
    error: Array
    end: float
    feedforward: bool
    free: bool

    @property
    def words(self) -> str:
        """What takes part in it."""
        ahead = "with mass feedforward" if self.feedforward else "without feedforward"
        return f"{ahead}, {'its rigid bodies free' if self.free else 'on its soft suspension'}"


AT_REST = Moved(np.zeros(0), np.zeros(0), 0.0, False, False)


@dataclass(frozen=True)
class Signals:
    """Poles of the closed loop in rad/s; y of the first output (s) after a step of its reference.

    Of a sampled loop the poles are ln(z)/T. An unstable one has no step and no move.
    """

    poles: np.ndarray
    step_time: Array
    step: Array
    move: Moved


def signals_of(
    problem: CoDesignProblem,
    system: Mechanics,
    plant: ScaledPlant,
    K: StateSpace,
    at: Sampling | None,
    bandwidth_hz: float,
) -> Signals:
    """Of a controller in SI on a plant; in discrete time by Tustin's rule if it runs `at` a rate.

    `system`: the matrices that the plant is made of.
    """
    modal = modal_plant(system, Suspension(0.0, 0.0))
    if at is not None:
        free = scaled_system(replace(problem, suspension=Suspension(0.0, 0.0)), system)
        return _sampled(plant, free, modal, in_discrete_time(K, at), bandwidth_hz)
    loop = closed_loop(plant.plant_si(), K)
    poles = np.linalg.eigvals(loop.A)
    if not poles.real.max() < 0.0:
        return Signals(poles, NONE, NONE, AT_REST)
    return Signals(poles, *_step(loop, bandwidth_hz), _move(modal, loop, K, bandwidth_hz))


def _step(loop: ClosedLoop, bandwidth_hz: float) -> tuple[Array, Array]:
    time = np.linspace(0.0, STEP_PERIODS / bandwidth_hz, STEP_POINTS)
    n = len(loop.A)
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n] = loop.A, loop.B_r[:, 0]
    Phi = expm(joint * time[1])
    x, y = np.zeros(n + 1), np.zeros(len(time))
    x[n] = 1.0
    for i in range(1, len(time)):
        x = Phi @ x
        y[i] = loop.C_y[0] @ x[:n]
    return time, y


def _move(modal: ModalPlant, suspended: ClosedLoop, K: StateSpace, bandwidth_hz: float) -> Moved:
    """On the plant with free rigid bodies, or on the suspended one where that is not stable."""
    demands = Demands()
    n, m, p = len(modal.K), modal.B.shape[1], len(modal.C)
    released = StateSpace(
        np.block([[np.zeros((n, n)), np.eye(n)], [-modal.K, -modal.D]]),
        np.vstack([np.zeros((n, m)), modal.B]),
        np.hstack([modal.C, np.zeros((p, n))]),
        np.zeros((p, m)),
    )
    loop = closed_loop(released, K)
    free = bool(np.linalg.eigvals(loop.A).real.max() < 0.0)
    ahead = mass_feedforward(modal, demands.axis)
    found = simulate(
        loop if free else suspended, setpoint(demands.limits), axis=demands.axis, forces=ahead,
        window=demands.window, bandwidth_hz=bandwidth_hz, doublings=1,
    )  # fmt: skip
    return _shown(found, ahead, free)


def _sampled(
    plant: ScaledPlant, free: ScaledPlant, modal: ModalPlant, K: Sampled, bandwidth_hz: float
) -> Signals:
    demands = Demands()
    z = np.linalg.eigvals(
        sensitivity_loop(sampled_plant(plant.plant_si(), K.period, K.delay), K.system).A
    )
    poles = np.log(z[np.abs(z) > AT_ONCE].astype(complex)) / K.period
    if not np.abs(z).max() < 1.0:
        return Signals(poles, NONE, NONE, AT_REST)
    count = int(np.ceil(STEP_PERIODS / bandwidth_hz / K.period)) + 1
    references = np.zeros((count, len(plant.C)))
    references[:, 0] = 1.0
    errors, _ = K.run(plant, references, np.zeros((count, plant.B.shape[1])))
    released = K.judge(free)[0]
    ahead = mass_feedforward(modal, demands.axis)
    found = simulate_sampled(
        K, free if released else plant, setpoint(demands.limits), axis=demands.axis, forces=ahead,
        window=demands.window, bandwidth_hz=bandwidth_hz,
    )  # fmt: skip
    time = np.arange(count, dtype=float) * K.period
    return Signals(poles, time, 1.0 - errors[:, 0], _shown(found, ahead, released))


def _shown(found: Move, ahead: Array | None, free: bool) -> Moved:
    kept = found.time <= WATCHED * found.duration
    return Moved(found.time[kept], found.error[kept], found.duration, ahead is not None, free)


def in_discrete_time(controller: StateSpace, at: Sampling) -> Sampled:
    """K(z) by Tustin's rule, as the loops of the sections are designed to run."""
    tustin = Conversion(Discretisation.TUSTIN, False, 1.0)  # warped nowhere
    return Sampled(discretise(controller, tustin, at.period, at.delay), at.delay)
