"""A controller on a box of plants: by how much the loop with each of them exceeds a bound.

    max_j c_j(κ, τ; p),   in logarithms of the bound

An unstable loop is worst of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import assess, to_theta
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopProblem
from ccd_casadi.fixed_structure.sections_design import in_problem_units
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

WITHIN = 1e-4  # ln: by how much a plant of the box may pass a bound and count as within
UNSTABLE = 10.0  # ln: what an unstable loop counts as


@dataclass(frozen=True)
class Excess:
    """The largest c of one plant: (option, point), and its value in logarithms of its bound."""

    option: int
    point: Array
    value: float


@dataclass(frozen=True)
class Loops:
    """The loops with some plants: the largest c of each; of every row of all of them the number of
    its plant, its curve, ln of its frequency in rad/s and its c."""

    problem: LoopProblem
    kappa: Array
    largest: Array
    rows: Constraints | None
    plant: np.ndarray
    curve: np.ndarray
    log_omega: Array
    value: Array

    def slopes(self, rows: np.ndarray) -> Array:
        """∂c/∂p (rows, parameters) of these rows, where the plants have slopes."""
        assert self.rows is not None
        return to_theta(self.problem, self.kappa, self.rows.only(rows))


@dataclass(frozen=True)
class LoopOnBox:
    """A controller κ in SI with its ω_b (rad/s) on a box of plants, and the bounds that its loops
    have to keep."""

    uncertain: UncertainPlant
    structure: Structure | ChannelStructure
    kappa: Array
    bandwidth: float
    bounds: Bounds
    sampling: Sampling | None = None

    def excesses(self, points: Sequence[tuple[int, Array]]) -> Array:
        """The largest c of the loop with every plant."""
        return self.assessed(self.uncertain.plants(points)).largest

    def assessed(self, plants: Sequence[ScaledPlant]) -> Loops:
        """The loops with these plants."""
        problem = problem_for(plants, self.structure, self.bounds, self.sampling)
        kappa, units = in_problem_units(problem, self.kappa), problem.plants
        found = assess(problem, kappa, float(np.log(self.bandwidth / units.omega_0)), each=True)
        largest, rows = np.full(len(plants), -np.inf), found.peaks
        plant, curve, log_omega, value = (np.zeros(0, kind) for kind in (int, int, float, float))
        if rows is not None:
            plant, curve, value = problem.plants_of(rows), rows.curve, rows.value - problem.margin
            log_omega = np.log(units.frequency(rows.v) * units.omega_0)
            np.maximum.at(largest, plant, value)
        grown = (found.poles.real / np.abs(found.poles)).max(axis=1)  # of no unit
        largest = np.where(grown < 0.0, largest, UNSTABLE + np.maximum(grown, 0.0))
        return Loops(problem, kappa, largest, rows, plant, curve, log_omega, value)
