"""What a finished design survives: margins, perturbed plants, noise, a move; its demands, in SI.

The demands are options of `robustness` and of `deploy`.
"""

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ccd_casadi.analysis import LIMITS, MoveLimits
from ccd_casadi.support.options import option, positive

if TYPE_CHECKING:
    from ccd_casadi.cases.run_folder import FinishedRun


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
    option(f"--{name}", metavar="X", type=positive,
           help=f"{name} of the move, {unit} (default: that of [move], else {default:g})")
    for name, default, unit in _MOVE
]  # fmt: skip


def move_of(
    options: argparse.Namespace, run: "FinishedRun", axis: int = 0
) -> tuple[MoveLimits, float]:
    """Take a move from a command's options, else from the case's [move], else the default one.

    Parameters
    ----------
    options : argparse.Namespace
        With those of `MOVE_OPTIONS`.
    run : FinishedRun
    axis : int
        The output that moves, from 0; [move] is of the first.

    Returns
    -------
    MoveLimits, float
        The limits and the window, SI.
    """
    limits, window = LIMITS, LIMITS.window
    if run.problem.source.motion is not None and axis == 0:
        from ccd_casadi.inner_problem.structured_bandwidth import motion_of

        motion = motion_of(run.problem, run.theta)
        fastest = float(motion.cycle.profile.acceleration)  # the motor may allow less than is given
        limits = replace(motion.motion.limits, acceleration=fastest)
        window = motion.motion.window
    given = {name: value for name, *_ in _MOVE if (value := getattr(options, name)) is not None}
    window = given.pop("window", window)
    return replace(limits, **given), window
