"""What a finished design is put through, in SI: the options of `robustness`."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Limits:
    """Stroke and bounds of velocity, acceleration, jerk and snap; unit of y and s."""

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    snap: float


@dataclass(frozen=True)
class Demands:
    """What to try: relative shift and tolerance, damping factors, densities, the move.

    `sensor` in m/√Hz and `disturbance` in N/√Hz, one-sided; `window` in m; `axis` from 0.
    """

    shift: float = 0.05
    damping: tuple[float, float] = (0.5, 2.0)
    tolerance: float = 0.01
    samples: int = 200
    sensor: float = 1.0
    disturbance: float = 1.0
    limits: Limits = field(default_factory=lambda: Limits(0.01, 0.1, 2.0, 100.0, 1e4))
    window: float = 1e-6
    axis: int = 0
