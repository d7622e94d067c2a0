"""What the deployed controller does on the machine: a move, feedforward, the limit, electronics.

One move in up to five ways, each beside the one before: the controller alone; with feedforward;
with the force limited, only clipped; with back-calculation; and with steps of sensor and force and
a delay that jitters. `least_limit` is the least force, as a share of the peak that the move asks
for, down to which the limited move ends in its window.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ccd_casadi.analysis.feedforward import feedforward
from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.move_limits import MoveLimits
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.deployment.anti_windup import with_anti_windup
from ccd_casadi.deployment.move import Electronics, move
from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

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
