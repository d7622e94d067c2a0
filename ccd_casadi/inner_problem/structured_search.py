"""The search of a controller of fixed structure at a θ, its warm starts, and the worst plants.

A multi-start search gives warm starts, the distinct best controllers; plants of the box on which
these exceed a bound join the set, and the design is made anew from the warm starts, until none is
found.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.least_value import LeastValue
from ccd_casadi.fixed_structure.local_search import OptimalityOptions
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.searched_problem import (
    WarmStartOptions,
    state_of,
    with_state,
    with_warm_start,
)
from ccd_casadi.inner_problem.structured_bandwidth import ProblemAt, structured_value, too_slow
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant, with_channels
from ccd_casadi.inner_problem.structured_problem import structured_of, with_structured
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.time_budget import ends_early, time_is_up


@dataclass(frozen=True)
class StructuredSearchOptions:
    """Numbers of the search of a controller of fixed structure on a box of plants."""

    warm_starts: int = WarmStartOptions.found  # that are kept
    least_starts: int = 12  # before no controller within the bounds counts as found
    most_starts: int = 36  # of a search that has found its best only once
    distinct: float = 0.1  # relative: local optima further below the best are not warm starts
    rounds: int = 8  # of a design on the set and a search for worse plants
    rounds_of_least: int = 4  # the same where another figure than the bandwidth counts
    slowest: float = 1e-3  # of K's frequencies, over ω₀
    fastest: float = 30.0  # of K's frequencies, over the fastest pole at the start


def search_starts(
    problem: CoDesignProblem,
    theta: Sequence[float],
    log: Log = silent,
    workers: Pool | None = None,
    only_warm_starts: bool = False,
    options: StructuredSearchOptions = StructuredSearchOptions(),
) -> SectionsDesign:
    """Search a controller at θ from many starts.

    The problem's starts are the least number: more are added, up to `options.most_starts`, until
    the best was found twice. Few starts that all miss a bound prove little: then it searches from
    `options.least_starts`.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float
    log, workers : callable, Pool, optional
    only_warm_starts : bool
        Without other starts than the problem's warm starts.
    options : StructuredSearchOptions

    Returns
    -------
    SectionsDesign
    """
    here, structured = ProblemAt(problem, theta), structured_of(problem)
    warm_starts = [np.array(kappa) for kappa in state_of(problem).warm_starts]
    starts = None if only_warm_starts else structured.starts
    made = here.search(warm_starts, starts, options.most_starts, log, workers)
    least = options.least_starts
    if made.certified or starts is None or starts >= least or ends_early("controller start", least):
        return made
    return here.search(warm_starts, least, options.most_starts, log, workers)


def with_range(
    problem: CoDesignProblem, options: StructuredSearchOptions = StructuredSearchOptions()
) -> CoDesignProblem:
    """Fix the channels and the range of K's frequencies of a problem, by the plant at its start.

    A range that moved with θ would move ω_b*(θ) where it binds, unseen by the envelope gradient.

    Parameters
    ----------
    problem : CoDesignProblem
    options : StructuredSearchOptions

    Returns
    -------
    CoDesignProblem
        With `channels` and `frequencies`.
    """
    problem = with_channels(problem)
    structured = structured_of(problem)
    if structured.frequencies is not None:
        return problem
    plant = scaled_plant(problem, problem.start)
    poles = np.abs(np.linalg.eigvals(plant.A))
    fastest = options.fastest * max(1.0, float(poles.max())) * plant.omega_0
    slowest = options.slowest * plant.omega_0
    if structured.sampling is not None:
        fastest = min(fastest, 2.0 / structured.sampling.period)
        slowest = min(slowest, 0.01 * fastest)
    return with_structured(problem, frequencies=(slowest, fastest))


def prepare_search(
    problem: CoDesignProblem,
    log: Log = silent,
    workers: Pool | None = None,
    only_warm_starts: bool = False,
    options: StructuredSearchOptions = StructuredSearchOptions(),
) -> tuple[CoDesignProblem, SectionsDesign, Excess | None]:
    """Search at the problem's start θ, and add the worst plants to its set until none is worse.

    All of it is of the largest bandwidth, whatever the problem minimises.

    Parameters
    ----------
    problem : CoDesignProblem
    log, workers : callable, Pool, optional
    only_warm_starts : bool
        Searches start from the problem's warm starts alone.
    options : StructuredSearchOptions

    Returns
    -------
    problem : CoDesignProblem
        With warm starts and scenarios; without warm starts where no design is certified: each θ is
        then searched separately.
    design : SectionsDesign
        The last.
    worst : Excess or None
        The worst plant for the design, where it was searched.
    """
    required = structured_of(problem).minimise
    problem = with_range(with_structured(problem, minimise="bandwidth"))
    corners = uncertain_plant(problem, problem.start).corners()
    scenarios = tuple((option, tuple(map(float, point))) for option, point in corners)
    problem = with_state(problem, scenarios=scenarios)

    made = search_starts(problem, problem.start, log, workers, only_warm_starts, options)
    worst: Excess | None = None
    last = True  # a search that ended off its optimum continues once no plant is found worse
    for turn in range(options.rounds if made.certified else 0):
        if ends_early("worst-plant check"):
            break
        worst, wider = _wider(problem, problem.start, made, turn, log, workers)
        if wider is None and (last or made.kkt_residual <= OptimalityOptions.residual):
            break
        last = wider is None
        problem = with_state(wider or problem, warm_starts=_warm_starts(made, options))
        if not last:
            made = search_starts(problem, problem.start, log, workers, True, options)
        if last or not made.certified:  # which has a few starts more where warm ones lead to none
            made = structured_value(problem, problem.start, workers).design
        worst = None
        if not made.certified:
            break
    if made.certified:
        problem = with_state(problem, warm_starts=_warm_starts(made, options))
    return with_structured(problem, minimise=required), made, worst


def _wider(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign, turn: int,
    log: Log, workers: Pool | None = None,
) -> tuple[Excess, CoDesignProblem | None]:  # fmt: skip
    """The worst plant, and the problem with those that are worse than its own, if there are any."""
    worst, found = DesignOnBox(problem, theta, design).worst(turn, log, workers)
    scenarios = (*state_of(problem).scenarios, *found)
    return worst, with_state(problem, scenarios=scenarios) if found else None


def _warm_starts(
    design: SectionsDesign, options: StructuredSearchOptions
) -> tuple[tuple[float, ...], ...]:
    """The certified design's κ first, then those of the other local optima near it."""
    own, omega_b = tuple(map(float, design.kappa)), design.bandwidth
    others = [
        optimum.kappa
        for optimum in design.local_optima
        if (1.0 - options.distinct) * omega_b <= optimum.bandwidth < (1.0 - 1e-3) * omega_b
    ]
    return (own, *others)[: options.warm_starts]


def least_from(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign, log: Log = silent,
    workers: Pool | None = None, options: StructuredSearchOptions = StructuredSearchOptions(),
) -> tuple[CoDesignProblem, SectionsDesign, LeastValue | None]:  # fmt: skip
    """Search the least of the problem's figure from a design of largest bandwidth.

    Parameters
    ----------
    problem, theta, design : CoDesignProblem, sequence of float, SectionsDesign
    log, workers : callable, Pool, optional
    options : StructuredSearchOptions

    Returns
    -------
    problem : CoDesignProblem
        With the plants that were found worse, and the new design as its first warm start.
    design : SectionsDesign
        Of the least figure; `design` itself where the bandwidth counts; not certified where it has
        to be slower than is allowed.
    found : LeastValue or None
    """
    if problem.figure is BANDWIDTH or not (design := too_slow(problem, design)).certified:
        return problem, design, None
    wider = problem
    for turn in range(options.rounds_of_least):
        problem = wider
        found = ProblemAt(problem, theta).least(design, log=log, workers=workers)
        if time_is_up():
            break
        wider = _wider(problem, theta, found.design, turn, log, workers)[1] or problem
        if wider is problem:
            break
    return with_warm_start(problem, found.design.kappa), found.design, found
