"""From a synthesised controller to sampled code: reduce, discretise, verify, write.

The names here are read by commands before anything that computes is imported.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """The rate and the delay at which a controller runs.

    Attributes
    ----------
    rate_hz : float or None
        Hz; None: the least that is enough, rounded up.
    delay : float or None
        From reading y to the new u at the actuator, s.
    delay_samples : float
        The same in periods, where `delay` is None.
    lead : bool
        Whether a lead filter compensates hold and delay.
    """

    rate_hz: float | None = None
    delay: float | None = None
    delay_samples: float = 1.0
    lead: bool = True

    def delay_at(self, rate_hz: float) -> float:
        """The delay in s at a sampling rate."""
        return self.delay if self.delay is not None else self.delay_samples / rate_hz
