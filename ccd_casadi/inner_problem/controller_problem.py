"""What a co-design problem states of its controller, besides bounds and weights.

One class for each kind of inner problem, with plain values: it is hashed, sent to workers and
compared. How such a problem is solved stands elsewhere (`kinds`, and `outer` of the co-design).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ccd_casadi.budget import ErrorBudget
from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.inner_problem.figure import BANDWIDTH, Figure
from ccd_casadi.plants.plant import Plant
from ccd_casadi.synthesis.weights import Weights

Options = tuple[tuple[str, object], ...]


@dataclass(frozen=True)
class ControllerProblem:
    """The base of all kinds: of largest bandwidth, continuous, on the plant of the case alone."""

    @property
    def figure(self) -> Figure:
        """What J counts of the controller."""
        return BANDWIDTH

    @property
    def sampling(self) -> Sampling | None:
        """Rate and delay that the controller is designed for; None: continuous."""
        return None

    @property
    def plant_options(self) -> tuple[Options, ...]:
        """Further option sets of the plant that the controller is for."""
        return ()

    def require_plants(self, plants: Sequence[Plant]) -> None:
        """Raise PlantError unless such a controller can be designed for each of the plants."""

    def identity_with(self, weights: Weights, budget: ErrorBudget | None) -> dict[str, Any]:
        """What else determines a design, given the weights and the budget of its problem."""
        return {}


@dataclass(frozen=True)
class MixedSensitivityProblem(ControllerProblem):
    """An H∞ controller by the weights W_S, W_KS and W_T: the problem states all of it."""
