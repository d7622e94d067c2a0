"""The bound on every controller for a structured problem, at one θ."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    structure_of,
    structured_of,
    uncertain_plant,
)
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.limitations.bound import lower_bound, pointwise, upper_bound
from ccd_casadi.limitations.limits import Limits, limits_of
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.units import HZ


@dataclass(frozen=True)
class Gap:
    """ω_b in rad/s: no controller that keeps the bounds on the model has `upper_bound` (infinite:
    nothing bounds it), some controller has `lower_bound` (0: not computed); `channel` binds."""

    upper_bound: float
    lower_bound: float
    channel: str = ""

    def words(self, bandwidth: float) -> str:
        """Of the verdict, with a design's ω_b in rad/s."""
        if not np.isfinite(self.upper_bound):
            return "no bound on every controller, gap not known"
        return (
            f"no controller of any order exceeds {self.upper_bound / HZ:.2f} Hz on the model here "
            f"(gap at most {100.0 * (self.upper_bound / bandwidth - 1.0):.0f} %), gap over theta "
            "not known"
        )

    def entry(self, bandwidth: float = np.nan) -> dict[str, Any]:
        """Of result.json: Hz, and the bound over a design's ω_b (rad/s) less 1; null: not known.

        `objective_bound`, of J over θ, is not known yet.
        """
        found = {
            "bandwidth_bound_hz": self.upper_bound / HZ,
            "inside_hz": self.lower_bound / HZ or np.nan,
            "relative": self.upper_bound / bandwidth - 1.0,
            "channel": self.channel,
            "objective_bound": np.nan,
            "words": self.words(bandwidth) if np.isfinite(bandwidth) else "",
        }
        return json_values(found)


def gap_of(problem: CoDesignProblem, theta: Sequence[float], within: bool = True) -> Gap:
    """The bound from outside on the model at θ; `within`, of one channel, from inside besides.

    It holds for every set that holds the model. Raises UserError for a problem of another kind.
    """
    found, channel = np.inf, ""
    loops = sorted(limits_of_problem(problem, theta), key=pointwise)
    for limits in loops:
        bound = upper_bound(limits, found)
        if bound < found:
            found, channel = bound, limits.name
    return Gap(found, lower_bound(loops[0], found) if within and len(loops) == 1 else 0.0, channel)


def known_gap(problem: CoDesignProblem, theta: Sequence[float]) -> Gap | None:
    """From outside, which takes seconds; None where there is none to know."""
    try:
        return gap_of(problem, theta, within=False)
    except UserError:
        return None


def limits_of_problem(problem: CoDesignProblem, theta: Sequence[float]) -> list[Limits]:
    """One loop of a plant with one output; else one for each channel's direction of outputs."""
    if not isinstance(problem.controller, StructuredProblem):
        raise UserError('gap: is known for controller.structure = "sections" alone')
    if problem.figure is not BANDWIDTH:
        raise UserError("gap: is known for the bandwidth alone; drop inner.minimise")
    uncertain, structure = uncertain_plant(problem, theta), structure_of(problem)
    plant = uncertain.plant(uncertain.nominal).plant_si()
    bounds, sampling = bounds_of(problem), structured_of(problem).sampling
    if not isinstance(structure, ChannelStructure):
        return [limits_of(plant, bounds, sampling, integrator=structure.integrator)]
    whole = bounds.weights  # a channel's own M_K bounds one direction of its forces alone
    return [
        limits_of(
            plant, replace(bounds.of_channel(i), weights=whole), sampling, name,
            structure.decoupling.outputs[:, i], ratio=float(np.exp(bounds.lead(i))),
            integrator=structure.integrator,
        )
        for i, name in enumerate(structure.decoupling.names)
    ]  # fmt: skip
