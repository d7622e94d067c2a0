"""A move as the machine makes it: sampled, delayed, saturated, quantised, with a jittering delay.

The plant is stepped exactly from each arrival of a force to the next: what was computed at kT
reaches it at kT + τ + jitter, the jitter rounded to a part of a period. What is read at kT, and
what the actuator is told, are multiples of a step where one is given.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import expm

from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.lti.hold import INSTANT
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

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
            while arriving <= k and reaches[arriving] <= now + INSTANT:
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
