"""The limits of a move, read by commands before anything that computes is imported."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MoveLimits:
    """Stroke and bounds of velocity, acceleration, jerk and snap; unit of y and s."""

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    snap: float


LIMITS = MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4)  # the move that is made where none is given
WINDOW = 1e-6  # m
