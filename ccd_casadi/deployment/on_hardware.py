"""The deployed controller on the machine: sampled, delayed, saturated, quantised moves."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.linalg import expm

from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.move_limits import MoveLimits
from ccd_casadi.analysis.setpoint import Setpoint, feedforward, setpoint
from ccd_casadi.deployment.realisation import Realisation, with_anti_windup
from ccd_casadi.lti.loop import DelayOptions
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

PARTS = 20  # of a period, that a jitter is a multiple of: few steps to compute
TAIL = 3.0  # the machine is watched for this many times the setpoint's duration after its end


@dataclass(frozen=True)
class Electronics:
    """What the electronics do: steps of sensor (unit of y) and force (N), jitter of the delay (s).

    The delay of each sample is uniform within ± `jitter` of the nominal one; `seed` of the draws.
    """

    sensor_step: float = 0.0
    force_step: float = 0.0
    jitter: float = 0.0
    seed: int = 0

    @property
    def ideal(self) -> bool:
        """Whether nothing of it is there."""
        return not (self.sensor_step or self.force_step or self.jitter)


def move(
    plant: StateSpace,
    realisation: Realisation,
    delay: float,
    profile: Setpoint,
    *,
    axis: int = 0,
    forward: Array | None = None,
    window: float = 1e-6,
    hardware: Electronics | None = None,
) -> Move:
    """The move of output `axis` on a plant in SI; `forward` from `feedforward`, or None."""
    hardware = hardware or Electronics()
    K, T = realisation.system, realisation.system.period
    n, m, p = len(plant.A), len(K.C), len(plant.C)
    count = int(np.ceil((1.0 + TAIL) * profile.duration / T))
    time = np.arange(count, dtype=float) * T
    wanted = profile.at(time)
    ahead = np.zeros((count, m))
    if forward is not None:
        ahead = np.einsum("kt,km->tm", wanted, forward[:, :, axis])
    joint = np.zeros((n + m, n + m))
    joint[:n] = np.hstack([plant.A, plant.B])
    rng = np.random.default_rng(hardware.seed)
    parts = np.round(PARTS * hardware.jitter / T * rng.uniform(-1.0, 1.0, count))
    reaches = np.arange(count) + np.maximum(delay / T + parts / PARTS, 0.0)  # in periods
    reaches = np.maximum.accumulate(reaches)  # no force overtakes an earlier one

    @cache
    def over(share: float) -> Array:
        return np.asarray(expm(joint * (T * share))[:n])

    x, z, u_now = np.zeros(n), np.zeros(len(K.A)), np.zeros(m)
    error, force = np.zeros((count, p)), np.zeros((count, m))
    limit, gain = realisation.saturation, realisation.back_calculation
    arriving, clipped = 0, 0
    for k in range(count):
        y = plant.C @ x
        r = np.zeros(p)
        r[axis] = wanted[0, k]
        error[k] = r - y
        e = r - _stepped(y, hardware.sensor_step)
        v = K.C @ z + K.D @ e + ahead[k]
        u = v if limit is None else np.clip(v, -limit, limit)
        z = K.A @ z + K.B @ e
        if gain is not None:
            z = z + gain @ (u - v)
        clipped += bool(np.any(u != v))
        force[k] = _stepped(u, hardware.force_step)
        now, end = float(k), k + 1.0
        while now < end:  # from one arrival to the next
            while arriving <= k and reaches[arriving] <= now + DelayOptions.instant:
                u_now = force[arriving]
                arriving += 1
            following = min(end, reaches[arriving]) if arriving <= k else end
            step = over(round(following - now, 9))
            x = step[:, :n] @ x + step[:, n:] @ u_now
            now = following
    return Move(time, wanted[0], wanted[2], error, force, forward is not None, profile.duration,
                window, saturated=clipped / count)  # fmt: skip


def _stepped(value: Array, step: float) -> Array:
    return np.asarray(step * np.round(value / step)) if step else value


WATCHED = 0.25  # of the watch, in whose end a limit cycle is seen
SHARES = (0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5)  # of the peak force that are tried


@dataclass(frozen=True)
class OnHardware:
    """The setpoint, the gains of feedforward (5, m, p) or None, the move by its ways in words.

    `least_limit`: share of the unlimited peak force; NaN where the unlimited move itself does not
    end in its window, and where no limit is given.
    """

    profile: Setpoint
    window: float
    forward: Array | None
    ways: Mapping[str, Move]
    least_limit: float


def on_hardware(
    plant: StateSpace,
    realisation: Realisation,
    delay: float,
    bandwidth: float,
    *,
    limits: MoveLimits,
    window: float = 1e-6,
    hardware: Electronics | None = None,
    progress: Callable[[str], None] = lambda words: None,
) -> OnHardware:
    """The move of output 1 on a plant in SI; τ in s, ω_b in rad/s, window in m."""
    profile, K = setpoint(limits), realisation.system
    free = replace(realisation, saturation=None, back_calculation=None)
    try:
        forward = feedforward(plant, K.period, delay)
    except UserError:
        forward = None
    made = partial(move, plant, delay=delay, profile=profile, window=window)
    progress("a move")
    unlimited = made(free)
    ways = {"feedback alone": unlimited}
    if forward is not None:
        ways["with feedforward"] = unlimited = made(free, forward=forward)
    if realisation.saturation is not None:
        clipped = replace(realisation, back_calculation=None)
        words = f"limited to {realisation.saturation:.4g} N, only clipped"
        ways[words] = made(clipped, forward=forward)
        ways["limited, with back-calculation"] = made(realisation, forward=forward)
    if hardware is not None and not hardware.ideal:
        ways["with the electronics"] = made(realisation, forward=forward, hardware=hardware)
    peak, least = float(unlimited.peak_force.max()), np.nan
    if realisation.saturation is not None and np.isfinite(unlimited.settled):
        progress("least force")
        least = 1.0
        for share in SHARES:
            held = with_anti_windup(replace(free, saturation=share * peak), bandwidth)
            if not np.isfinite(made(held, forward=forward).settled):
                break
            least = share
    return OnHardware(profile, window, forward, ways, least)


def hardware_dict(found: OnHardware) -> dict[str, Any]:
    """For deploy.json; seconds, m and N."""
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
                "last_error": move.last_error(WATCHED),
                "peak_force": float(move.peak_force.max()),
                "saturated": move.saturated,
            }
            for words, move in found.ways.items()
        ],
    }
