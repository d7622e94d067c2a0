"""A move of the closed loop, simulated exactly: setpoint, feedforward, error, force.

The setpoint is the output of four integrators driven by a snap that is constant between its
switches, so that a continuous loop and the setpoint together are one linear system with a piecewise
constant input: its matrix exponential over a step is the solution, with no error but rounding. A
sampled loop is stepped from instant to instant, where setpoint and feedforward are read too. The
mass feedforward

    u_ff = (Σ_rigid c_i b_iᵀ)⁺ r̈

inverts the rigid-body motion alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.lti.closed_loop import ClosedLoop
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.recurrence import states

STEPS = 50  # a period of the bandwidth, at least
SEGMENT = 40  # and between two switches
TAIL = 8.0  # periods of the bandwidth after the move, doubled until it has settled
DOUBLINGS = 6


@dataclass(frozen=True)
class Move:
    """Time (k,) in s, setpoint (k,), its acceleration (k,), error and forces (k, m).

    The error is of the moving output (k,), or of all (k, p). The setpoint ends at `duration`.
    `free`: on the plant without its suspension. `saturated`: share of the instants at a limit.
    """

    time: Array
    position: Array
    acceleration: Array
    error: Array
    force: Array
    feedforward: bool
    duration: float
    window: float
    free: bool = False
    saturated: float = 0.0

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
        """The largest over the last share of what was watched: of a limit cycle its amplitude."""
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
        ahead = "with mass feedforward" if self.feedforward else "without feedforward"
        return f"{ahead}, {'its rigid bodies free' if self.free else 'on its soft suspension'}"

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
    """Forces (m,) per unit acceleration of output `axis`; None where no rigid body moves it so."""
    R = modal.C[:, modal.rigid] @ modal.B[modal.rigid]
    wanted = np.eye(len(R))[axis]
    forces = np.linalg.pinv(R) @ wanted if R.size else np.zeros(modal.B.shape[1])
    return forces if np.allclose(R @ forces, wanted, rtol=0.0, atol=1e-6) else None


def moves(
    suspended: Sequence[Loop],
    free: Sequence[Loop],
    ways: Sequence[Array | None],
    profile: Setpoint,
    *,
    axis: int,
    window: float,
    bandwidth_hz: float,
    doublings: int = DOUBLINGS,
) -> list[list[Move]]:
    """A move of each loop (inner lists) in each way (forces of `mass_feedforward`, or None).

    Of the loops with free rigid bodies, or of the suspended ones where not all of those are stable.
    """
    released = all(loop.stable for loop in free)
    return [
        [
            replace(simulate(loop, profile, axis=axis, forces=forces, window=window,
                             bandwidth_hz=bandwidth_hz, doublings=doublings), free=released)
            for loop in (free if released else suspended)
        ]
        for forces in ways
    ]  # fmt: skip


def simulate(
    loop: Loop, profile: Setpoint, *, axis: int, forces: Array | None, window: float,
    bandwidth_hz: float, doublings: int = DOUBLINGS,
) -> Move:  # fmt: skip
    """The move of output `axis`, the others told to stay.

    `forces` (m,) of `mass_feedforward`, or (5, m) of `feedforward`, by derivative of the setpoint.

    It is watched until it has settled, for a tail of `TAIL` periods of the bandwidth, doubled so
    often at most.
    """
    ahead = np.zeros((5, loop.plant.B.shape[1]))
    if forces is not None:
        ahead[2 if forces.ndim == 1 else slice(None)] = forces
    watch = _sampled if loop.sampling is not None else _continuous
    signals = watch(loop, profile, axis, ahead, window, TAIL / bandwidth_hz, doublings)
    return Move(*signals, forces is not None, profile.duration, window)


Signals = tuple[Array, Array, Array, Array, Array]


def forward_force(
    profile: Setpoint, forward: Array, time: Array, period: float
) -> tuple[Array, Array]:
    """Setpoint (N,) and Σ_i F_i r^(i) (N, m) at `time`, F (5, m) of `feedforward`.

    Of each derivative the mean over a period about the instant, as it is held that long: a snap
    that jumps between two instants is felt in its share.
    """
    r, half = profile.at(time), 0.5 * period
    r[1:] = (profile.at(time + half)[:4] - profile.at(time - half)[:4]) / period
    return r[0], r.T @ forward


def driven_states(
    closed: ClosedLoop, G: StateSpace, r: Array, force: Array, axis: int = 0
) -> Array:
    """States (N, n) of a sampled loop by the setpoint of an output and a force ahead (N, m)."""
    driven = np.outer(r, closed.B_r[:, axis])
    driven[:, : len(G.A)] += force @ G.B.T
    return states(closed.A, driven)


def _sampled(
    loop: Loop, profile: Setpoint, axis: int, ahead: Array, window: float, tail: float, more: int
) -> Signals:
    """Hold and delay exact, at the instants; between them nothing is said."""
    closed, G = loop.closed, loop.as_run[0]
    for _ in range(more):
        time = np.arange(np.ceil((profile.duration + tail) / closed.period) + 1) * closed.period
        position, forward = forward_force(profile, ahead, time, closed.period)
        x = driven_states(closed, G, position, forward, axis)
        error = position - x @ closed.C_y[axis]
        if np.abs(error[-len(error) // 4 :]).max() <= 0.5 * window:  # longer than a slow beat
            break
        tail *= 2.0
    force = x @ closed.C_u.T + np.outer(position, closed.D_u[:, axis]) + forward
    return time, position, profile.at(time)[2], error, force


def _continuous(
    loop: Loop, profile: Setpoint, axis: int, ahead: Array, window: float, tail: float, more: int
) -> Signals:
    closed = loop.closed
    n, step = len(closed.A), tail / TAIL / STEPS
    # states: the loop, then r, ṙ, r̈, r⃛
    A = np.zeros((n + 4, n + 4))
    A[:n, :n], A[:n, n:] = closed.A, closed.B_d @ ahead[:4].T
    A[:n, n] += closed.B_r[:, axis]
    A[n : n + 3, n + 1 :] = np.eye(3)
    x = np.zeros(n + 4)
    times, found = [0.0], [x]

    def run(snap: float, span: float) -> None:
        nonlocal x
        count = max(SEGMENT, int(np.ceil(span / step)))
        extended = np.zeros((n + 5, n + 5))
        extended[: n + 4, : n + 4], extended[n + 3, n + 4] = A, 1.0
        extended[:n, n + 4] = closed.B_d @ ahead[4]
        whole = expm(extended * (span / count))
        Phi, Gamma = whole[: n + 4, : n + 4], whole[: n + 4, n + 4] * snap
        start = times[-1]
        for i in range(1, count + 1):
            x = Phi @ x + Gamma
            times.append(start + span * i / count)
            found.append(x)

    def error_of(X: NDArray) -> Array:
        return np.asarray(X[:, n] - X[:, :n] @ closed.C_y[axis])

    for span, snap in zip(profile.durations, profile.snaps, strict=True):
        if span > 0.0:
            run(float(snap), float(span))
    stop = x[n : n + 4] * np.array([1.0, 0.0, 0.0, 0.0])  # what rounding left of the derivatives
    x = np.concatenate([x[:n], stop])
    for _ in range(more):
        run(0.0, tail)
        if np.abs(error_of(np.array(found[-SEGMENT:]))).max() <= 0.5 * window:
            break
        tail *= 2.0
    X = np.array(found)
    force = X[:, :n] @ closed.C_u.T + np.outer(X[:, n], closed.D_u[:, axis])
    snaps = profile.at(np.array(times))[4:].T
    force = force + np.hstack([X[:, n:], snaps]) @ ahead
    return np.array(times), X[:, n], X[:, n + 2], error_of(X), force
