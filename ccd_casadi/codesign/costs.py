"""What robustness, hold and delay cost a design of fixed structure, in ω_b at its θ."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_bandwidth import sections_value
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem, uncertain_plant
from ccd_casadi.inner_problem.sections_problem import SectionsProblem
from ccd_casadi.inner_problem.sections_search import joined
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Costs:
    """ω_b in rad/s (NaN: none certified) at the ends of climbs from the design: `on_model` on the
    model alone, `continuous` on the set without hold and delay. At least that much is reached.
    """

    on_model: float
    continuous: float


def costs_of(problem: CoDesignProblem, theta: Sequence[float], kappa: Array) -> Costs:
    """The climbs from a certified design with parameters κ (SI)."""
    sections = replace(sections_of_problem(problem), minimise="bandwidth")
    model = tuple(map(float, uncertain_plant(problem, theta).nominal))

    def climbed(easier: SectionsProblem) -> float:
        value = sections_value(joined(replace(problem, controller=easier), kappa, ()), theta)
        return value.bandwidth if value.feasible else float("nan")

    return Costs(
        climbed(replace(sections, members=((0, model),))), climbed(replace(sections, sampling=None))
    )
