"""Each requirement of a case beside what its design achieves, where, and how that is known.

    margin = 1 - achieved/required      of an upper bound,   achieved/required - 1 of a lower one

so that 0 binds and what is negative is missed. The figures are the judge's, of the plants as their
function returned them.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite, nan
from typing import Any

from ccd_casadi.analysis import MOTOR_LIMITS
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.fixed_structure.bounds import Bounds, key_words
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.objective import constraint_sizes
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.plant import constraint_values
from ccd_casadi.support.text import HZ


class Evidence(StrEnum):
    """The way in which a figure is known; its value is the word for it.

    Attributes
    ----------
    PROVEN
        On the whole set of plants.
    SEARCHED
        On many plants of a set, the worst that a search found among them.
    JUDGED
        On the plant that the case has.
    """

    PROVEN = "proven"
    SEARCHED = "searched"
    JUDGED = "judged"


@dataclass(frozen=True)
class Requirement:
    """One requirement and what is achieved.

    Attributes
    ----------
    name : str
        The bound's key, or the name of a constraint on θ.
    required, achieved : float
        In the unit of the key, `achieved` NaN where it is not known.
    margin : float
        See the head of the module; of a constraint λ <= 0 it is -λ over its range, of a motor's
        limit the share of it that is left.
    plant : str
        Where the figure is largest; empty of one plant.
    frequency_hz : float
        Where it is attained; NaN where that is not known.
    evidence : Evidence
    """

    name: str
    required: float
    achieved: float
    margin: float
    plant: str
    frequency_hz: float
    evidence: Evidence

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of result.json."""
        return {**vars(self), "evidence": self.evidence.value}


def requirements(verified: Verified, peak_hz: float) -> tuple[Requirement, ...]:
    """List the requirements on a design: bounds on the loop, then constraints on θ.

    Parameters
    ----------
    verified : Verified
    peak_hz : float
        Where |S| is largest, of one plant.

    Returns
    -------
    tuple of Requirement
    """
    problem, bounds, judged = (
        verified.problem,
        kind_of(verified.problem).bounds(),
        verified.judgement,
    )
    required, worst = _required_bounds(bounds), verified.largest_at(bounds, peak_hz)
    proven = verified.proven_figures()
    evidence = Evidence.SEARCHED if judged.plants > 1 else Evidence.JUDGED
    found = []
    of_set = verified.robust
    for name, share in judged.figures.items():
        if name in required:
            achieved = share * required[name] if isfinite(share) else nan
            if name == "S_max" and of_set is not None and not of_set.peak <= achieved:
                # mixed sensitivity is judged on its model, and its peak followed along the set
                at = f"resonance_shift {100.0 * of_set.at.shift:+.3g} %"
                at += "" if of_set.at.damping == 1.0 else f", damping x {of_set.at.damping:g}"
                peak = of_set.peak if isfinite(of_set.peak) else nan
                found.append(Requirement(name, required[name], peak, 1.0 - peak / required[name],
                                         at, nan, Evidence.SEARCHED))  # fmt: skip
                continue
            found.append(Requirement(
                key_words(name), required[name], achieved, 1.0 - achieved / required[name],
                *worst.get(name, ("", nan)), Evidence.PROVEN if name in proven else evidence,
            ))  # fmt: skip
    if problem.controller.bandwidth_least:
        least, hz = problem.controller.bandwidth_least / HZ, verified.bandwidth / HZ
        found.append(
            Requirement("bandwidth_least_hz", least, hz, hz / least - 1.0, "", nan, evidence)
        )
    plant = plant_of(problem)
    values, sizes = constraint_values(plant, verified.theta), constraint_sizes(problem)
    for name, value, size in zip(plant.constraint_names, values, sizes, strict=True):
        of_motor = problem.source.motion is not None and name in MOTOR_LIMITS
        margin = -float(value) / (1.0 if of_motor else float(size))
        found.append(Requirement(name, 0.0, float(value), margin, "", nan, Evidence.JUDGED))
    return tuple(found)


def _required_bounds(bounds: Bounds) -> dict[str, float]:
    """The bounds by the names that the judge has, in the units of their keys."""
    level, compliance = bounds.weighted_level, bounds.compliance_max
    known = {
        "S_max": bounds.S_max,
        "S_low": bounds.S_low,
        "KS": level,
        "T": level,
        "GS": compliance,
    }
    for own in bounds.channels:
        known |= {f"S_max of {own.name}": own.S_max, f"KS of {own.name}": own.M_K and level}
    return {name: value for name, value in known.items() if value is not None}
