"""The search of a controller of fixed structure at a θ, its warm starts, and the worst plants.

A multi-start search gives warm starts, the distinct best controllers; plants of the box on which
these exceed a bound join the set, and the design is made anew from the warm starts, until none is
found.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.fixed_structure.least_value import LeastValue
from ccd_casadi.fixed_structure.local_search import OptimalityOptions
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.structured_bandwidth import ProblemAt, structured_value, too_slow
from ccd_casadi.inner_problem.structured_plant_set import (
    structured_of,
    uncertain_plant,
    with_channels,
    with_structured,
)
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Tell, silent

MOST_WARM_STARTS = 3
ENOUGH = 12  # starts before a search may say that it found no controller within the bounds
MOST_STARTS = 36  # of a search that has found its best only once
DISTINCT = 0.1  # relative: local optima further below the best are no warm starts
ROUNDS, ROUNDS_OF_ERROR = 8, 4  # of a design on the set and a search for plants that are worse
SLOWEST, FASTEST = 1e-3, 30.0  # of K's frequencies, over ω₀ and over the fastest pole at the start


def race(
    problem: CoDesignProblem,
    theta: Sequence[float],
    tell: Tell = silent,
    workers: Pool | None = None,
    only_warm_starts: bool = False,
) -> SectionsDesign:
    """A multi-start search at θ: the problem's starts, and its warm starts beside them or alone.

    The problem's starts are the least number: it goes on, up to `MOST_STARTS`, until its best was
    found twice. Few starts that all miss a bound prove little: then it searches from `ENOUGH`.
    """
    here, structured = ProblemAt(problem, theta), structured_of(problem)
    warm_starts = [np.array(kappa) for kappa in structured.warm_starts]
    starts = None if only_warm_starts else structured.starts
    made = here.searched(warm_starts, starts, MOST_STARTS, tell, workers)
    if made.certified or starts is None or starts >= ENOUGH:
        return made
    return here.searched(warm_starts, ENOUGH, MOST_STARTS, tell, workers)


def with_range(problem: CoDesignProblem) -> CoDesignProblem:
    """The problem with its channels and the range of K's frequencies, by the plant at its start,
    alike at every θ.

    A range that moved with θ would move ω_b*(θ) where it binds, unseen by the envelope gradient.
    """
    problem = with_channels(problem)
    structured = structured_of(problem)
    if structured.frequencies is not None:
        return problem
    plant = scaled_plant(problem, problem.start)
    poles = np.abs(np.linalg.eigvals(plant.A))
    fastest = FASTEST * max(1.0, float(poles.max())) * plant.omega_0
    slowest = SLOWEST * plant.omega_0
    if structured.sampling is not None:
        fastest = min(fastest, 2.0 / structured.sampling.period)
        slowest = min(slowest, 0.01 * fastest)
    return with_structured(problem, frequencies=(slowest, fastest))


def prepared(
    problem: CoDesignProblem,
    tell: Tell = silent,
    workers: Pool | None = None,
    only_warm_starts: bool = False,
) -> tuple[CoDesignProblem, SectionsDesign, Excess | None]:
    """The problem with warm starts and plants: searched at its start θ, worst plants added.

    With `only_warm_starts` the warm starts that it has alone are where searches start. The design
    is the search's last; where it is not certified the problem has no warm starts, and each θ is
    searched on its own. All of it is of the largest bandwidth, whatever the problem minimises.
    Third the worst plant for the design, where it was searched.
    """
    asked = structured_of(problem).minimise
    problem = with_range(with_structured(problem, minimise="bandwidth"))
    corners = uncertain_plant(problem, problem.start).corners()
    scenarios = tuple((option, tuple(map(float, point))) for option, point in corners)
    problem = with_structured(problem, scenarios=scenarios)

    made = race(problem, problem.start, tell, workers, only_warm_starts)
    worst: Excess | None = None
    last = True  # a search that ended off its optimum goes on to it once no plant is found worse
    for turn in range(ROUNDS if made.certified else 0):
        worst, wider = _wider(problem, problem.start, made, turn, tell)
        if wider is None and (last or made.kkt_residual <= OptimalityOptions.residual):
            break
        last = wider is None
        problem = with_structured(wider or problem, warm_starts=_warm_starts(made))
        if not last:
            made = race(problem, problem.start, tell, workers, only_warm_starts=True)
        if last or not made.certified:  # which has a few starts more where warm ones lead to none
            made = structured_value(problem, problem.start, workers).design
        worst = None
        if not made.certified:
            break
    if made.certified:
        problem = with_structured(problem, warm_starts=_warm_starts(made))
    return with_structured(problem, minimise=asked), made, worst


def _wider(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign, turn: int,
    tell: Tell,
) -> tuple[Excess, CoDesignProblem | None]:  # fmt: skip
    """The worst plant, and the problem with those that are worse than its own, if there are any."""
    worst, found = DesignOnBox(problem, theta, design).worst(turn, tell)
    scenarios = (*structured_of(problem).scenarios, *found)
    return worst, with_structured(problem, scenarios=scenarios) if found else None


def _warm_starts(design: SectionsDesign) -> tuple[tuple[float, ...], ...]:
    """The certified design's κ first, then those of the other local optima near it."""
    own, omega_b = tuple(map(float, design.kappa)), design.bandwidth
    others = [
        optimum.kappa
        for optimum in design.local_optima
        if (1.0 - DISTINCT) * omega_b <= optimum.bandwidth < (1.0 - 1e-3) * omega_b
    ]
    return (own, *others)[:MOST_WARM_STARTS]


def with_warm_start(problem: CoDesignProblem, kappa: Sequence[float] | Array) -> CoDesignProblem:
    """The problem with one more warm start, first, of what it minimises."""
    structured = structured_of(problem)
    structured = structured.with_warm_start(tuple(map(float, kappa)), MOST_WARM_STARTS + 1)
    return replace(problem, controller=structured)


def least_from(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign, tell: Tell = silent
) -> tuple[CoDesignProblem, SectionsDesign, LeastValue | None]:
    """The problem and the design that it counts, from one of largest bandwidth: that itself, or the
    one of the least of another figure, not certified where it has to be slower than is allowed.

    The problem has the plants then that were found worse on the way, and that design as the first
    of its warm starts.
    """
    if problem.figure is BANDWIDTH or not (design := too_slow(problem, design)).certified:
        return problem, design, None
    wider = problem
    for turn in range(ROUNDS_OF_ERROR):
        problem = wider
        found = ProblemAt(problem, theta).least(design, tell=tell)
        wider = _wider(problem, theta, found.design, turn, tell)[1] or problem
        if wider is problem:
            break
    return with_warm_start(problem, found.design.kappa), found.design, found
