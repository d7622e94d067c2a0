"""ω_b*(θ) of a fixed structure, with its envelope gradient, and the move of a design."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import call

import numpy as np

from ccd_casadi.analysis.driven_plant import DrivenMechanics, MotionAt
from ccd_casadi.analysis.move import Move, simulate
from ccd_casadi.analysis.move_time import MoveTime
from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import SectionsDesign, SectionsOutcome, bandwidth_envelope
from ccd_casadi.fixed_structure.least_value import (
    Ended,
    Goal,
    LeastValue,
    RmsError,
    first_descents,
    least_value,
)
from ccd_casadi.fixed_structure.local_search import Envelope, OptimalityOptions
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.worst_plant import lattice
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, RMS_ERROR
from ccd_casadi.inner_problem.objective import InnerValue
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    plants_of,
    structure_of,
    uncertain_plant,
    warm_starts_at,
)
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.process_pool import LentWorkers, Pool, results
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ
from ccd_casadi.support.time_budget import time_is_up


@dataclass(frozen=True)
class MoveCheckOptions:
    """Numbers of the check of a move's time on the box of plants."""

    lattice: int = 100  # plants
    fresh: int = 500  # plants drawn for the yield
    fresh_seed: int = 3000  # added to the problem's, so that no other draw is repeated
    batch: int = 16  # plants that one worker simulates at a time
    steps: float = 10.0  # per duration of the setpoint: a continuous loop has 50 points in each
    longest: float = 100.0  # durations of the setpoint: a longer dwell is not followed to its end


def motion_of(problem: CoDesignProblem, theta: Sequence[float]) -> MotionAt:
    """Find the move of a problem that has one.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float

    Returns
    -------
    MotionAt
        The setpoint and the forces at θ.
    """
    own = plant_of(problem).evaluate
    assert isinstance(own, DrivenMechanics)
    return own.at(tuple(map(float, theta)), problem.sampling)


def require_motion(problem: CoDesignProblem) -> None:
    """Check that the plant makes its move.

    Parameters
    ----------
    problem : CoDesignProblem

    Raises
    ------
    UserError
        The plant has unlike numbers of inputs and outputs, or the move cannot be made.
    """
    plant = plant_of(problem)
    motion = problem.source.motion
    if plant.inputs != plant.outputs and not (motion and motion.output):
        words = f"has {plant.inputs} inputs and {plant.outputs} outputs; [move] needs as many"
        raise PlantError(f"{words} of one as of the other")
    try:
        motion_of(problem, problem.start)
    except np.linalg.LinAlgError:  # of the loads: a mass that varies
        mechanics(plant, problem.start)  # which says it of the model
        words = "mass is not positive definite at an end of what varies"
        raise PlantError(f"{words}; give every coordinate a mass, or narrow its range") from None


def exact_moves(motion: MotionAt, loops: Sequence[Loop], until: float = 0.0) -> list[Move]:
    """Simulate the move in loops.

    Parameters
    ----------
    motion : MotionAt
    loops : sequence of Loop
        Closed, SI.
    until : float
        s: followed so long at least, but for `MoveCheckOptions.longest`.

    Returns
    -------
    list of Move
        Of each loop.
    """
    profile, options = motion.cycle.profile, MoveCheckOptions()
    return [
        simulate(
            loop, profile, axis=0,
            forces=motion.forward, window=motion.motion.window,
            bandwidth_hz=options.steps / profile.duration,
            until=min(until, options.longest * profile.duration),
        )
        for loop in loops
    ]  # fmt: skip


def exact_times(
    problem: CoDesignProblem, motion: MotionAt, plants: Sequence[ScaledPlant], K: StateSpace
) -> Array:
    """Simulate the move on plants with K(s): the time in s from its start until the error stays
    within the window, its end at least.
    """
    made = exact_moves(motion, [Loop(plant.plant_si(), K, problem.sampling) for plant in plants])
    return np.maximum([move.settled for move in made], motion.cycle.profile.duration)


def latest_plant(
    problem: CoDesignProblem, theta: Sequence[float], K: StateSpace, seed: int,
    workers: Pool | None = None, options: MoveCheckOptions = MoveCheckOptions(),
) -> tuple[float, int, Array]:  # fmt: skip
    """The exact time on the latest plant of a lattice of the box, its option and its point."""
    points, size = lattice(uncertain_plant(problem, theta), options.lattice, seed), options.batch
    parts = {i: (problem, theta, K, points[i : i + size]) for i in range(0, len(points), size)}
    found = dict(results(workers, _times_at, parts))
    times = np.concatenate([found[i] for i in parts])
    return float(times.max()), *points[int(times.argmax())]


def _times_at(
    problem: CoDesignProblem, theta: Sequence[float], K: StateSpace,
    points: Sequence[tuple[int, Array]],
) -> Array:  # fmt: skip
    plants = uncertain_plant(problem, theta).plants(points)
    return exact_times(problem, motion_of(problem, theta), plants, K)


def stated_time(
    problem: CoDesignProblem, theta: Sequence[float], K: StateSpace, value: float,
    options: MoveCheckOptions = MoveCheckOptions(),
) -> tuple[float, Yield | None]:  # fmt: skip
    """Find the time of the move that a run states, and its yield.

    Parameters
    ----------
    problem, theta, K : CoDesignProblem, sequence of float, StateSpace
    value : float
        The smooth time on the set, s.
    options : MoveCheckOptions

    Returns
    -------
    time : float
        s: the latest of the smooth time, the set, and a lattice of the box.
    fresh : Yield or None
        How many plants drawn from the box need no longer; None without a box.
    """
    seed, count = state_of(problem).seed, options.fresh
    uncertain, motion = uncertain_plant(problem, theta), motion_of(problem, theta)
    on_set = exact_times(problem, motion, plants_of(problem, theta), K)
    latest = latest_plant(problem, theta, K, seed + options.fresh_seed)[0]
    stated = max(value, float(on_set.max()), latest)
    if not uncertain.names:
        return stated, None
    fresh = uncertain.drawn(np.random.default_rng((seed, options.fresh_seed)), count)
    times = exact_times(problem, motion, uncertain.plants(fresh), K)
    return stated, Yield(int((times <= stated).sum()), count)


@dataclass(frozen=True)
class StructuredValueOptions:
    """Numbers of the searches at one θ."""

    searches: int = 5  # at most, of which the last continue an end that is not optimal yet
    rounding: float = 1e-6  # relative: of the bandwidth
    starts: int = 8  # of the search at a θ where no warm start ends certified


@dataclass(frozen=True)
class StructuredValue(InnerValue):
    """The value of a fixed structure at a θ, with its design.

    Attributes
    ----------
    design : SectionsDesign
    syntheses : int
        Climbs and multi-start searches that it took.
    envelope : Envelope or None
        All gradients at a kink of the value, where `gradient` is that of one side.
    """

    design: SectionsDesign
    syntheses: int
    envelope: Envelope | None = None


@dataclass(frozen=True)
class ProblemAt:
    """A problem of fixed structure at a θ: the plants there, and the searches on them.

    Attributes
    ----------
    problem, theta : CoDesignProblem, sequence of float (n,)
    """

    problem: CoDesignProblem
    theta: Sequence[float]

    @cached_property
    def plants(self) -> list[ScaledPlant]:
        return plants_of(self.problem, self.theta)

    def search(
        self,
        initial: Sequence[Array],
        starts: int | None = None,
        most_starts: int = 0,
        log: Log = silent,
        workers: Pool | None = None,
    ) -> SectionsDesign:
        """The largest bandwidth, from controllers κ in SI and `starts` others beside them, or up to
        `most_starts` until its best was found twice."""
        problem, structured = self.problem, structured_of(self.problem)
        return synthesise_sections(
            self.plants, structure_of(problem), bounds_of(problem), sampling=structured.sampling,
            starts=starts or 0, most_starts=most_starts, seed=state_of(self.problem).seed,
            initial=initial, only_initial=starts is None,
            frequencies=structured.frequencies, progress=log, workers=workers,
        )  # fmt: skip

    @property
    def goal(self) -> Goal:
        """The figure that is made small besides -ω_b."""
        problem, sampling = self.problem, self.problem.sampling
        structure = structure_of(problem)
        assert isinstance(structure, Structure)
        if problem.figure is RMS_ERROR:
            assert problem.budget is not None
            return RmsError(tuple(self.plants), structure, problem.budget, sampling)
        assert sampling is not None
        return MoveTime(tuple(self.plants), structure, sampling, motion_of(problem, self.theta))

    @cached_property
    def error_starts(self) -> list[Array]:
        """The warm starts, κ in SI, of what is made small besides -ω_b."""
        problem, bounds = self.problem, bounds_of(self.problem)
        started = with_state(problem, warm_starts=state_of(problem).error_warm_starts)
        return warm_starts_at(started, structure_of(problem), self.plants, bounds)

    def searched_beside(
        self, initial: Sequence[Array], workers: Pool
    ) -> tuple[SectionsDesign, dict[int, Ended] | None]:
        """As `searched`, while other workers make the first descents of `least`."""
        problem, structured, structure = (
            self.problem, structured_of(self.problem), structure_of(self.problem)
        )  # fmt: skip
        if problem.figure is BANDWIDTH or not self.error_starts:
            return self.search(initial, workers=workers), None
        assert isinstance(structure, Structure)
        ends = first_descents(
            self.plants, structure, bounds_of(problem), self.goal, self.error_starts,
            sampling=structured.sampling, frequencies=structured.frequencies,
            least_bandwidth=structured.bandwidth_least,
        )  # fmt: skip
        # the search is the shortest: the last, it fills what the descents leave
        search = partial(self.search, initial, workers=LentWorkers())
        tasks = {**{i: (end,) for i, end in ends.items()}, -1: (search,)}
        found = dict(results(workers, call, tasks))
        return found.pop(-1), {i: found[i] for i in ends}

    def least(
        self,
        design: SectionsDesign,
        only_initial: bool = False,
        log: Log = silent,
        workers: Pool | None = None,
        ended: Mapping[int, Ended] | None = None,
    ) -> LeastValue:
        """The least of the problem's figure from a certified design and its warm starts."""
        problem, structured = self.problem, structured_of(self.problem)
        return least_value(
            self.plants, bounds_of(problem), design, self.goal, sampling=structured.sampling,
            least_bandwidth=structured.bandwidth_least, initial=self.error_starts,
            only_initial=only_initial, log=log, workers=workers, ended=ended,
        )  # fmt: skip

    def value_of(
        self,
        design: SectionsDesign,
        spent: int,
        only_initial: bool = False,
        workers: Pool | None = None,
        ended: Mapping[int, Ended] | None = None,
    ) -> StructuredValue:
        """A design of largest bandwidth as a value of ω_b*(θ), or as a start to the least of
        another figure beside the warm starts; with `only_initial` where these lead to no certified
        design."""
        problem, point = self.problem, tuple(float(v) for v in self.theta)
        error, envelope = np.nan, None
        if problem.figure is not BANDWIDTH:
            design = too_slow(problem, design)
        if design.certified and problem.figure is not BANDWIDTH:
            found = self.least(design, only_initial, workers=workers, ended=ended)
            design, error, envelope = found.design, found.value, found.envelope
        elif design.certified:
            bounds = bounds_of(problem)
            envelope = bandwidth_envelope(self.plants, bounds, design, problem.sampling)
        bandwidth = float(design.bandwidth) if design.certified else np.nan
        gradient = np.full(len(point), np.nan) if envelope is None else envelope.gradient
        slope = tuple(map(float, gradient))
        return StructuredValue(point, bandwidth, slope, design, spent, envelope, error=error)


def structured_value(
    problem: CoDesignProblem, theta: Sequence[float], workers: Pool | None = None,
    options: StructuredValueOptions = StructuredValueOptions(),
) -> StructuredValue:  # fmt: skip
    """Find v(θ): the best certified design from the problem's warm starts, and its gradient.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float
        θ in SI.
    workers : Pool, optional
        The searches are spread over them.
    options : StructuredValueOptions

    Returns
    -------
    StructuredValue
    """
    here, starts = ProblemAt(problem, theta), structured_of(problem).starts
    initial = warm_starts_at(problem, structure_of(problem), here.plants, bounds_of(problem))
    made: SectionsDesign | None = None
    ended: dict[int, Ended] | None = None
    spent = 0
    if initial and workers is not None:
        made, ended = here.searched_beside(initial, workers)
        spent += 1
    elif initial:
        made = here.search(initial)
        spent += 1
    lost = problem.figure is not BANDWIDTH and not (made and made.certified)
    if lost and here.error_starts:
        # Controllers of least error meet every bound where those of most bandwidth may not.
        made = here.search(here.error_starts, workers=workers)
        spent += 1
    if made is None or (starts and not made.certified):
        made = here.search(initial, min(options.starts, starts), workers=workers)
        spent += 1
    limit = OptimalityOptions.residual
    while made.certified and made.kkt_residual > limit and spent < options.searches:
        if time_is_up():
            break
        again = here.search([made.kappa], workers=workers)
        spent += 1
        kept = (1.0 - options.rounding) * made.bandwidth
        if not again.certified or again.bandwidth < kept:
            break
        made = again
    return here.value_of(made, spent, only_initial=True, workers=workers, ended=ended)


def require_bandwidth(problem: CoDesignProblem, command: str) -> None:
    """Check that J counts ω_b, for a command that knows ω_b alone.

    Parameters
    ----------
    problem, command : CoDesignProblem, str

    Raises
    ------
    UserError
        J counts another figure.
    """
    if problem.figure is not BANDWIDTH:
        words = f"{command} counts the bandwidth; solve, inner and retrain count the others"
        raise UserError(f'inner.minimise: is "{problem.figure.key}", and {words}')


def too_slow(problem: CoDesignProblem, design: SectionsDesign) -> SectionsDesign:
    """The design, not certified where what is minimised requires more bandwidth."""
    least = structured_of(problem).bandwidth_least
    if not design.certified or design.bandwidth >= least:
        return design
    words = f"no controller was found above {design.bandwidth / HZ:.4g} Hz"
    words += f", inner.bandwidth_least_hz requires {least / HZ:.4g} Hz"
    short = {"bandwidth_least_hz": least / design.bandwidth}
    return replace(design, outcome=SectionsOutcome.BOUND_NOT_MET, words=words, short=short)
