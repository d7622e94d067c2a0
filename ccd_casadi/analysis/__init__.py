"""What a finished loop does, over frequency and over time, whatever kind of design it is of.

The names here are read by commands before anything that computes is imported.
"""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class MoveLimits:
    """Limits of a move.

    Attributes
    ----------
    stroke, velocity, acceleration, jerk, snap : float
        The stroke, and bounds of its derivatives; unit of y and s.
    window : float
        In which a move ends where no other is given, m.
    """

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    snap: float
    window: ClassVar[float] = 1e-6


@dataclass(frozen=True)
class Loads:
    """What a motor has to move beside the model: corners of a set of plants, with a weak motor.

    Attributes
    ----------
    ranges : tuple of (name, least, nominal, largest)
        Fixed parameters that vary.
    gain : float
        By which the force constant may be less, relative.
    options : tuple of options
        Further option sets of the plant.
    """

    ranges: tuple[tuple[str, float, float, float], ...] = ()
    gain: float = 0.0
    options: tuple[tuple[tuple[str, object], ...], ...] = ()


LIMITS = MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4)  # the move that is made where none is given
# Constraints of a motor: the share of what it allows, less 1.
MOTOR_LIMITS = {"peak force": "peak_share", "motor power": "heat_share"}
