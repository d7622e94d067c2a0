"""How a controller runs: method of discretisation, sampling rate, delay; the command's options."""

from dataclasses import dataclass
from enum import StrEnum


class Discretisation(StrEnum):
    """How K(s) becomes K(z)."""

    TUSTIN = "tustin"
    RAMP = "foh"  # ramp-invariant: exact for an error that is straight between samples


@dataclass(frozen=True)
class Timing:
    """How the controller runs: a rate (None: the one that is needed), a delay, a method.

    The delay, from reading y to the new u at the actuator, is `delay` in s, or where that is
    None `delay_samples` periods. No method: the one that needs the lowest rate.
    """

    rate_hz: float | None = None
    delay: float | None = None
    delay_samples: float = 1.0
    method: Discretisation | None = None
    lead: bool | None = None

    def delay_at(self, rate_hz: float) -> float:
        """The delay in s at a sampling rate."""
        return self.delay if self.delay is not None else self.delay_samples / rate_hz
