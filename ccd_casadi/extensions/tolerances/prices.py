"""What each tolerance of a run costs: ω_b at other widths, from re-solves, beside the multipliers.

A tolerance t at θ with f(t) = ω_b*(θ; t): it costs f(0) - f(t), and half of it buys f(t/2) - f(t).
Each f is a design of its own, from the run's controller, on its own worst plants. The multipliers
give only the slope df/d ln t at t; between 0 and t the active plants change, so the slope is listed
beside the re-solves and is not the price.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.extensions.tolerances.machines import tolerance_of
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import with_state
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import Uncertainty, structured_of, with_structured
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import prepared
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import silent
from ccd_casadi.support.text import HZ, number

SHARES = ("resonance_shift", "mode_shift", "gain")  # half-widths as shares


@dataclass(frozen=True)
class Price:
    """What one tolerance costs, in rad/s.

    Attributes
    ----------
    name, width : str
        Which, and how wide it is, in words.
    cost : float
        ω_b without it, less ω_b with it.
    half_buys : float
        ω_b with half of it, less ω_b with it.
    slope : float
        -dω_b/d ln t by the multipliers; NaN where they are not known.
    """

    name: str
    width: str
    cost: float
    half_buys: float
    slope: float

    @property
    def entry(self) -> dict[str, Any]:
        """Of tolerances.json."""
        hz = {"costs_hz": self.cost, "half_buys_hz": self.half_buys, "slope_hz": self.slope}
        found = {key: w / HZ for key, w in hz.items()}
        return {"tolerance": self.name, "width": self.width, **found}

    @property
    def words(self) -> str:
        """One line."""
        cost, buys = number(self.cost / HZ, 3), number(self.half_buys / HZ, 3)
        return f"{self.name} {self.width}: costs {cost} Hz; half of it buys {buys} Hz"


def tolerances_of(problem: CoDesignProblem) -> tuple[str, ...]:
    """The names of a problem's tolerances, modes together."""
    names = uncertain_plant(problem, problem.start).names
    return tuple(dict.fromkeys(map(tolerance_of, names)))


def scaled(problem: CoDesignProblem, name: str, factor: float) -> CoDesignProblem:
    """Scale the width of one tolerance around the model; damping in its logarithm."""
    own: Uncertainty = structured_of(problem).uncertainty
    if name in SHARES:
        changed = replace(own, **{name: factor * getattr(own, name)})
    elif name == "damping":
        low, high = own.damping
        changed = replace(own, damping=(low**factor, high**factor))
    else:
        held = problem.source.held

        def around(key: str, low: float, high: float) -> tuple[str, float, float]:
            if f"theta.{key}" != name:
                return key, low, high
            model = held[key]
            return key, model + factor * (low - model), model + factor * (high - model)

        changed = replace(own, ranges=tuple(around(*each) for each in own.ranges if factor
                                            or f"theta.{each[0]}" != name))  # fmt: skip
    return with_structured(problem, uncertainty=changed)


def width_words(problem: CoDesignProblem, name: str) -> str:
    """How wide a tolerance is."""
    own = structured_of(problem).uncertainty
    if name in SHARES:
        return f"±{100.0 * getattr(own, name):g} %"
    ends = {"damping": own.damping} | {f"theta.{key}": ends for key, *ends in own.ranges}
    low, high = ends[name]
    return f"{low:g} to {high:g}"


def redesigned(
    problem: CoDesignProblem, theta: Sequence[float], kappa: Array, workers: Pool | None = None
) -> tuple[CoDesignProblem, SectionsDesign]:
    """The best from a controller at θ on the worst plants of the problem's own box: the problem at
    θ with these plants, and the design."""
    at = replace(problem, start=tuple(map(float, theta)))
    at = with_state(at, warm_starts=(tuple(map(float, kappa)),), scenarios=())
    found, made, _ = prepared(at, silent, workers, only_warm_starts=True)
    return found, made


def prices(
    problem: CoDesignProblem, theta: Sequence[float], kappa: Array, workers: Pool | None,
    tell: Callable[[str], object],
) -> tuple[float, tuple[Price, ...]]:  # fmt: skip
    """Price every tolerance of a design.

    Parameters
    ----------
    problem, theta, kappa : CoDesignProblem, sequence of float, array
        Of a finished run, SI.
    workers, tell : Pool or None, callable

    Returns
    -------
    bandwidth : float
        ω_b of the design with all of them, rad/s.
    prices : tuple of Price
    """
    own, made = redesigned(problem, theta, kappa, workers)
    slopes = DesignOnBox(own, theta, made).tolerance_prices()

    def at(name: str, factor: float) -> float:
        _, found = redesigned(scaled(problem, name, factor), theta, made.kappa, workers)
        tell(f"{name} times {factor:g}: {found.bandwidth / HZ:.5g} Hz")
        # the design of the wider set is one of the narrower set, whatever the search found
        return max(found.bandwidth if found.certified else 0.0, made.bandwidth)

    found = []
    for name in tolerances_of(problem):
        known = [w for key, w in slopes.items() if tolerance_of(key) == name]
        found.append(Price(
            name, width_words(problem, name),
            at(name, 0.0) - made.bandwidth, at(name, 0.5) - made.bandwidth,
            -sum(known) if known else np.nan,
        ))  # fmt: skip
    return made.bandwidth, tuple(found)
