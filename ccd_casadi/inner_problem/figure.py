"""What an inner problem gives the outer one to count beside the hardware cost.

v(θ) = max ω_b,   min e   or   min t,      J = w1 f(θ) + w2 v(θ)
"""

from dataclasses import dataclass

from ccd_casadi.support.units import HZ, spoken, with_unit


@dataclass(frozen=True)
class FigureOfMerit:
    """A value v of the inner problem: its key, its symbol, and how it is shown.

    `unit` and `factor` (per SI unit) are for the eye, `entry` is its stem in result.json.
    """

    key: str
    words: str
    symbol: str
    si_unit: str
    unit: str
    factor: float
    larger_is_better: bool
    entry: str

    def gain(self, other: float, than: float) -> float:
        """By how much (relative) a value is better than another; negative where it is worse."""
        return (other / than if self.larger_is_better else than / other) - 1.0

    def shown(self, value: float, digits: int = 4) -> str:
        """The value with its unit, a length or a time with the prefix that its size needs.

        >>> RMS_ERROR.shown(12.3456e-9)
        '12.35 nm'
        """
        if self is BANDWIDTH:
            return f"{self.factor * value:.{digits}g} {self.unit}"
        return with_unit(value, spoken(self.si_unit), digits)


BANDWIDTH = FigureOfMerit(
    "bandwidth", "bandwidth", "ω_b", "rad/s", "Hz", 1.0 / HZ, True, "bandwidth"
)
RMS_ERROR = FigureOfMerit("rms_error", "RMS error", "e", "m", "nm", 1e9, False, "error_rms")
MOVE_TIME = FigureOfMerit("move_time", "move time", "t", "s", "ms", 1e3, False, "move_time")
FIGURES = {figure.key: figure for figure in (BANDWIDTH, RMS_ERROR, MOVE_TIME)}
