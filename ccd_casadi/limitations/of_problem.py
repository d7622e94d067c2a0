"""The bound on every controller for a problem with sections, at one θ."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_plant_set import (
    bounds_of,
    sections_of_problem,
    structure_of,
    uncertain_plant,
)
from ccd_casadi.inner_problem.sections_problem import SectionsProblem
from ccd_casadi.limitations.bound import Reach, reach
from ccd_casadi.limitations.limits import Limits, limits_of
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ


@dataclass(frozen=True)
class Gap:
    """Bounds on the ω_b of every controller on the model at a θ, channel by channel."""

    loops: tuple[Reach, ...]

    @property
    def outside(self) -> float:
        """No controller that keeps the bounds on the model has more, in rad/s."""
        return min(loop.outside for loop in self.loops)

    @property
    def inside(self) -> float:
        """What some controller reaches on the model, in rad/s; 0 where none was looked for.

        Of several channels nothing: each alone does not make a controller of the whole.
        """
        return self.loops[0].inside if len(self.loops) == 1 else 0.0

    def over(self, bandwidth: float) -> float:
        """By how much the bound exceeds a design's ω_b (rad/s), relative."""
        return self.outside / bandwidth - 1.0

    def words(self, bandwidth: float) -> str:
        """Of the verdict, with a design's ω_b in rad/s."""
        if not np.isfinite(self.outside):
            return "no bound on every controller, gap not known"
        return (
            f"no controller of any order exceeds {self.outside / HZ:.2f} Hz on the model here "
            f"(gap at most {100.0 * self.over(bandwidth):.0f} %), gap over theta not known"
        )

    def entry_of(self, bandwidth: float) -> dict[str, Any]:
        """`entry` beside a design's ω_b in rad/s."""
        known = np.isfinite(self.outside)
        return self.entry | {"relative": self.over(bandwidth) if known else None}

    @property
    def entry(self) -> dict[str, Any]:
        """Of result.json, in Hz; null where nothing bounds ω_b."""

        def hz(omega: float) -> float | None:
            return omega / HZ if 0.0 < omega < np.inf else None

        return {
            "outside_hz": hz(self.outside),
            "inside_hz": hz(self.inside),
            "channels": {loop.name: hz(loop.outside) for loop in self.loops if loop.name},
        }


def gap_of(problem: CoDesignProblem, theta: Sequence[float], inside: bool = True) -> Gap:
    """Bounds from outside, and with `inside` from inside, on the model at θ.

    They hold for every set that holds the model. Raises UserError for a problem of another kind.
    """
    return Gap(tuple(reach(limits, inside) for limits in limits_of_problem(problem, theta)))


def known_gap(problem: CoDesignProblem, theta: Sequence[float]) -> Gap | None:
    """From outside, which takes seconds; None where there is none to know."""
    try:
        return gap_of(problem, theta, inside=False)
    except UserError:
        return None


def limits_of_problem(problem: CoDesignProblem, theta: Sequence[float]) -> list[Limits]:
    """One loop of a plant with one output; else one for each channel's direction of outputs."""
    if not isinstance(problem.controller, SectionsProblem):
        raise UserError('gap: is known for controller.structure = "sections" alone')
    if problem.figure is not BANDWIDTH:
        raise UserError("gap: is known for the bandwidth alone; drop inner.minimise")
    uncertain, structure = uncertain_plant(problem, theta), structure_of(problem)
    plant = uncertain.plant(uncertain.nominal).plant_si()
    bounds, sampling = bounds_of(problem), sections_of_problem(problem).sampling
    if not isinstance(structure, ChannelStructure):
        return [limits_of(plant, bounds, sampling, integrator=structure.integrator)]
    return [
        limits_of(
            plant, bounds.of_channel(i), sampling, name, structure.decoupling.outputs[:, i],
            ratio=float(np.exp(bounds.lead(i))), integrator=structure.integrator,
        )
        for i, name in enumerate(structure.decoupling.names)
    ]  # fmt: skip
