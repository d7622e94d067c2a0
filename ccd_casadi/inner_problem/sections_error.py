"""The controller of least RMS error at a θ, from the one of largest bandwidth."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.fixed_structure.design import Progress
from ccd_casadi.fixed_structure.least_error import LeastError, least_error
from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_bandwidth import joined, too_slow
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, plants_of, sections_of_problem
from ccd_casadi.inner_problem.sections_robustness import worst_members

ROUNDS = 4  # of a search on the set and one for plants that are worse


def least_error_at(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made: SectionsDesign,
    progress: Progress | None = None,
) -> tuple[CoDesignProblem, LeastError]:
    """The problem with the plants that were found worse on the way, and the design on all of them,
    which is the first of its anchors of least error.

    The problem has a budget; `made` is its certified design of largest bandwidth.
    """
    assert problem.budget is not None
    found: LeastError | None = None
    for turn in range(ROUNDS):
        sections = sections_of_problem(problem)
        found = least_error(
            plants_of(problem, theta), bounds_of(problem), made, problem.budget,
            sampling=sections.sampling, least_bandwidth=sections.bandwidth_least,
            initial=[np.array(kappa) for kappa in sections.error_anchors], progress=progress,
        )  # fmt: skip
        members = worst_members(problem, theta, found.design, turn, progress)[1]
        if not members or turn == ROUNDS - 1:
            break
        problem = replace(
            problem, controller=replace(sections, members=(*sections.members, *members))
        )
    assert found is not None
    return joined(problem, found.design.kappa, ()), found


def least_from(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made: SectionsDesign,
    progress: Progress | None = None,
) -> tuple[CoDesignProblem, SectionsDesign]:
    """The problem and the design that it counts, from one of largest bandwidth: that itself, or the
    one of least error, not certified where it has to be slower than is allowed."""
    if problem.figure is BANDWIDTH or not made.certified:
        return problem, made
    made = too_slow(problem, made)
    if not made.certified:
        return problem, made
    problem, found = least_error_at(problem, theta, made, progress)
    return problem, found.design
