"""The deployed controller on the machine: sampled, delayed, saturated, quantised moves."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.linalg import expm

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.analysis.setpoint_feedforward import forward_force, forward_gains, forward_of
from ccd_casadi.codesign.verdict import State
from ccd_casadi.deployment.realisation import Realisation, with_anti_windup
from ccd_casadi.lti.loop import DelayOptions
from ccd_casadi.lti.ports import BreakPoint, Ports, course
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import inwards


@dataclass(frozen=True)
class SimulationOptions:
    """Numbers of a simulated move."""

    parts: int = 20  # of a period, that a jitter is a multiple of: few steps to compute
    tail: float = 3.0  # time after the setpoint's end that is simulated, over its duration
    watched: float = 0.25  # last share of the simulation, where a limit cycle is seen
    shares: tuple[float, ...] = (0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5)  # of the peak force


@dataclass(frozen=True)
class Electronics:
    """The imperfections of the electronics.

    Attributes
    ----------
    sensor_step, force_step : float
        Quantisation of y (its unit) and of u (N); 0: none.
    jitter : float
        The delay of each sample is uniform within ± this of the nominal one, s.
    seed : int
        Of the draws.
    """

    sensor_step: float = 0.0
    force_step: float = 0.0
    jitter: float = 0.0
    seed: int = 0

    @property
    def ideal(self) -> bool:
        """Whether all of them are zero."""
        return not (self.sensor_step or self.force_step or self.jitter)

    def require_in_order(self, period: float) -> None:
        """Refuse a jitter of more than a period, with which forces would arrive out of order.

        Parameters
        ----------
        period : float
            Of the loop, s.

        Raises
        ------
        UserError
            Of the option, with the largest value that it may have.
        """
        if self.jitter > period * (1.0 + 1e-9):  # as far as a period that is written is it
            words = f"--jitter {self.jitter:g}: is more than a period of the loop"
            most = f"{inwards(period, 4, 15):g} s ({1.0 / period:.6g} Hz)"
            raise UserError(
                f"{words}, so that forces would arrive out of order; give at most {most}"
            )


@np.errstate(over="ignore", invalid="ignore")  # a loop that is lost leaves double precision
def move(
    plant: StateSpace,
    realisation: Realisation,
    delay: float,
    profile: Setpoint,
    *,
    axis: int = 0,
    places: Sequence[BreakPoint] = (),
    ports: Ports | None = None,
    forward: Array | None = None,
    window: float = 1e-6,
    hardware: Electronics | None = None,
    options: SimulationOptions = SimulationOptions(),
) -> Move:
    """The move of output `axis` on a plant in SI; `forward` from `feedforward`, or None. Of several
    sensors on one actuator that of the first place, with references as of `course`. The error is
    that of the `ports`, where they count something else, the force what their actuators give."""
    hardware = hardware or Electronics()
    T, n, m = realisation.system.period, len(plant.A), len(realisation.system.C)
    count = int(np.ceil((1.0 + options.tail) * profile.duration / T))
    time = np.arange(count, dtype=float) * T
    output, reference = course(plant, axis, places)
    gains = forward_gains(forward, m, reference, axis, places)
    wanted, ahead = forward_force(profile, gains, time, T)
    joint = np.zeros((n + m, n + m))
    joint[:n] = np.hstack([plant.A, plant.B])
    rng = np.random.default_rng(hardware.seed)
    parts = np.round(options.parts * hardware.jitter / T * rng.uniform(-1.0, 1.0, count))
    reaches = np.arange(count) + np.maximum(delay / T + parts / options.parts, 0.0)  # in periods
    reaches = np.maximum.accumulate(reaches)  # no force overtakes an earlier one

    @cache
    def over(share: float) -> Array:
        return np.asarray(expm(joint * (T * share))[:n])

    x, u_now, controller = np.zeros(n), np.zeros(m), running(realisation)
    rows, aim = (output[None] @ plant.C, np.ones(1)) if places else (plant.C, reference)
    if ports is not None:
        rows, aim = ports.counted, ports.wanted[:, 0 if places else axis]
    error, command = np.zeros((count, len(aim))), np.zeros((count, m))
    if (actuators := None if ports is None else ports.force) is not None:
        force = np.zeros_like(command)
    arriving, clipped = 0, 0
    for k in range(count):
        y = plant.C @ x
        r = reference * wanted[k]
        error[k] = aim * wanted[k] - rows @ x
        if actuators is not None:
            force[k] = actuators @ x
        u, limited = controller(r - _quantise(y, hardware.sensor_step), ahead[k])
        clipped += limited
        command[k] = _quantise(u, hardware.force_step)
        now, end = float(k), k + 1.0
        while now < end:  # from one arrival to the next
            while arriving <= k and reaches[arriving] <= now + DelayOptions.instant:
                u_now = command[arriving]
                arriving += 1
            following = min(end, reaches[arriving]) if arriving <= k else end
            step = over(round(following - now, 9))
            x = step[:, :n] @ x + step[:, n:] @ u_now
            now = following
    only = actuators is None  # then the command is the force
    return Move(time, wanted, error, command if only else force, forward is not None,
                profile.duration, window, saturated=clipped / count,
                command=None if only else command)  # fmt: skip


def running(realisation: Realisation) -> Callable[[Array, Array], tuple[Array, bool]]:
    """A controller at rest, sample by sample, in the arithmetic of its code.

    Parameters
    ----------
    realisation : Realisation

    Returns
    -------
    callable
        Of e (p,) and feedforward (m,): u (m,) in N, and whether something is at its limit.
    """
    K, fixed, number = realisation.system, realisation.fixed, realisation.number
    if fixed is not None:
        X = fixed.begin([0] * K.B.shape[1], [0] * len(K.C))

        def in_integers(e: Array, f: Array) -> tuple[Array, bool]:
            nonlocal X
            words = fixed.counts(e, fixed.errors), fixed.counts(f, fixed.forces)
            u, X, saturated = fixed.step(X, *words)
            return np.array(u) * fixed.forces, saturated or fixed.largest in map(abs, words[0])

        return in_integers
    z = np.zeros(len(K.A), number)
    A, B, C, D = (M.astype(number) for M in (K.A, K.B, K.C, K.D))
    limit, given = realisation.saturation, realisation.back_calculation
    gain = None if given is None else given.astype(number)

    def in_floats(e: Array, f: Array) -> tuple[Array, bool]:
        nonlocal z
        e = e.astype(number)
        v = C @ z + D @ e + f.astype(number)
        u = v if limit is None else np.clip(v, -limit, limit)
        z = A @ z + B @ e
        if gain is not None:
            z = z + gain @ (u - v)
        return u, bool(np.any(u != v))

    return in_floats


def _quantise(value: Array, step: float) -> Array:
    return np.asarray(step * np.round(value / step)) if step else value


UNLIMITED = "feedback alone", "with feedforward"
BACK, MACHINE = "limited, with back-calculation", "with the electronics"  # as it is deployed


@dataclass(frozen=True)
class OnHardware:
    """Moves of the deployed loop.

    Attributes
    ----------
    profile, window : Setpoint, float
        The setpoint, and the window in m in which the move has to end.
    forward : (5, m, p) array or None
        Gains of the feedforward.
    ways : mapping of Move
        By what is different, in words.
    least_limit : float
        Share of the unlimited peak force; NaN where the unlimited move itself does not end in its
        window, and where no limit is given.
    limit : float or None
        Largest force, N.
    """

    profile: Setpoint
    window: float
    forward: Array | None
    ways: Mapping[str, Move]
    least_limit: float
    limit: float | None = None

    @property
    def limited_entry(self) -> dict[str, Any] | None:
        """Whether the move settles within the force limit, as the loop is deployed: `state` is
        unknown where the simulation was lost. None without a limit."""
        if self.limit is None:
            return None
        made = [self.ways[name] for name in (BACK, MACHINE) if name in self.ways]
        free = [self.ways[name] for name in UNLIMITED if name in self.ways][-1]
        worst = max(made, key=lambda m: (not m.finite, m.settled))
        state = State.PASSED if np.isfinite(worst.settled) else State.FAILED
        state = state if worst.finite else State.UNKNOWN
        return {
            "state": state.value,
            "force_limit": self.limit,
            "settled": worst.settled if state is State.PASSED else None,
            "time": float(worst.time[-1]),
            "left": worst.final_error if worst.finite else None,
            "settles_unlimited": bool(np.isfinite(free.settled)),
        }


def on_hardware(
    plant: StateSpace,
    realisation: Realisation,
    delay: float,
    bandwidth: float,
    *,
    limits: MoveLimits,
    window: float = 1e-6,
    hardware: Electronics | None = None,
    places: Sequence[BreakPoint] = (),
    ports: Ports | None = None,
    progress: Callable[[str], None] = lambda words: None,
    options: SimulationOptions = SimulationOptions(),
) -> OnHardware:
    """Simulate the move of output 1 with and without feedforward, limits and electronics.

    Parameters
    ----------
    plant : StateSpace
        u to y, SI.
    realisation : Realisation
        The controller as it runs.
    delay, bandwidth : float
        τ in s and ω_b in rad/s.
    limits, window : MoveLimits, float
        Of the setpoint, and where the move has to end, m.
    hardware : Electronics or None
        None: ideal.
    places : sequence of BreakPoint
        Of several sensors on one actuator: the output of the first moves.
    ports : Ports or None
        Where the error counts, if not at the sensors.
    progress : function of str
        Takes lines of progress.
    options : SimulationOptions
        Numbers of the method.

    Returns
    -------
    OnHardware
        The moves.
    """
    profile, K = setpoint(limits), realisation.system
    if hardware is not None:
        hardware.require_in_order(K.period)
    fixed = realisation.fixed
    free = replace(realisation, saturation=None, back_calculation=None,
                   fixed=None if fixed is None else fixed.without_limit())  # fmt: skip
    try:
        forward = forward_of(plant, K.period, delay, places)
    except UserError:
        forward = None
    made = partial(move, plant, delay=delay, profile=profile, window=window, places=places,
                   ports=ports, options=options)  # fmt: skip
    progress("a move")
    unlimited = made(free)
    ways = {UNLIMITED[0]: unlimited}
    if forward is not None:
        ways[UNLIMITED[1]] = unlimited = made(free, forward=forward)
    if realisation.saturation is not None:
        clipped = replace(realisation, back_calculation=None,
                          fixed=None if fixed is None else fixed.only_clipped())  # fmt: skip
        words = f"limited to {realisation.saturation:.4g} N, only clipped"
        ways[words] = made(clipped, forward=forward)
        ways[BACK] = made(realisation, forward=forward)
    if hardware is not None and not hardware.ideal:
        ways[MACHINE] = made(realisation, forward=forward, hardware=hardware)
    peak, least = float(unlimited.peak_command.max()), np.nan
    if realisation.saturation is not None and np.isfinite(unlimited.settled):
        progress("least force")
        least = 1.0
        for share in options.shares:
            # of integers the same in double precision: their steps are those of the given limit
            held = replace(free, saturation=share * peak, fixed=None)
            held = with_anti_windup(held, bandwidth)
            if not np.isfinite(made(held, forward=forward).settled):
                break
            least = share
    return OnHardware(profile, window, forward, ways, least, realisation.saturation)


def hardware_dict(found: OnHardware) -> dict[str, Any]:
    """Write the moves for deploy.json; seconds, m and N."""
    watched = SimulationOptions().watched
    return {
        "duration": found.profile.duration,
        "window": found.window,
        "feedforward": None if found.forward is None else found.forward.tolist(),
        "least_limit": None if np.isnan(found.least_limit) else found.least_limit,
        "moves": [
            {
                "words": words,
                "settled": None if np.isinf(move.settled) else move.settled,
                "peak_error": move.peak_error,
                "last_error": move.last_error(watched),
                "peak_force": float(move.peak_force.max()),
                "peak_command": float(move.peak_command.max()),
                "saturated": move.saturated,
            }
            for words, move in found.ways.items()
        ],
    }
