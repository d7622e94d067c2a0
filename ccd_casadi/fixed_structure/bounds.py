"""What a loop has to keep on every plant of a set."""

from dataclasses import dataclass
from typing import Protocol

from ccd_casadi.synthesis.weights import Weights


@dataclass(frozen=True)
class Bounds:
    """Constraints on every plant; SI, frequencies in rad/s, None: no such bound.

        |S(jω)| <= S_max,   |S(jω_low)| <= S_low
        |S(jω)| <= min(1, shape ω/ω_b)/√2           for ω <= ω_b
        |W_KS KS|, |W_T T| <= weighted_level        with W_KS, W_T of `weights`
        |GS| <= compliance_max                      m/N

    Without an integrator S does not fall to zero: the shape then counts from ω_low on.
    """

    S_max: float
    S_low: float
    omega_low: float
    shape: float | None = None
    weighted_level: float | None = None
    weights: Weights | None = None
    compliance_max: float | None = None

    def __post_init__(self) -> None:
        if not self.S_max > 1.0:
            raise ValueError(f"S_max is {self.S_max}; no loop with roll-off stays below 1")
        if not self.S_low > 0.0 or not self.omega_low > 0.0:
            raise ValueError("S_low and omega_low have to be above 0")
        if self.shape is not None and not self.shape >= 1.0:
            raise ValueError(f"shape is {self.shape}; below 1 no loop reaches -3 dB at ω_b")
        if self.weighted_level is not None and self.weights is None:
            raise ValueError("weighted_level needs the weights that KS and T are weighted with")

    def shares(self, found: "Peaks") -> dict[str, float]:
        """Every bound's figure over the bound; above 1 where it is not met."""
        shares = {"S_max": found.S_peak / self.S_max, "S_low": found.S_low / self.S_low}
        if self.weighted_level is not None:
            shares["KS"] = found.weighted_KS / self.weighted_level
            shares["T"] = found.weighted_T / self.weighted_level
        if self.compliance_max is not None:
            shares["GS"] = found.GS / self.compliance_max
        return shares


class Peaks(Protocol):
    """What is held against bounds: the largest values over frequency, S_low at ω_low."""

    @property
    def S_peak(self) -> float: ...
    @property
    def S_low(self) -> float: ...
    @property
    def weighted_KS(self) -> float: ...
    @property
    def weighted_T(self) -> float: ...
    @property
    def GS(self) -> float: ...
