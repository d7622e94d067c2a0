"""What a back end returns: its claim, and the controller that is yet to be certified."""

from dataclasses import dataclass
from typing import Protocol

from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.optional_packages import require
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


@dataclass(frozen=True)
class Backend:
    """A name, what it needs, and where its solver is."""

    name: str
    title: str
    needs: tuple[str, ...]
    extra: str

    def solver(self) -> Solver:
        """Its solver. Raises MissingPackage where a package that it needs is not installed."""
        for package in self.needs:
            require(package, self.extra)
        if self.name == "slicot":
            from ccd_casadi.synthesis.backends import slicot  # it imports this module

            return slicot.solve
        from ccd_casadi.synthesis.backends import lmi

        return lmi.solve


SLICOT = Backend("slicot", "SB10AD (slycot)", ("slycot",), "slicot")
LMI = Backend("lmi", "LMI (Clarabel)", ("cvxpy", "clarabel"), "lmi")
GENERAL = (SLICOT, LMI)
