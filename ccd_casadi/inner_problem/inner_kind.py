"""What is known of a problem at any θ, whatever its kind of controller."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from ccd_casadi.analysis.loop_view import Bounded
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights


class InnerKind(ABC):
    """One kind of controller, for a problem; by default on the plant of the case alone, with S_max
    and S_low.

    Attributes
    ----------
    title : str
        Of such a controller in code.
    slack : float
        Relative: by how much its judge lets a bound be exceeded.
    as_designed : bool
        Its controllers run as they are, without being reduced.
    problem : CoDesignProblem
    """

    title: str = "Controller"
    slack: float
    as_designed: bool

    def __init__(self, problem: CoDesignProblem) -> None:
        self.problem = problem

    @abstractmethod
    def value(self, theta: Sequence[float]) -> tuple[float, Array]:
        """v(θ) in SI and its gradient (n,); NaN where no controller is certified."""

    @abstractmethod
    def describe(self) -> tuple[str, str]:
        """The kind of controller, and how it runs or is searched, for the eye."""

    @abstractmethod
    def require_function(self) -> None:
        """Raise UserError where v(θ) is not yet one function of θ."""

    def plants(self, theta: Sequence[float]) -> list[ScaledPlant]:
        """The plants on which the controller's figures count, the model first."""
        return [scaled_plant(self.problem, theta)]

    def plant_words(self, theta: Sequence[float]) -> list[str]:
        """Write how each of `plants` is off the model."""
        return ["the model"]

    def members(self, theta: Sequence[float]) -> list[ScaledPlant]:
        """Return the plants that margins and steps are of: those of a robust set too."""
        return self.plants(theta)

    def bounds(self) -> Bounds:
        """The bounds on every plant, SI."""
        inner = self.problem.inner
        return Bounds(inner.S_max, inner.S_low, inner.omega_low)

    def common_shifts(self) -> tuple[float, float]:
        """The common resonance shifts, down and up, that its set holds at the model's damping."""
        return 0.0, 0.0

    def other_factors(self) -> tuple[Sequence[float], Sequence[float]]:
        """The extreme factors of damping and of gain in its set."""
        return (1.0,), (1.0,)

    @abstractmethod
    def gain_bounds(self, weights: Weights, gamma: float, bandwidth_hz: float) -> Bounded:
        """Return what S, KS and T of a design may not exceed, over frequency."""
