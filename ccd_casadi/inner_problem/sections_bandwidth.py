"""ω_b*(θ) of a fixed structure: one reproducible function of θ with its envelope gradient.

A multi-start search at one θ gives anchors, the distinct best controllers. ω_b*(θ) is the best of
the climbs from all anchors, and from nothing else: it depends neither on the order in which θ are
asked for nor on the number of workers. Where no anchor climbs to a certified design a
search of a few seeded starts is run at that θ, which is a function of θ too; not
with `starts` = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.fixed_structure.bandwidth_gradient import bandwidth_envelope
from ccd_casadi.fixed_structure.channel_design import synthesise
from ccd_casadi.fixed_structure.design import Progress
from ccd_casadi.fixed_structure.least_error import least_error
from ccd_casadi.fixed_structure.optimality import RESIDUAL, Envelope
from ccd_casadi.fixed_structure.sections_design import SectionsOutcome
from ccd_casadi.inner_problem.figure import BANDWIDTH, RMS_ERROR
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.sections_plant_set import (
    bounds_of,
    plants_of,
    sections_of_problem,
    structure_of,
    uncertain_plant,
    warm_starts,
    with_channels,
    with_sections,
)
from ccd_casadi.inner_problem.sections_problem import Member
from ccd_casadi.inner_problem.sections_robustness import worst_members
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.units import HZ

MOST_ANCHORS = 3
DISTINCT = 0.1  # relative: local optima further below the best are no anchors
ROUNDS = 6  # of a design on the set and a search for plants that are worse
FURTHER = 5  # climbs at most at a θ, of which the last go on from an end that is not optimal yet
LOST = 1e-6  # relative: of the bandwidth, by rounding
FEW = 8  # starts of the search at a θ where no anchor ends certified
SLOWEST, FASTEST = 1e-3, 30.0  # of K's frequencies, over ω₀ and over the fastest pole at the start


@dataclass(frozen=True)
class SectionsValue:
    """ω_b*(θ) in rad/s with its gradient (NaN where no certified design was found), the design.

    Of a problem that minimises the RMS error, `error` in m is what the gradient is of, `bandwidth`
    that of the design. `syntheses`: climbs and multi-start searches that it took. At a kink of the
    value the gradient is that of one side, and `envelope` has the others.
    """

    theta: tuple[float, ...]
    bandwidth: float
    gradient: tuple[float, ...]
    design: SectionsDesign
    syntheses: int
    error: float = float("nan")
    envelope: Envelope | None = None

    @property
    def value(self) -> float:
        """What J counts: the error where the problem minimises that, else ω_b*."""
        return self.bandwidth if np.isnan(self.error) else self.error

    @property
    def feasible(self) -> bool:
        """Whether the judge confirms a design at θ."""
        return self.design.certified


def sections_value(problem: CoDesignProblem, theta: Sequence[float]) -> SectionsValue:
    """The best certified design from the problem's anchors at θ, and the envelope gradient."""
    sections = sections_of_problem(problem)
    plants, bounds = plants_of(problem, theta), bounds_of(problem)
    initial = warm_starts(problem, structure_of(problem), plants, bounds)
    made: SectionsDesign | None = None
    spent = 0
    if initial:
        made = synthesise(
            plants, structure_of(problem), bounds, sampling=sections.sampling, seed=sections.seed,
            initial=initial, only_initial=True, frequencies=sections.frequencies,
        )  # fmt: skip
        spent += 1
    if made is None or (sections.starts and not made.certified):
        made = synthesise(
            plants, structure_of(problem), bounds, sampling=sections.sampling, seed=sections.seed,
            starts=min(FEW, sections.starts), initial=initial, frequencies=sections.frequencies,
        )  # fmt: skip
        spent += 1
    while made.certified and made.kkt_residual > RESIDUAL and spent < FURTHER:
        again = synthesise(
            plants, structure_of(problem), bounds, sampling=sections.sampling, seed=sections.seed,
            initial=[made.kappa], only_initial=True, frequencies=sections.frequencies,
        )  # fmt: skip
        spent += 1
        if not again.certified or again.bandwidth < (1.0 - LOST) * made.bandwidth:
            break
        made = again
    return valued(problem, theta, plants, made, spent)


def valued(
    problem: CoDesignProblem,
    theta: Sequence[float],
    plants: Sequence[ScaledPlant],
    made: SectionsDesign,
    spent: int,
) -> SectionsValue:
    """A design of largest bandwidth as a value of ω_b*(θ), or as the start to the least error."""
    point = tuple(float(v) for v in theta)
    error, envelope = np.nan, None
    if made.certified and problem.figure is RMS_ERROR:
        made, error, envelope = _least_error(problem, plants, made)
    elif made.certified:
        sampling = sections_of_problem(problem).sampling
        envelope = bandwidth_envelope(plants, bounds_of(problem), made, sampling)
    bandwidth = made.bandwidth if made.certified else np.nan
    gradient = np.full(len(point), np.nan) if envelope is None else envelope.gradient
    slope = tuple(map(float, gradient))
    return SectionsValue(point, float(bandwidth), slope, made, spent, float(error), envelope)


def require_bandwidth(problem: CoDesignProblem, command: str) -> None:
    """Raise UserError where J counts the RMS error, for a command that knows ω_b alone."""
    if problem.figure is not BANDWIDTH:
        words = f"{command} counts the bandwidth; solve, inner and retrain count the error"
        raise UserError(f'inner.minimise: is "rms_error", and {words}')


def too_slow(problem: CoDesignProblem, made: SectionsDesign) -> SectionsDesign:
    """The design, no longer a certified one where the least error asks for more bandwidth."""
    least = sections_of_problem(problem).bandwidth_least
    if made.bandwidth >= least:
        return made
    words = f"no controller was found above {made.bandwidth / HZ:.4g} Hz"
    words += f", inner.bandwidth_least_hz asks for {least / HZ:.4g} Hz"
    short = {"bandwidth_least_hz": least / made.bandwidth}
    return replace(made, outcome=SectionsOutcome.BOUND_NOT_MET, words=words, short=short)


def _least_error(
    problem: CoDesignProblem, plants: Sequence[ScaledPlant], made: SectionsDesign
) -> tuple[SectionsDesign, float, Envelope | None]:
    """The design of least RMS error, that in m, and its gradients to θ."""
    sections, bounds = sections_of_problem(problem), bounds_of(problem)
    assert problem.budget is not None
    made = too_slow(problem, made)
    if not made.certified:
        return made, np.nan, None
    started = with_sections(problem, anchors=sections.error_anchors)
    found = least_error(
        plants, bounds, made, problem.budget, sampling=sections.sampling,
        least_bandwidth=sections.bandwidth_least,
        initial=warm_starts(started, structure_of(problem), plants, bounds),
    )  # fmt: skip
    return found.design, found.error, found.envelope


def race(
    problem: CoDesignProblem,
    theta: Sequence[float],
    progress: Progress | None = None,
    workers: Pool | None = None,
    only_anchors: bool = False,
) -> SectionsDesign:
    """A multi-start search at θ: the problem's starts, and its anchors beside them or alone."""
    sections = sections_of_problem(problem)
    return synthesise(
        plants_of(problem, theta), structure_of(problem), bounds_of(problem),
        sampling=sections.sampling, starts=sections.starts, seed=sections.seed,
        initial=[np.array(kappa) for kappa in sections.anchors], only_initial=only_anchors,
        frequencies=sections.frequencies, progress=progress, workers=workers,
    )  # fmt: skip


def with_range(problem: CoDesignProblem) -> CoDesignProblem:
    """The problem with its channels and the range of K's frequencies, by the plant at its start,
    alike at every θ.

    A range that moved with θ would move ω_b*(θ) where it binds, unseen by the envelope gradient.
    """
    problem = with_channels(problem)
    sections = sections_of_problem(problem)
    if sections.frequencies is not None:
        return problem
    plant = scaled_plant(problem, problem.start)
    poles = np.abs(np.linalg.eigvals(plant.A))
    fastest = FASTEST * max(1.0, float(poles.max())) * plant.omega_0
    slowest = SLOWEST * plant.omega_0
    if sections.sampling is not None:
        fastest = min(fastest, 2.0 / sections.sampling.period)
        slowest = min(slowest, 0.01 * fastest)
    return with_sections(problem, frequencies=(slowest, fastest))


def prepared(
    problem: CoDesignProblem,
    progress: Progress | None = None,
    workers: Pool | None = None,
    only_anchors: bool = False,
) -> tuple[CoDesignProblem, SectionsDesign]:
    """The problem with anchors and members: searched at its start θ, worst plants added.

    With `only_anchors` the anchors that it has alone are where searches start. The design is the
    search's last; where it is not certified the problem has no anchors, and each θ is searched on
    its own. All of it is of the largest bandwidth, whatever the problem minimises.
    """
    asked = sections_of_problem(problem).minimise
    asked_for = with_range(with_sections(problem, minimise="bandwidth"))
    found, made = _prepared(asked_for, progress, workers, only_anchors)
    return with_sections(found, minimise=asked), made


def _prepared(
    problem: CoDesignProblem, progress: Progress | None, workers: Pool | None, only_anchors: bool
) -> tuple[CoDesignProblem, SectionsDesign]:
    uncertain = uncertain_plant(problem, problem.start)
    members = tuple((o, tuple(map(float, p))) for o, p in uncertain.corners())
    problem = with_sections(problem, members=members)
    made = race(problem, problem.start, progress, workers, only_anchors)
    if not made.certified:
        return problem, made
    anchors = _anchors(made)
    for turn in range(ROUNDS):
        found = worst_members(problem, problem.start, made, turn, progress)[1]
        if not found:
            break
        problem = with_sections(problem, members=(*sections_of_problem(problem).members, *found))
        problem = with_sections(problem, anchors=anchors)
        made = sections_value(problem, problem.start).design
        if not made.certified:
            return problem, made
        anchors = _anchors(made)
    return with_sections(problem, anchors=anchors), made


def _anchors(made: SectionsDesign) -> tuple[tuple[float, ...], ...]:
    """The certified design's κ first, then those of the other local optima near it."""
    own = tuple(map(float, made.kappa))
    others = [
        optimum.kappa
        for optimum in made.local_optima
        if (1.0 - DISTINCT) * made.bandwidth <= optimum.bandwidth < (1.0 - 1e-3) * made.bandwidth
    ]
    return (own, *others)[:MOST_ANCHORS]


def joined(problem: CoDesignProblem, kappa: Array, members: Sequence[Member]) -> CoDesignProblem:
    """The problem with one more anchor, first, of what it minimises, and more members."""
    sections = sections_of_problem(problem)
    sections = sections.with_anchor(tuple(map(float, kappa)), MOST_ANCHORS + 1)
    return replace(
        problem, controller=replace(sections, members=(*sections.members, *members))
    )
