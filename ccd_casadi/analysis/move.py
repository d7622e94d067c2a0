"""A move of the stage: the plant driven by a setpoint, and when it settles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import expm

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.analysis.setpoint_feedforward import held_setpoint
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.ports import course
from ccd_casadi.lti.state_space import ClosedLoop, closed_loop
from ccd_casadi.support.arrays import Array, states


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
        At most, where the error at rest is outside the window.
    patient_doublings : int
        At most, where it is inside: the move settles, however slow the loop is.
    """

    least_steps: float = 50.0
    most_steps: float = 500.0
    steps_per_move: int = 400
    tail: float = 8.0
    doublings: int = 7
    patient_doublings: int = 14


@dataclass(frozen=True)
class Move:
    """A simulated move, with its error and forces.

    Attributes
    ----------
    time : (k,) array
        s.
    position : (k,) array
        Of the setpoint, unit of y and s.
    error : (k,) or (k, p) array
        Of the moving output, or of all.
    force : (k, m) array
        That the machine gets, N.
    feedforward : bool
        Whether there is any.
    duration, window : float
        When the setpoint ends, s, and where the error has settled, unit of y.
    saturated : float
        Share of the instants at a limit.
    rest : float
        Error of the moving output that stays for ever; NaN where it is not known.
    command : (k, m) array or None
        u, N, of which actuators make the force; None: they are one.
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
    command: Array | None = None

    @property
    def settled(self) -> float:
        """Time in s from which the error stays within `window`; inf where the last one is not, and
        where one is not finite: a simulation that was lost settles nowhere."""
        outside = np.flatnonzero(~(self._size <= self.window))
        if not self.finite:
            return np.inf
        if not outside.size:
            return 0.0
        return float(self.time[outside[-1] + 1]) if outside[-1] + 1 < len(self.time) else np.inf

    @property
    def finite(self) -> bool:
        """Whether the simulation ran to its end: one that diverges leaves double precision."""
        return bool(np.isfinite(self._size).all())

    @property
    def settling(self) -> float:
        """Time in s after the end of the setpoint from which the error stays within `window`."""
        return max(self.settled - self.duration, 0.0)

    @property
    def rms_error(self) -> float:
        """The RMS error over the move."""
        return float(self._rms(self._size))

    @property
    def peak_error(self) -> float:
        """The largest error."""
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
        """The peak of each force (m,)."""
        return np.asarray(np.abs(self.force).max(axis=0))

    @property
    def peak_command(self) -> Array:
        """The peak of each command u (m,), N."""
        given = self.force if self.command is None else self.command
        return np.asarray(np.abs(given).max(axis=0))

    @property
    def rms_force(self) -> Array:
        """The RMS value of each force over the move (m,)."""
        return self._rms(self.force)

    def mean_squares(self, cycle: float) -> Array:
        """Compute the mean square of each force over a way there and back from rest, as of heat.

            f(t), t < T_c;   f(t) - f(t - T_c), T_c ≤ t < 2 T_c

        Parameters
        ----------
        cycle : float
            T_c, of the move and its dwell, s; the way back begins at the next instant.

        Returns
        -------
        array (m,)
            N²; after the end of the simulation each force stays as it is there. Infinite where the
            simulation was lost.
        """
        if not self.finite:
            return np.full(self.force.shape[1], np.inf)
        count = int(np.ceil(cycle / self.time[1] * (1.0 - 1e-12)))
        kept = np.minimum(np.arange(2 * count), len(self.time) - 1)
        force = self.force[kept]
        force[count:] -= self.force[kept[:count]]
        return np.asarray((force**2).mean(axis=0))

    @property
    def words(self) -> str:
        """The kind of feedforward, in words."""
        return "with feedforward" if self.feedforward else "without feedforward"

    def until(self, seconds: float) -> "Move":
        """Cut the move off after this time."""
        kept = self.time <= seconds
        names = ("time", "position", "error", "force", "command")
        cut = {name: part[kept] for name in names if (part := getattr(self, name)) is not None}
        return replace(self, **cut)

    @property
    def _size(self) -> Array:
        size = np.abs(self.error)
        return np.asarray(size if size.ndim == 1 else size.max(axis=1))

    def _rms(self, signal: Array) -> Array:
        where = self.time <= self.duration
        spans = np.gradient(self.time)[where]
        return np.sqrt(np.tensordot(spans / spans.sum(), signal[where] ** 2, 1))


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
    bandwidth_hz: float, until: float = 0.0, options: MoveOptions = MoveOptions(),
) -> Move:  # fmt: skip
    """Simulate the move of one output, the others with a setpoint of 0, until it has settled.

    Several sensors on one actuator have references as of `course`.

    Parameters
    ----------
    loop : Loop
        Closed, SI.
    profile : Setpoint
        Of the output `axis`, from 0.
    axis : int
        See there.
    forces : array (5, m) or None
        F of `forward_force`; None: without feedforward.
    window : float
        Where the error has settled, unit of y.
    bandwidth_hz : float
        Hz.
    until : float
        s: followed so long at least, where it settles.
    options : MoveOptions
        Numbers of the method.

    Returns
    -------
    Move
        Up to the last tail.
    """
    ahead = np.zeros((5, loop.plant.B.shape[1])) if forces is None else forces
    closed, tail = closed_loop(*loop.as_run), options.tail / bandwidth_hz
    rows, wanted, reference = counted_rows(loop, axis, closed)
    ends = 1.0 / np.array([options.most_steps, options.least_steps]) / bandwidth_hz
    step = loop.period or float(np.clip(profile.duration / options.steps_per_move, *ends))
    A, drive = _over(loop, ahead, reference, step)
    left = wanted - rows @ np.linalg.solve(np.eye(len(A)) - A, drive[:, 0])  # at rest, of position
    stable = np.abs(np.linalg.eigvals(A)).max() < 1.0
    for turn in range(options.patient_doublings):
        time = np.arange(np.ceil((profile.duration + tail) / step) + 1) * step
        r = profile.at(time) if loop.period is None else held_setpoint(profile, time, step)
        driven = r.T @ drive.T
        if loop.period is None:
            _switch(driven, loop, ahead, reference, profile, step)
        x = states(A, driven)
        error = np.outer(r[0], wanted) - x @ rows.T
        quiet = np.abs(error[-len(error) // 4 :]).max() <= 0.5 * window  # longer than a slow beat
        if quiet and time[-1] >= until:
            break
        rest = float(np.abs(r[0, -1] * left).max())  # where all its derivatives are zero
        if turn + 1 >= options.doublings and not (stable and rest <= 0.5 * window):
            break
        tail *= 2.0
    u = x @ closed.C_u.T + np.outer(r[0], closed.D_u @ reference) + r.T @ ahead
    force = u if loop.force is None else x[:, : loop.force.shape[1]] @ loop.force.T
    error = error[:, 0] if len(wanted) == 1 else error
    return Move(time, r[0], error, force, forces is not None, profile.duration, window,
                rest=float(np.abs(r[0, -1] * left).max()),
                command=None if loop.force is None else u)  # fmt: skip


def counted_rows(loop: Loop, axis: int, closed: ClosedLoop) -> tuple[Array, Array, Array]:
    """Find what counts of a move of one output.

    Parameters
    ----------
    loop : Loop
        Closed, SI.
    axis : int
        The output, from 0.
    closed : ClosedLoop
        Of the loop as it runs.

    Returns
    -------
    rows : (q, n) array
        What counts, in the states of the closed loop: the output, or what the loop's ports count.
    wanted : (q,) array
        Of that, where the setpoint is 1.
    reference : (p,) array
        Of every output, as of `course`.
    """
    output, reference = course(loop.plant, axis, loop.at)
    if loop.counted is None:
        return (output @ closed.C_y)[None], np.ones(1), reference
    rows = np.zeros((len(loop.counted), len(closed.A)))
    rows[:, : len(loop.plant.A)] = loop.counted
    return rows, loop.ports.wanted[:, 0 if loop.at else axis], reference


def _over(loop: Loop, ahead: Array, reference: Array, step: float) -> tuple[Array, Array]:
    """Discretise the loop over a step (s): A, and what the setpoint with its derivatives (n, 5)
    adds.

    A continuous loop and the four integrators of its setpoint are one linear system.
    """
    closed, G = closed_loop(*loop.as_run), loop.as_run[0]
    n = len(closed.A)
    drive = np.zeros((n, 5))
    drive[: len(G.A)] = G.B @ ahead.T
    drive[:, 0] += closed.B_r @ reference
    if loop.sampling is not None:
        return closed.A, drive
    whole = np.zeros((n + 5, n + 5))
    whole[:n, :n], whole[:n, n:], whole[n:-1, n + 1 :] = closed.A, drive, np.eye(4)
    found = expm(step * whole)
    return found[:n, :n], found[:n, n:]


def _switch(
    driven: Array, loop: Loop, ahead: Array, reference: Array, profile: Setpoint, step: float
) -> None:
    """Put right what drives a continuous loop in the steps within which snap jumps."""
    ends = np.cumsum(profile.durations)
    for k in np.unique((ends // step).astype(int)):
        inside = ends[(k * step < ends) & (ends < (k + 1) * step)]
        driven[k] = 0.0
        for start, end in pairwise([k * step, *inside, (k + 1) * step]):
            A, drive = _over(loop, ahead, reference, end - start)
            driven[k] = A @ driven[k] + drive @ profile.at(np.array([start]))[:, 0]
