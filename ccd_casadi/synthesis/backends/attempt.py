"""What a back end returns: its claim, and the controller that is yet to be certified."""

from dataclasses import dataclass
from typing import Protocol

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.synthesis.backends.standard_plant import StandardPlant


@dataclass(frozen=True)
class Attempt:
    """γ_opt as the back end has it, and a controller that is to reach `gamma`, e or y to u.

    `controller` is None where there is none; `reason` then says why.
    """

    gamma_opt: float
    gamma: float
    controller: StateSpace | None
    reason: str = ""


class Solver(Protocol):
    """H∞ synthesis for any standard plant at gamma_backoff times its own γ_opt."""

    def __call__(self, plant: StandardPlant, *, gamma_backoff: float = 1.02) -> Attempt: ...
