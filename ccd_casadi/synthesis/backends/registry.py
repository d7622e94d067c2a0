"""The general back ends: what each is called, what it needs, and where its solver is."""

from dataclasses import dataclass

from ccd_casadi.support.optional_packages import require
from ccd_casadi.synthesis.backends import lmi, slicot
from ccd_casadi.synthesis.backends.attempt import Solver


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
        return slicot.solve if self.name == "slicot" else lmi.solve


SLICOT = Backend("slicot", "SB10AD (slycot)", ("slycot",), "slicot")
LMI = Backend("lmi", "LMI (Clarabel)", ("cvxpy", "clarabel"), "lmi")
