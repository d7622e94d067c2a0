"""The final judgement of a design on the plants as written, by our judge and by SLICOT."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from math import inf

import numpy as np

from ccd_casadi.fixed_structure import SectionsDesign, certify
from ccd_casadi.fixed_structure.judgement import Judgement, judgement_of
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, require_as_returned
from ccd_casadi.inner_problem.structured_plant_set import structured_of, uncertain_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import NOMINAL
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.synthesis.second_engine import (
    NOT_COMPARED,
    EngineComparison,
    compared,
    second_opinion,
)
from ccd_casadi.synthesis.synthesis import Design


def written_plants(
    problem: CoDesignProblem, theta: Sequence[float], shifts: int | None = None
) -> list[StateSpace]:
    """The model at θ and the plants of a mixed-sensitivity design's set, as they were written.

    Parameters
    ----------
    problem : CoDesignProblem
        With the plant and its set.
    theta : (n_θ,) sequence
        SI.
    shifts : int or None
        The number of shifts of its resonances; None: the set's own.

    Returns
    -------
    list of StateSpace
        The model first; SI, u in and y out.
    """
    require_as_returned(problem, theta)
    system, robust = mechanics(plant_of(problem), theta, derivatives=False), problem.robust
    places = () if robust is None else robust.perturbations(shifts)
    others = [off for off in places if off != NOMINAL]
    count = problem.suspension.rigid_modes
    return [
        as_written(system, shift=off.shift, damping=off.damping, rigid_modes=count)
        for off in (NOMINAL, *others)
    ]


def judge_on_model(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> Judgement:
    """A mixed-sensitivity design (e in, u out, SI) on the model at θ: S_max, S_low, stability.

    Its set is of the check that `robust` is.
    """
    model = written_plants(problem, theta)[:1]
    return judgement_of(certify(model, controller, kind_of(problem).bounds()), 1)


def second_on_weighted(
    problem: CoDesignProblem, theta: Sequence[float], design: Design
) -> EngineComparison:
    """Of mixed sensitivity: the norm that γ was reached with on the plant of the design, and the
    largest ‖S‖∞ and ‖GS‖∞ of its set."""
    figures = design.figures
    opinions = [
        second_opinion(plant, design.controller, weights=weights)
        for plant, weights in zip_longest(written_plants(problem, theta), [design.weights])
    ]
    claims = {"S": figures.sensitivity_peak, "GS": figures.compliance}
    worst = {name: max(opinions, key=lambda one: one.norms.get(name, inf)) for name in claims}
    found = compared([
        (opinions[0], {"weighted_loop": figures.certificate.norm}),
        *((worst[name], {name: claim}) for name, claim in claims.items()),
    ])  # fmt: skip
    return replace(found, loops=len(opinions))


def second_on_set(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> EngineComparison:
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
