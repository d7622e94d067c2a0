"""The best θ and controller in one search, where the plants are expensive: finite elements, say.

Around the best θ so far the plants of the set are known by a reduced basis, or by their matrices to
first order, within a reach of |Δz| (z is θ in shares of its box). On these θ, the controller and
ω_b are searched at once (`joint_model`). At the end the plants are evaluated anew, unless a basis
is so near that it gives the same, and the controller adapts to them in a few steps; J there decides
how far such models may reach. Where little is promised places further away are tried, once. Where
no more is promised the conditions of optimality hold for the true plants too, as values and slopes
are exact in the middle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ccd_casadi.codesign.joint_model import (
    JointModel,
    JointModelOptions,
    JointPoint,
    Proposal,
    propose_step,
)
from ccd_casadi.codesign.working_set import WorkingSet
from ccd_casadi.fixed_structure.worst_plant import WorstPlantOptions
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.searched_problem import state_of
from ccd_casadi.inner_problem.structured_plant_set import nearby
from ccd_casadi.plants.plant import Evaluate
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import ends_early, time_is_up

Report = Callable[[str], None] | None


@dataclass(frozen=True)
class JointSearchOptions:
    """Numbers of the joint search; lengths are shares of the box of θ, along its axes."""

    first_reach: float = 0.1  # within which models of the plants count
    largest_reach: float = 0.3
    least_reach: float = 1e-4
    good_share: float = 0.7  # of the promised gain: with more the reach grows
    poor_share: float = 0.3  # with less it shrinks
    growth: float = 2.0  # factors of the reach
    shrinkage: float = 0.3
    rounds: int = 25  # at most, each with plants evaluated anew
    excess_on_way: float = 1e-3  # ln: by how much a plant may exceed a bound before the end
    lattice_on_way: int = 50  # plants from which the worst are searched before the end
    same_place: float = 0.02  # within which an end is that of another search
    first_order_reach: float = 0.02  # at the end, of models to first order
    basis_reach: float = 0.05  # within which a basis serves: it errs by some 1e-6 of J
    basis_place: float = 2e-3  # within which a basis is that of the place
    basis_gain: float = 1e-5  # of J: with less promised the basis has to be that of the place
    poll_step: float = 0.15  # how far away places along each axis are tried
    poll_gain: float = 2e-3  # of J: with less gained or promised they are tried
    final_steps: int = 24
    final_gain: float = 1e-7  # of J: promised less, the conditions of optimality hold
    final_least_gain: float = 3e-9  # of w2 ω_b: less is rounding
    final_seed: int = 200  # searches for worse plants at an end are numbered from it
    repeated_seeds: tuple[int, ...] = (0, 101)  # searches that a run repeats at its end
    model: JointModelOptions = field(default_factory=JointModelOptions)


@dataclass(frozen=True)
class Around:
    """Models of the plants around θ: on a reduced basis, or with matrices to first order.

    Attributes
    ----------
    models : tuple of Evaluate
        θ to matrices, of the plant and each of its options.
    theta : tuple of float
        Where they are exact, SI.
    """

    models: tuple[Evaluate, ...]
    theta: tuple[float, ...]

    @staticmethod
    def of(problem: CoDesignProblem, place: JointPoint) -> "Around":
        """Make the models around a place."""
        bases = (place.theta,) if _has_basis(problem) else ()
        return Around(nearby(problem, bases, place.theta), place.theta)

    def at(self, problem: CoDesignProblem, place: JointPoint, within: float) -> "Around":
        """These, if they are on a basis `within` which the place is, else those around it."""
        near = _has_basis(problem) and _distance(problem, place.theta, self.theta) < within
        return self if near or place.theta == self.theta else Around.of(problem, place)


@dataclass(frozen=True)
class JointState:
    """The state of a joint search before a round.

    Attributes
    ----------
    working : WorkingSet
        The sampler of the problem with the plants that count.
    point : JointPoint
        The best θ, κ and ω_b.
    plants : Around
        The models on which the point is adapted.
    reach : float
        Share of the box of θ in which the next step trusts models.
    objective : float
        J of the point on the plants that count; infinite before it was evaluated.
    previous : float
        The same in the round before.
    polls : bool
        Whether places further away are still to be tried.
    """

    working: WorkingSet
    point: JointPoint
    plants: Around
    reach: float
    objective: float = np.inf
    previous: float = np.inf
    polls: bool = False

    @property
    def problem(self) -> CoDesignProblem:
        """The problem with the plants that count."""
        return self.working.sampler.problem

    def with_worse_plants(
        self,
        models: Sequence[Evaluate],
        seeds: Sequence[int],
        excess: float,
        report: Report,
        options: JointSearchOptions,
        count: int = WorstPlantOptions.lattice,
    ) -> "JointState":
        """Add the plants that searches find worse, and adapt the controller to these."""
        working, point, J = self.working.on_worse_plants(
            models, self.point, seeds, excess, report, count, options.model
        )
        return replace(self, working=working, point=point, objective=J)

    def adapt(self, options: JointSearchOptions) -> "JointState":
        """Adapt the controller to the plants."""
        model = JointModel(
            self.problem, self.plants.models, self.point, self.reach, options=options.model
        )
        point, J = model.adapt()
        return replace(self, point=point, objective=J)

    def proposal(
        self,
        kind: str,
        key: Sequence[float],
        least_gain: float | None,
        report: Report,
        options: JointSearchOptions,
    ) -> Proposal:
        """The next step and what it promises, from the store where `key` of a `kind` is there."""
        curved = _has_basis(self.problem)
        make = partial(
            propose_step, self.problem, self.plants.models, self.point, self.reach, least_gain,
            curved, options.model,
        )  # fmt: skip
        found = self.working.sampler.recall(kind, key, Proposal, make)
        if report is not None and np.isfinite(self.objective):
            digits, step = ("6", "step") if least_gain is None else ("8", "last step")
            gain = max(found.gain, 0.0)
            report(f"J {self.objective:.{digits}g}, predicted gain of a {step} {gain:.2g}")
        return found

    def take_step(
        self, proposal: Proposal, plants: Around, poor_share: float, options: JointSearchOptions
    ) -> "JointState":
        """After a step: taken where J falls, with the reach by the share of the gain that came."""
        there = replace(self, point=proposal.end, plants=plants).adapt(options)
        gained, reach = self.objective - there.objective, self.reach
        if gained > options.good_share * proposal.gain:
            reach = min(options.growth * reach, options.largest_reach)
        elif not gained >= poor_share * proposal.gain:
            reach *= options.shrinkage
        return replace(there if gained > 0.0 else self, reach=reach)


class JointEnd(NamedTuple):
    """The sampler of the problem with the plants that were added and the controller as its warm
    start, the true sample there, and whether no more is promised."""

    sampler: Sampler
    best: InnerSample
    settled: bool


def joint_search(
    sampler: Sampler,
    theta: Array,
    report: Report = None,
    ends: Sequence[tuple[Array, float]] | None = None,
    polls: bool = True,
    options: JointSearchOptions = JointSearchOptions(),
) -> JointEnd:
    """Search θ and the controller together until no more is promised on the worst plants.

    A round adds the plants on which the controller exceeds a bound, proposes a step, and takes it
    where J falls on plants that are evaluated there.

    Parameters
    ----------
    sampler : Sampler
        Of the problem as it is.
    theta : (n_θ,) array
        The start, SI.
    report : function of str
        Takes a line about each round.
    ends : sequence of (θ, J)
        Of other searches: this one ends near one that it does not improve on, and leaves the last
        digits to a polish.
    polls : bool
        Whether places further away are tried once, for plants with a reduced basis.
    options : JointSearchOptions
        Numbers of the method.

    Returns
    -------
    JointEnd
        The start itself where nothing better was found.
    """
    problem, first = sampler.problem, sampler.values(theta, "polishing")[0]
    if not np.isfinite(objective_of(problem, first)):
        return JointEnd(sampler, first, True)
    start, settled = JointPoint(first.theta, first.kappa, first.bandwidth), False
    state = JointState(
        WorkingSet(sampler), start, Around.of(problem, start), options.first_reach,
        polls=polls and _has_basis(problem),
    )  # fmt: skip
    settles = options.model.settled
    for turn in range(options.rounds):
        if ends_early("joint round"):
            break
        excess = options.excess_on_way if turn else WorstPlantOptions.within
        state = state.with_worse_plants(
            state.plants.models, (turn,), excess, report, options, options.lattice_on_way
        )
        J, reduced = state.objective, state.working.reduce(state.plants.models, state.point)
        state = replace(state, working=reduced)
        if _has_arrived(state, ends or (), options):
            return JointEnd(sampler, first, False)
        if not np.isfinite(J):
            break
        key = (*state.point.theta, state.reach, turn)
        proposal = state.proposal("together", key, None, report, options)
        if state.polls and min(proposal.gain, state.previous - J) <= options.poll_gain * abs(J):
            state = replace(state, polls=False)
            other = _after_poll(state, turn, report, options)
            if other.objective < J - settles * abs(J):
                state = other
                continue
        state = replace(state, previous=J)
        if proposal.gain > settles * abs(J) and state.reach > options.least_reach:
            plants = state.plants.at(state.problem, proposal.end, options.basis_reach)
            state = state.take_step(proposal, plants, options.poor_share, options)
            continue
        if settled := ends is not None:
            break
        last, settled = with_last_steps(
            state, options.final_seed + options.final_steps * turn, report, options
        )
        state = replace(state, working=last.working, point=last.point)
        if settled:
            break
        state = replace(state, plants=Around.of(problem, state.point))
    if not (settled or ends is not None or time_is_up()):
        state, _ = with_last_steps(state, options.final_seed, report, options)
    counted = state_of(state.problem).scenarios
    worse = set(counted) - set(state_of(problem).scenarios)
    if state.point.theta == first.theta and not worse:
        return JointEnd(sampler, first, settled)
    true = state.working.sampler.value_from(state.point.theta, state.point.kappa)
    if worse or objective_of(problem, true) < objective_of(problem, first):
        return JointEnd(state.working.sampler, true, settled)
    return JointEnd(sampler, first, True)


def _after_poll(
    state: JointState, turn: int, report: Report, options: JointSearchOptions
) -> JointState:
    """Move to the best of the places further away, on its own plants."""
    problem = state.problem
    place = poll(problem, state.plants.models, state.point, options)
    plants = Around.of(problem, place)
    other = replace(state, point=place, plants=plants, reach=options.first_reach)
    other = other.with_worse_plants(plants.models, (turn,), options.excess_on_way, report, options)
    if report is not None and np.isfinite(other.objective):
        away = f"{options.poll_step:g} of the box away along one axis"
        report(f"J {other.objective:.6g} at the best place {away}")
    return other


def poll(
    problem: CoDesignProblem,
    models: Sequence[Evaluate],
    best: JointPoint,
    options: JointSearchOptions = JointSearchOptions(),
) -> JointPoint:
    """The best of the places to both sides along every θ, with the controller adapted to each.

    A search by slopes ends where peaks change places, though J falls beyond (a poll of compass
    searches: Kolda, Lewis and Torczon 2003)."""
    steps = options.poll_step * np.diag(np.subtract(problem.upper, problem.lower))
    places = np.clip(best.theta + np.vstack([steps, -steps]), *box(problem))
    far = [
        tuple(z.tolist())
        for z in places
        if _distance(problem, z, best.theta) > 0.5 * options.poll_step
    ]
    ends = [
        JointModel(problem, models, replace(best, theta=z), 0.0, options=options.model).adapt()
        for z in far
    ]
    return min(ends, key=lambda end: end[1], default=(best, np.inf))[0]


def _has_basis(problem: CoDesignProblem) -> bool:
    """Whether a reduced basis of the plant is known, which is good further away."""
    return plant_of(problem).nearby is not None


def _has_arrived(
    state: JointState, ends: Sequence[tuple[Array, float]], options: JointSearchOptions
) -> bool:
    """Whether a place is that of a known end, and not better."""
    return any(
        _distance(state.problem, state.point.theta, theta) < options.same_place
        and J - options.model.settled * abs(J) < state.objective
        for theta, J in ends
    )


def _distance(
    problem: CoDesignProblem, one: Sequence[float] | Array, other: Sequence[float] | Array
) -> float:
    """The largest distance of two θ along an axis, in shares of the box."""
    width = np.subtract(problem.upper, problem.lower)
    return float(np.abs(np.subtract(one, other) / width).max())


def with_last_steps(
    before: JointState, seed: int, report: Report, options: JointSearchOptions
) -> tuple[JointState, bool]:
    """The joint optimum near by on all plants that searches find worse on the way to it, and
    whether no more is promised there.

    On models around one place after the other, so near that all rows meet which bind at a kink of
    ω_b*, as `theta_kkt` requires: on reduced bases where a plant has them, which go further; else
    to first order, exact there. Searches for worse plants are numbered from `seed`; at the end they
    are of the plants themselves."""
    curved = _has_basis(before.problem)
    seeds = (seed, *options.repeated_seeds) if curved else (seed,)
    reach = options.first_reach if curved else options.first_order_reach
    state = replace(before, working=before.working.whole, reach=reach)
    plants = state.plants.at(state.problem, state.point, options.basis_reach)
    state = replace(state, plants=plants).adapt(options)
    for step in range(1, options.final_steps):
        if ends_early("last joint step"):
            break
        key = (*state.point.theta, state.point.bandwidth, state.reach, curved)
        proposal = state.proposal("finished", key, options.final_least_gain, report, options)
        J, coarse = state.objective, proposal.gain > options.basis_gain * abs(state.objective)
        if not coarse:
            exact = state.plants.at(state.problem, state.point, options.basis_place)
            if exact is not state.plants:
                state = replace(state, plants=exact).adapt(options)
                continue
        if proposal.gain <= options.final_gain * abs(J):
            true = nearby(state.problem, (), state.point.theta)
            ended = state.with_worse_plants(true, seeds, WorstPlantOptions.within, report, options)
            if ended.working is state.working or ended.objective - J <= options.final_gain * abs(J):
                return ended, True
            state = ended
            continue
        within = options.basis_reach if coarse else options.basis_place
        plants = state.plants.at(state.problem, proposal.end, within)
        moved = state.take_step(proposal, plants, options.good_share, options)
        taken = moved.point is not state.point
        state = moved
        if taken:
            state = state.with_worse_plants(
                state.plants.models, (seed + step,), WorstPlantOptions.within, report, options
            )
    return state, False


def objectives_beside(
    problem: CoDesignProblem,
    sample: InnerSample,
    thetas: Array,
    options: JointSearchOptions = JointSearchOptions(),
) -> Array:
    """Compute by how much J is larger at θ (n, n_θ) beside a sample, by searches of its controller
    on models of the plants around it; where J falls, of the best controller there too."""
    here = JointPoint(sample.theta, sample.kappa, sample.bandwidth)
    model, models = options.model, Around.of(problem, here).models
    places = [here.theta, *(tuple(theta.tolist()) for theta in thetas)]

    def climbed(start: JointPoint) -> list[tuple[JointPoint, float]]:
        starts = (replace(start, theta=place) for place in places)
        return [
            JointModel(problem, models, one, 0.0, options=model).adapt(model.steps)
            for one in starts
        ]

    own = climbed(here)
    best = min(own, key=lambda end: end[1])
    other = own if best is own[0] else climbed(best[0])
    J = np.array([min(a[1], b[1]) for a, b in zip(own, other, strict=True)])
    return J[1:] - J[0]
