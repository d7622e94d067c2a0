"""The best θ and controller in one search, where it is the plants that cost: finite elements, say.

The plants of the set around the best θ so far are known by a reduced basis, or by their matrices to
first order, within a reach of |Δz| (z is θ in shares of its box). On these θ, the controller and
ω_b are searched at once (`joint_model`). At the end the plants are made anew, unless a basis stands
so near that it tells the same, and the controller adapts to them in a few steps; J there tells how
far such knowledge may reach. Where little is promised places further away are tried, once. Where no
more is promised the conditions of optimality hold for the true plants too, as values and slopes are
exact in the middle.
"""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ccd_casadi.codesign.joint_model import (
    SETTLED,
    STEPS,
    JointModel,
    JointPoint,
    Proposal,
    WorkingSet,
    proposed,
)
from ccd_casadi.fixed_structure.worst_plant import WorstPlantOptions
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.structured_plant_set import nearby, structured_of
from ccd_casadi.plants.plant import Evaluate
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import InnerSample
from ccd_casadi.support.arrays import Array

REACH, LARGEST, LEAST = 0.1, 0.3, 1e-4  # of the box of θ, in which the models count
GOOD, POOR = 0.7, 0.3  # of the promised gain: the reach grows, or shrinks
TURNS = 25  # times at most that the plants are made anew
APART = 200  # looks for worse plants at an end are numbered from it, each elsewhere in the box
AGAIN = (0, 101)  # looks that a run has at its end, where a return costs finite elements
UNDERWAY = 1e-3  # ln: by how much a plant of the box may exceed a bound on the way
ON_THE_WAY = 50  # plants from which the worst are looked for there; at an end from all of a lattice
CLOSE = 0.02  # of the box: places that are the same; the reach of plants to first order at an end
STILL, NEARBY = 2e-3, 0.05  # of the box: a basis is that of the place; errs by some 1e-6 of J
COARSE = 1e-5  # of J: with less promised a basis is that of the place itself
ENDINGS, KEPT = 24, 1e-7  # last steps; of J: a promise at which the conditions of optimality hold
LAST_GAIN = 3e-9  # of w2 ω_b: less is rounding
POLL = 0.15  # of the box: how far away places are tried
LITTLE = 2e-3  # of J: with less gained or promised they are


@dataclass(frozen=True)
class Around:
    """The plants as a reduced basis at θ knows them, or their matrices to first order there."""

    models: tuple[Evaluate, ...]
    theta: tuple[float, ...]

    @staticmethod
    def of(problem: CoDesignProblem, place: JointPoint) -> "Around":
        """Those around a place."""
        bent = plant_of(problem).nearby is not None
        return Around(nearby(problem, [place.theta] if bent else (), place.theta), place.theta)

    def at(self, problem: CoDesignProblem, place: JointPoint, within: float) -> "Around":
        """These, if a basis is so near the place, else those around it."""
        bent = plant_of(problem).nearby is not None
        near = bent and _apart(problem, place.theta, self.theta) < within
        return self if near or place.theta == self.theta else Around.of(problem, place)


def joint_search(
    sampler: Sampler,
    theta: Array,
    tell: Callable[[str], None] | None = None,
    ends: Sequence[tuple[Array, float]] | None = None,
    polls: bool = True,
) -> tuple[Sampler, InnerSample, bool]:
    """From θ towards where the joint search promises no more on the worst plants: the sampler of
    the problem that has these and the controller there as its warm start, its true sample, and
    whether no more is promised.

    With `ends` of other searches (θ, J) it ends near one that it does not improve on, and leaves
    the last digits to a polish. Places further away are tried once, if it `polls`."""
    problem, first = sampler.problem, sampler.values(theta, "polishing")[0]
    if not np.isfinite(objective_of(problem, first)):
        return sampler, first, True
    best = JointPoint(first.theta, first.kappa, first.bandwidth)
    plants = Around.of(problem, best)
    reach, settled, working = REACH, False, WorkingSet(sampler)
    bent = plant_of(problem).nearby is not None
    polls, before = polls and bent, np.inf
    for turn in range(TURNS):
        within = UNDERWAY if turn else WorstPlantOptions.within
        working, best, J = working.on_worse_plants(
            plants.models, best, (turn,), within, tell, ON_THE_WAY
        )
        working = working.reduced(plants.models, best)
        problem = working.sampler.problem
        if _arrived(problem, best, J, ends or ()):
            return sampler, first, False
        if not np.isfinite(J):
            break
        make = partial(proposed, problem, plants.models, best, reach, bent=bent)
        found = working.sampler.cached("together", (*best.theta, reach, turn), Proposal, make)
        if tell is not None:
            tell(f"J {J:.6g}, predicted gain of a step {max(found.gain, 0.0):.2g}")
        del make
        gc.collect()  # searches are large, and hold themselves in circles
        if polls and min(found.gain, before - J) <= LITTLE * abs(J):
            polls = False
            other = polled(problem, plants.models, best)
            there = Around.of(problem, other)
            wider, other, worth = working.on_worse_plants(
                there.models, other, (turn,), UNDERWAY, tell
            )
            if tell is not None:
                tell(f"J {worth:.6g} at the best place {POLL:g} of the box away along one axis")
            if worth < J - SETTLED * abs(J):
                working, best, plants, reach = wider, other, there, REACH
                continue
        before = J
        if found.gain <= SETTLED * abs(J) or reach <= LEAST:
            settled = ends is not None
            if settled:
                break
            look = APART + ENDINGS * turn
            working, best, settled = finished(working.whole, best, plants, look, tell)
            if settled:
                break
            plants = Around.of(problem, best)
            continue
        there = plants.at(problem, found.end, NEARBY)
        end, worth = JointModel(problem, there.models, found.end, reach).adapted()
        gained = J - worth
        if gained > 0.0:
            best, plants = end, there
        if gained > GOOD * found.gain:
            reach = min(2.0 * reach, LARGEST)
        elif gained < POOR * found.gain:
            reach *= 0.3
    if not (settled or ends is not None):
        working, best, _ = finished(working.whole, best, plants, APART, tell)
    counted = structured_of(working.sampler.problem).scenarios
    worse = set(counted) - set(structured_of(sampler.problem).scenarios)
    if best.theta == first.theta and not worse:
        return sampler, first, settled
    last = working.sampler.value_from(best.theta, best.kappa)
    if worse or objective_of(problem, last) < objective_of(problem, first):
        return working.sampler, last, settled
    return sampler, first, True


def polled(problem: CoDesignProblem, models: Sequence[Evaluate], best: JointPoint) -> JointPoint:
    """The best of the places to both sides along every θ, with the controller adapted to each.

    A search by slopes stands still where peaks change places, though J falls beyond (a poll of
    compass searches: Kolda, Lewis and Torczon 2003)."""
    width = np.subtract(problem.upper, problem.lower)
    places = np.clip(
        best.theta + POLL * np.vstack([np.diag(width), -np.diag(width)]), *box(problem)
    )
    far = [tuple(z.tolist()) for z in places if _apart(problem, z, best.theta) > 0.5 * POLL]
    ends = [JointModel(problem, models, replace(best, theta=z), 0.0).adapted() for z in far]
    return min(ends, key=lambda end: end[1], default=(best, np.inf))[0]


def _arrived(
    problem: CoDesignProblem, best: JointPoint, J: float, ends: Sequence[tuple[Array, float]]
) -> bool:
    """Whether a place is that of a known end, and not better."""
    return any(
        _apart(problem, best.theta, theta) < CLOSE and end - SETTLED * abs(end) < J
        for theta, end in ends
    )


def _apart(problem: CoDesignProblem, one: Sequence[float], other: Sequence[float] | Array) -> float:
    """The largest distance of two θ along an axis, in shares of the box."""
    width = np.subtract(problem.upper, problem.lower)
    return float(np.abs(np.subtract(one, other) / width).max())


def finished(
    working: WorkingSet,
    start: JointPoint,
    plants: Around,
    look: int,
    tell: Callable[[str], None] | None,
) -> tuple[WorkingSet, JointPoint, bool]:
    """The joint optimum near by on all plants that searches find worse on the way to it, the set
    that has these, and whether no more is promised there.

    From what is known at one place after the other: so near that all rows meet which bind at a kink
    of ω_b*, as `theta_kkt` has to see it. On reduced bases around these places where a plant has
    them, which go further; else to first order, exact there. Searches for worse plants are numbered
    from `look`; at the end they are of the plants themselves."""
    bent = plant_of(working.sampler.problem).nearby is not None
    reach, again = (REACH, AGAIN) if bent else (CLOSE, ())
    plants = plants.at(working.sampler.problem, start, NEARBY)
    best, J = JointModel(working.sampler.problem, plants.models, start, reach).adapted()
    for step in range(1, ENDINGS):
        problem = working.sampler.problem
        make = partial(proposed, problem, plants.models, best, reach, LAST_GAIN, bent)
        key = (*best.theta, best.bandwidth, reach, bent)
        found = working.sampler.cached("finished", key, Proposal, make)
        if tell is not None:
            tell(f"J {J:.8g}, predicted gain of a last step {max(found.gain, 0.0):.2g}")
        del make
        gc.collect()  # searches are large, and hold themselves in circles
        if found.gain <= COARSE * abs(J):
            exact = plants.at(problem, best, STILL)
            if exact is not plants:
                plants = exact
                best, J = JointModel(problem, plants.models, best, reach).adapted()
                continue
        if found.gain <= KEPT * abs(J):
            before, true = working, nearby(problem, (), best.theta)
            working, best, there = working.on_worse_plants(
                true, best, (look, *again), WorstPlantOptions.within, tell
            )
            if working is before or there - J <= KEPT * abs(J):
                return working, best, True
            J = there
            continue
        beside = plants.at(problem, found.end, NEARBY if found.gain > COARSE * abs(J) else STILL)
        end, there = JointModel(problem, beside.models, found.end, reach).adapted()
        reach = min(2.0 * reach, LARGEST) if J - there > GOOD * found.gain else 0.3 * reach
        if there < J:
            plants, looks = beside, (look + step,)
            working, best, J = working.on_worse_plants(
                plants.models, end, looks, WorstPlantOptions.within, tell
            )
    return working, best, False


def objectives_beside(problem: CoDesignProblem, sample: InnerSample, thetas: Array) -> Array:
    """By how much J is larger at θ (n, n_θ) beside a sample, by climbs of its controller on the
    plants as a basis knows them, or to first order; where J falls, of the best one's there too."""
    here = JointPoint(sample.theta, sample.kappa, sample.bandwidth)
    models = nearby(problem, [here.theta] if plant_of(problem).nearby else (), here.theta)
    places = [here.theta, *(tuple(theta.tolist()) for theta in thetas)]

    def climbed(start: JointPoint) -> list[tuple[JointPoint, float]]:
        starts = (replace(start, theta=place) for place in places)
        return [JointModel(problem, models, one, 0.0).adapted(STEPS) for one in starts]

    own = climbed(here)
    best = min(own, key=lambda end: end[1])
    other = own if best is own[0] else climbed(best[0])
    J = np.array([min(a[1], b[1]) for a, b in zip(own, other, strict=True)])
    return J[1:] - J[0]
