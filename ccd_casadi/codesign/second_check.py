"""The second engine on every loop of a design, for each kind of controller."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from math import inf

from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.structured_plant_set import plants_of
from ccd_casadi.synthesis.second_engine import NOT_COMPARED, Comparison, compared, second_opinion
from ccd_casadi.synthesis.synthesis import Design


def second_on_weighted(
    problem: CoDesignProblem, theta: Sequence[float], design: Design
) -> Comparison:
    """Of mixed sensitivity: the norm that γ was reached with, and the largest ‖S‖∞ of its set."""
    figures, plant = design.figures, scaled_plant(problem, theta)
    opinions = [
        second_opinion(member.plant_si(), design.controller, weights=weights)
        for member, weights in zip_longest(plant.members, [design.weights])
    ]
    worst = max(opinions, key=lambda one: one.norms.get("S", inf))
    found = compared([
        (opinions[0], {"weighted_loop": figures.certificate.norm}),
        (worst, {"S": figures.sensitivity_peak}),
    ])  # fmt: skip
    return replace(found, loops=len(opinions))


def second_on_set(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> Comparison:
    """Of a fixed structure: ‖S‖∞ on every plant that its certificate is of, as the loop runs."""
    judged, K = design.certificate, design.controller
    if judged is None or K is None:
        return NOT_COMPARED
    pairs = zip(plants_of(problem, theta), judged.plants, strict=True)
    return compared(
        (second_opinion(plant.plant_si(), K, problem.sampling), {"S": figures.S_peak})
        for plant, figures in pairs
    )
