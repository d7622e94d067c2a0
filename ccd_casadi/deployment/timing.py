"""How a controller runs: sampling rate, delay, lead; the command's options."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """How the controller runs: a rate (None: the one that is needed), a delay, and its `lead`.

    The delay, from reading y to the new u at the actuator, is `delay` in s, or where that is
    None `delay_samples` periods.
    """

    rate_hz: float | None = None
    delay: float | None = None
    delay_samples: float = 1.0
    lead: bool = True

    def delay_at(self, rate_hz: float) -> float:
        """The delay in s at a sampling rate."""
        return self.delay if self.delay is not None else self.delay_samples / rate_hz
