"""What a finished design survives: margins, perturbed plants, noise, a move; its demands, in SI.

The demands are options of `robustness` and of `deploy`.
"""

import argparse
from dataclasses import dataclass

from ccd_casadi.analysis import LIMITS, MoveLimits
from ccd_casadi.support.options import positive, valued


@dataclass(frozen=True)
class Demands:
    """The demands of a robustness study.

    Attributes
    ----------
    shift, damping : float, tuple of two floats
        Of all resonances, relative, to either side; the least and the largest factor.
    tolerance, samples : float, int
        Of hardware, relative; random plants within it.
    sensor, disturbance : float
        White, one-sided: m/√Hz and N/√Hz.
    limits, window, axis : MoveLimits, float, int
        The move; m, within which the error has to stay; the axis that moves, from 0.
    """

    shift: float = 0.05
    damping: tuple[float, float] = (0.5, 2.0)
    tolerance: float = 0.01
    samples: int = 200
    sensor: float = 1.0
    disturbance: float = 1.0
    limits: MoveLimits = LIMITS
    window: float = LIMITS.window
    axis: int = 0


_DEFAULT = Demands()
_MOVE = (
    ("stroke", _DEFAULT.limits.stroke, "m"),
    ("velocity", _DEFAULT.limits.velocity, "m/s"),
    ("acceleration", _DEFAULT.limits.acceleration, "m/s²"),
    ("jerk", _DEFAULT.limits.jerk, "m/s³"),
    ("snap", _DEFAULT.limits.snap, "m/s⁴"),
    ("window", _DEFAULT.window, "m; the error has to stay within it"),
)
MOVE_OPTIONS = [
    valued(f"--{name}", "X", positive, f"{name} of the move, {unit}", default)
    for name, default, unit in _MOVE
]


def move_limits(options: argparse.Namespace) -> MoveLimits:
    """Take the limits of the move from a command's options.

    Parameters
    ----------
    options : argparse.Namespace

    Returns
    -------
    MoveLimits
        SI.
    """
    return MoveLimits(*(getattr(options, name) for name, _, _ in _MOVE[:-1]))
