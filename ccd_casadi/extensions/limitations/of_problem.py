"""The bound on every controller for a structured problem, at one θ."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.extensions.limitations.bound import (
    forbids,
    forbids_most,
    lower_bound,
    pointwise,
    upper_bound,
)
from ccd_casadi.extensions.limitations.limits import Limits, limits_of
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import StructuredProblem, structured_of
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import HZ, number

MODEL = "the model"


@dataclass(frozen=True)
class BandwidthGap:
    """Bounds on the bandwidth of every controller that keeps the bounds on the loop.

    Attributes
    ----------
    upper_bound : float
        No controller on `plants` has this ω_b, rad/s; infinite: nothing bounds it.
    lower_bound, model_bound : float
        One on the model has the first, none the second, rad/s; 0: not computed.
    channel : str
        That binds.
    plants : str
        In words.
    """

    upper_bound: float
    lower_bound: float = 0.0
    channel: str = ""
    plants: str = MODEL
    model_bound: float = 0.0

    def words(self, bandwidth: float) -> str:
        """Of the verdict, with a design's ω_b in rad/s."""
        if not np.isfinite(self.upper_bound):
            return "no bound on every controller, gap not known"
        gap = 100.0 * (self.upper_bound / bandwidth - 1.0)
        return (
            f"no controller of any order exceeds {number(self.upper_bound / HZ, 4)} Hz on "
            f"{self.plants} here (gap at most {gap:.0f} %), gap over theta not known"
        )

    def entry(self, bandwidth: float = np.nan) -> dict[str, Any]:
        """Of result.json: Hz, and the bound over a design's ω_b (rad/s) less 1; null: not known.

        `objective_bound`, of J over θ, is not known yet.
        """
        found = {
            "bandwidth_bound_hz": self.upper_bound / HZ,
            "plants": self.plants,
            "model_bound_hz": self.model_bound / HZ or np.nan,
            "inside_hz": self.lower_bound / HZ or np.nan,
            "relative": self.upper_bound / bandwidth - 1.0,
            "channel": self.channel,
            "objective_bound": np.nan,
            "words": self.words(bandwidth) if np.isfinite(bandwidth) else "",
        }
        return json_values(found)


def gap_of(problem: CoDesignProblem, theta: Sequence[float], within: bool = True) -> BandwidthGap:
    """The bound on every controller at θ.

    On the model it holds for every set that has the model in it.

    Parameters
    ----------
    problem : CoDesignProblem
        With controllers of fixed structure.
    theta : (n_θ,) sequence
        SI.
    within : bool
        Whether to bound it on the model from both sides too, of one channel.

    Returns
    -------
    BandwidthGap
        rad/s.

    Raises
    ------
    UserError
        The problem is of another kind.
    """
    loops = sorted(limits_of_problem(problem, theta), key=pointwise)
    if loops[0].name:
        found, channel = np.inf, ""
        for limits in loops:
            bound = upper_bound(limits, found)
            if bound < found:
                found, channel = bound, limits.name
        return BandwidthGap(found, channel=channel)
    (model,) = loops
    pairs = opposite_corners(
        uncertain_plant(problem, theta), bounds_of(problem), structured_of(problem).sampling,
        integrator=model.integrator,
    )  # fmt: skip
    limits = forbids_most([model, *pairs])
    gap = BandwidthGap(upper_bound(limits), plants="the set" if limits.others else MODEL)
    if not within:
        return gap
    most = upper_bound(model)
    return replace(gap, model_bound=most, lower_bound=lower_bound(model, most))


def opposite_corners(
    uncertain: UncertainPlant, bounds: Bounds, sampling: Sampling | None, integrator: bool
) -> list[Limits]:
    """Of one input and output: each corner of the box with the least damping, and the one opposite.

    One controller serves both, so that both plants' bounds count; T is the first one's.
    """

    def limits(point: Array) -> Limits:
        return limits_of(uncertain.plant(point).plant_si(), bounds, sampling, integrator=integrator)

    found: list[Limits] = []
    box, several = uncertain.box, uncertain.options[0].B.shape[1] > 1
    damping = np.array([name == "damping" for name in uncertain.names], bool)
    for option, point in uncertain.corners()[len(uncertain.options) :]:
        if option or several or (point > box[0])[damping].any():
            continue
        opposite = np.where(damping, point, box.sum(axis=0) - point)
        with suppress(PlantError):
            found.append(replace(limits(point), others=(limits(opposite),)))
    return found


def known_gap(problem: CoDesignProblem, theta: Sequence[float]) -> BandwidthGap | None:
    """The upper bound alone, which takes seconds.

    Parameters
    ----------
    problem, theta : CoDesignProblem, (n_θ,) sequence
        As of `gap_of`.

    Returns
    -------
    BandwidthGap or None
        None for a problem of another kind.
    """
    try:
        return gap_of(problem, theta, within=False)
    except UserError:
        return None


def none_reaches(problem: CoDesignProblem, theta: Sequence[float], omega_b: float) -> bool:
    """Whether it is shown, in a fraction of a second, that no controller has a bandwidth.

    Parameters
    ----------
    problem, theta : CoDesignProblem, (n_θ,) sequence
        As of `gap_of`; the model alone counts.
    omega_b : float
        rad/s.

    Returns
    -------
    bool
        False where nothing is known.
    """
    if not omega_b > 0.0:
        return False
    try:
        loops = limits_of_problem(problem, theta)
    except (UserError, PlantError):
        return False
    return any(forbids(limits, omega_b) for limits in loops)


def limits_of_problem(problem: CoDesignProblem, theta: Sequence[float]) -> list[Limits]:
    """One loop of a plant with one output; else one for each channel's direction of outputs."""
    if not isinstance(problem.controller, StructuredProblem):
        raise UserError('gap: is known for controller.structure = "sections" alone')
    if problem.figure is not BANDWIDTH:
        raise UserError("gap: is known for the bandwidth alone; drop inner.minimise")
    if structured_of(problem).bandwidth_of is not None:
        raise UserError("gap: is known for one sensor for each actuator; drop bandwidth_of")
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
