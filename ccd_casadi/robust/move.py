"""A move of the closed loop, simulated exactly: setpoint, feedforward, error, force.

The setpoint is the output of four integrators driven by a snap that is constant between its
switches, so that loop and setpoint together are one linear system with a piecewise constant input:
its matrix exponential over a step is the solution, with no error but rounding. The mass feedforward

    u_ff = (Σ_rigid c_i b_iᵀ)⁺ r̈

inverts the rigid-body motion alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ccd_casadi.cases.run_folder import SampledController
from ccd_casadi.lti.closed_loop import ClosedLoop
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.robust.setpoint import Setpoint
from ccd_casadi.support.arrays import Array

STEPS = 50  # a period of the bandwidth, at least
SEGMENT = 40  # and between two switches
TAIL = 8.0  # periods of the bandwidth after the move, doubled until it has settled
DOUBLINGS = 6


@dataclass(frozen=True)
class Move:
    """Time (k,), setpoint (k,), error of the moving axis (k,), all forces (k, m), and the figures.

    `settling` is the time after the end of the setpoint from which the error stays within
    `window`; inf where it has not when the simulation ends. `rms_error` and `peak_error` are over
    the move, `final_error` the largest over the last eighth of the tail.
    """

    time: Array
    position: Array
    acceleration: Array
    error: Array
    force: Array
    feedforward: bool
    duration: float
    window: float
    settling: float
    rms_error: float
    peak_error: float
    final_error: float
    peak_force: Array
    rms_force: Array


def mass_feedforward(modal: ModalPlant, axis: int) -> Array | None:
    """Forces (m,) per unit acceleration of output `axis`; None where no rigid body moves it so."""
    R = modal.C[:, modal.rigid] @ modal.B[modal.rigid]
    wanted = np.eye(len(R))[axis]
    forces = np.linalg.pinv(R) @ wanted if R.size else np.zeros(modal.B.shape[1])
    return forces if np.allclose(R @ forces, wanted, rtol=0.0, atol=1e-6) else None


def simulate_sampled(
    sampled: SampledController, plant: ScaledPlant, profile: Setpoint, *, axis: int,
    forces: Array | None, window: float, bandwidth_hz: float,
) -> Move:  # fmt: skip
    """The same of a controller in discrete time, hold and delay exact, at the instants.

    Setpoint and feedforward are read at the instants too; between them nothing is said.
    """
    p, m = plant.C.shape[0], plant.B.shape[1]
    ahead = np.zeros(m) if forces is None else forces
    end, tail = profile.duration, TAIL / bandwidth_hz
    for _ in range(DOUBLINGS):
        count = int(np.ceil((end + tail) / sampled.period)) + 1
        time = np.arange(count, dtype=float) * sampled.period
        wanted = profile.at(time)
        position, acceleration = wanted[0], wanted[2]
        references = np.zeros((len(time), p))
        references[:, axis] = position
        errors, force = sampled.run(plant, references, np.outer(acceleration, ahead))
        if np.abs(errors[-SEGMENT:, axis]).max() <= 0.5 * window:
            break
        tail *= 2.0
    signals = (time, position, acceleration, errors[:, axis], force)
    return _figures(signals, end, window, forces is not None)


def simulate(
    loop: ClosedLoop, profile: Setpoint, *, axis: int, forces: Array | None, window: float,
    bandwidth_hz: float, doublings: int = DOUBLINGS,
) -> Move:  # fmt: skip
    """The move of output `axis`, the others told to stay; `forces` from `mass_feedforward`.

    It is watched until it has settled, for a tail of `TAIL` periods doubled so often at most.
    """
    n, m = loop.A.shape[0], loop.B_d.shape[1]
    ahead = np.zeros(m) if forces is None else forces
    # states: the loop, then r, ṙ, r̈, r⃛
    A = np.zeros((n + 4, n + 4))
    A[:n, :n], A[:n, n], A[:n, n + 2] = loop.A, loop.B_r[:, axis], loop.B_d @ ahead
    A[n : n + 3, n + 1 :] = np.eye(3)
    step = 1.0 / (STEPS * bandwidth_hz)
    x = np.zeros(n + 4)
    times, states = [0.0], [x]

    def run(snap: float, span: float) -> None:
        nonlocal x
        count = max(SEGMENT, int(np.ceil(span / step)))
        extended = np.zeros((n + 5, n + 5))
        extended[: n + 4, : n + 4], extended[n + 3, n + 4] = A, 1.0
        whole = expm(extended * (span / count))
        Phi, Gamma = whole[: n + 4, : n + 4], whole[: n + 4, n + 4] * snap
        start = times[-1]
        for i in range(1, count + 1):
            x = Phi @ x + Gamma
            times.append(start + span * i / count)
            states.append(x)

    for span, snap in zip(profile.durations, profile.snaps, strict=True):
        if span > 0.0:
            run(float(snap), float(span))
    end = times[-1]
    stop = x[n : n + 4] * np.array([1.0, 0.0, 0.0, 0.0])  # what rounding left of the derivatives
    x = np.concatenate([x[:n], stop])
    tail = TAIL / bandwidth_hz
    for _ in range(doublings):
        run(0.0, tail)
        error = _error(loop, np.array(states[-SEGMENT:]), axis)
        if np.abs(error).max() <= 0.5 * window:
            break
        tail *= 2.0
    X, time = np.array(states), np.array(times)
    error = _error(loop, X, axis)
    force = (
        X[:, :n] @ loop.C_u.T + np.outer(X[:, n], loop.D_u[:, axis]) + np.outer(X[:, n + 2], ahead)
    )
    return _figures((time, X[:, n], X[:, n + 2], error, force), end, window, forces is not None)


def _figures(
    signals: tuple[Array, Array, Array, Array, Array], end: float, window: float, feedforward: bool
) -> Move:
    """The move's figures of (time, position, acceleration, error, force); it ends at `end`."""
    time, position, acceleration, error, force = signals
    outside = np.flatnonzero((np.abs(error) > window) & (time >= end))
    settling = 0.0 if not outside.size else float(time[outside[-1]] - end)
    if outside.size and outside[-1] == len(time) - 1:
        settling = np.inf
    moving = time <= end
    last = time >= time[-1] - (time[-1] - end) / 8.0
    spans = np.gradient(time)

    def rms(signal: Array, where: NDArray[np.bool_]) -> Array:
        weight = spans[where] / spans[where].sum()
        return np.sqrt(np.tensordot(weight, signal[where] ** 2, 1))

    return Move(
        time=time,
        position=position,
        acceleration=acceleration,
        error=error,
        force=force,
        feedforward=feedforward,
        duration=end,
        window=window,
        settling=settling,
        rms_error=float(rms(error, moving)),
        peak_error=float(np.abs(error).max()),
        final_error=float(np.abs(error[last]).max()),
        peak_force=np.abs(force).max(axis=0),
        rms_force=rms(force, moving),
    )


def _error(loop: ClosedLoop, X: Array, axis: int) -> Array:
    n = loop.A.shape[0]
    return X[:, n] - X[:, :n] @ loop.C_y[axis]
