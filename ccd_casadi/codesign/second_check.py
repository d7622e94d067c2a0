"""The second engine on every loop of a design, for each kind of controller.

Plants are as the person's function returned them: no modes, suspension, reduction or scaling of the
search is in them. What the first engine claims of its own plants must hold there.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from math import inf

import numpy as np

from ccd_casadi.codesign.judgement import written_plants
from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import structured_of, uncertain_plant
from ccd_casadi.synthesis.second_engine import NOT_COMPARED, Comparison, compared, second_opinion
from ccd_casadi.synthesis.synthesis import Design


def second_on_weighted(
    problem: CoDesignProblem, theta: Sequence[float], design: Design
) -> Comparison:
    """Of mixed sensitivity: the norm that γ was reached with and ‖GS‖∞ on the model, and the
    largest ‖S‖∞ of its set."""
    figures = design.figures
    opinions = [
        second_opinion(plant, design.controller, weights=weights)
        for plant, weights in zip_longest(written_plants(problem, theta), [design.weights])
    ]
    worst = max(opinions, key=lambda one: one.norms.get("S", inf))
    found = compared([
        (opinions[0], {"weighted_loop": figures.certificate.norm, "GS": figures.compliance}),
        (worst, {"S": figures.sensitivity_peak}),
    ])  # fmt: skip
    return replace(found, loops=len(opinions))


def second_on_set(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> Comparison:
    """Of a fixed structure: ‖S‖∞, and those of KS and T, of a continuous loop of GS too, on every
    plant that its certificate is of, as the loop runs."""
    judged, K = design.certificate, design.controller
    if judged is None or K is None:
        return NOT_COMPARED
    uncertain, scenarios = uncertain_plant(problem, theta), structured_of(problem).scenarios
    points = [(option, np.array(point)) for option, point in scenarios] or uncertain.corners()
    pairs = zip(uncertain.as_written(points), judged.plants, strict=True)
    of_GS = ("GS",) if problem.sampling is None else ()
    return compared(
        (second_opinion(plant, K, problem.sampling),
         {"S": figures.S_peak} | {name: getattr(figures, name) for name in ("KS", "T", *of_GS)})
        for plant, figures in pairs
    )  # fmt: skip
