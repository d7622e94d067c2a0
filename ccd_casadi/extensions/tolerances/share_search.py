"""Search of a machine and controller whose bounds hold for a share of all machines.

    max over (θ, κ) of -J  s.t.  every bound holds on all but K of N drawn machines,  K = floor(q N)

by constraint removal with re-ranking (Campi and Garatti 2011): on a working set of draws the
design is that of the core, with its exact slopes; all draws are then ranked by their largest figure
over its bound; the K worst are given up, and those after them that exceed a bound join the set.
Every round draws anew, until two rounds one after the other that no design has seen show no more
than K in all: one alone is passed by luck too often. q is smaller than the share that may fail, so
that the certificate confirms it reliably (`machines.Plan`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ccd_casadi.codesign.outer import pieces_from
from ccd_casadi.codesign.stored_searches import multistart_at, value_with_design
from ccd_casadi.extensions.tolerances.machines import Machine, Plan, drawn
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.worst_plant import LoopOnBox, WorstPlantOptions
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import (
    Scenario,
    Uncertainty,
    structured_of,
    with_structured,
)
from ccd_casadi.inner_problem.structured_search import prepared, with_warm_start
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import NoDesign
from ccd_casadi.support.terminal import Tell
from ccd_casadi.support.text import counted
from ccd_casadi.support.time_budget import ends_early


@dataclass(frozen=True)
class ShareOptions:
    """Numbers of the search for a share.

    Attributes
    ----------
    rounds : int
        Of new draws at one θ, at most.
    confirming : int
        Of these, one after the other without a new design, that end it.
    designs : int
        Between two rounds, at most.
    tail : int
        Draws of a round that are ranked again: those nearest to a bound.
    added : int
        Draws that join the working set at once.
    moves : int
        Local solves over θ, each on the working set of the θ before.
    settled : float
        Of J: a move that gains less ends them.
    seed : int
        Beside the run's: no other draw is repeated.
    """

    rounds: int = 12
    confirming: int = 2
    designs: int = 12
    tail: int = 400
    added: int = 4
    moves: int = 3
    settled: float = 1e-4
    seed: int = 4000


@dataclass(frozen=True)
class ShareSearch:
    """A search as far as it is.

    Attributes
    ----------
    sampler : Sampler
        Of the problem whose scenarios are the working set.
    best : InnerSample
        θ and κ on that set.
    plan, distribution, seed : Plan, mapping, int
        What is required, how tolerances are drawn, and the run's seed.
    tail : tuple of Machine
        Draws that are ranked again.
    seen : int
        How many were drawn.
    rounds : int
        Of new draws.
    settled : bool
        Whether the last rounds showed no more failing machines than are given up.
    """

    sampler: Sampler
    best: InnerSample
    plan: Plan
    distribution: Mapping[str, str]
    seed: int
    tail: tuple[Machine, ...] = ()
    seen: int = 0
    rounds: int = 0
    settled: bool = False

    @property
    def problem(self) -> CoDesignProblem:
        """With the working set."""
        return self.sampler.problem

    @property
    def design(self) -> SectionsDesign:
        """With its controller and certificate on the working set."""
        return value_with_design(self.sampler, self.best).design

    @property
    def may_fail(self) -> int:
        """K: how many of the draws seen are given up."""
        return int(self.plan.given_up * self.seen)

    def excesses(self, machines: "list[Machine] | tuple[Machine, ...]") -> Array:
        """ln of the largest figure over its bound (N,); infinite where it is not known."""
        problem = self.problem
        loop = LoopOnBox(
            uncertain_plant(problem, self.best.theta), structure_of(problem),
            np.array(self.best.kappa), self.best.bandwidth, bounds_of(problem), problem.sampling,
        )  # fmt: skip
        found = loop.excesses(machines, self.sampler.workers)
        return np.where(np.isnan(found), np.inf, found)

    def with_draws(self, options: ShareOptions) -> tuple["ShareSearch", int]:
        """After a round of new draws; how many machines fail in all."""
        rng = np.random.default_rng((self.seed, options.seed, self.rounds))
        uncertain = uncertain_plant(self.problem, self.best.theta)
        new = drawn(uncertain, self.distribution, rng, self.plan.draws)
        value = self.excesses(new)
        nearest = [new[i] for i in np.argsort(-value, kind="stable")[: options.tail]]
        failing = int((value > WorstPlantOptions.within).sum())
        if self.tail:
            failing += int((self.excesses(self.tail) > WorstPlantOptions.within).sum())
        wider = replace(self, tail=(*self.tail, *nearest), seen=self.seen + len(new),
                        rounds=self.rounds + 1)  # fmt: skip
        return wider, failing

    def redesigned(self, tell: Tell, options: ShareOptions) -> "ShareSearch":
        """With the machines that exceed a bound and are not given up, until there are none."""
        search = self
        for _ in range(options.designs):
            value = search.excesses(search.tail)
            order = np.argsort(-value, kind="stable")[search.may_fail :]
            known = structured_of(search.problem).scenarios
            over = [scenario_of(search.tail[i]) for i in order
                    if value[i] > WorstPlantOptions.within]  # fmt: skip
            added = [one for one in over if one not in known][: options.added]
            if not added or ends_early("design on drawn machines"):
                break
            search = search.on((*known, *added))
            shown = search.problem.figure.shown(search.best.value)
            tell(
                f"{shown} on {counted(len(known) + len(added), 'machine')}, after {len(over)} more"
            )
        return search

    def on(self, scenarios: tuple[Scenario, ...]) -> "ShareSearch":
        """The best from its own controller on another working set, at the same θ.

        Raises
        ------
        NoDesign
            None meets the bounds there.
        """
        problem = with_warm_start(self.problem, self.best.kappa)
        sampler = self.sampler.of(with_structured(problem, scenarios=scenarios))
        best = sampler.value_from(self.best.theta, self.best.kappa)
        if not best.feasible:
            raise NoDesign(f"no controller was found for this share: {best.shortfall}")
        return replace(self, sampler=sampler, best=best)

    def at_its_theta(
        self, tell: Tell, options: ShareOptions, beaten: float = np.inf
    ) -> "ShareSearch":
        """Rounds of draws and designs at one θ, until rounds show no more failing machines than
        are given up, or J is above that of a design which is `beaten`: it only rises."""
        search, confirmed = replace(self, settled=False), 0
        for _ in range(options.rounds):
            search, failing = search.with_draws(options)
            tell(f"{failing} of {search.seen} drawn machines fail, {search.may_fail} may")
            confirmed = confirmed + 1 if failing <= search.may_fail else 0
            if confirmed == options.confirming:
                return replace(search, settled=True)
            if confirmed:
                continue
            if ends_early("round of drawn machines"):
                break
            search = search.redesigned(tell, options)
            if objective_of(search.problem, search.best) > beaten:
                break
        return search


def scenario_of(machine: Machine) -> Scenario:
    """A drawn machine as a plant of a problem's set."""
    option, point = machine
    return option, tuple(map(float, point))


def begun(
    sampler: Sampler, theta: tuple[float, ...], kappa: Array | None, plan: Plan,
    distribution: Mapping[str, str], seed: int, tell: Tell,
) -> ShareSearch:  # fmt: skip
    """Begin with the model of every option alone, from a controller of the whole box at θ.

    Parameters
    ----------
    sampler : Sampler
        Of the problem with the box, and with warm starts where there is a controller.
    theta, kappa : tuple of float, array or None
        Of the design for the whole box, SI; None where there is none: then the model's own.
    plan, distribution, seed : Plan, mapping, int
    tell : callable

    Returns
    -------
    ShareSearch
    """
    problem = sampler.problem
    if kappa is None:
        known = structured_of(problem).uncertainty.options
        alone = replace(problem, start=theta)
        alone = with_structured(alone, uncertainty=Uncertainty(options=known), seed=seed)
        found, made, _ = prepared(alone, tell, sampler.workers)
        if not made.certified:
            raise NoDesign(f"no controller was found for the model alone: {made.words}")
        own, kappa = structured_of(found), made.kappa
        problem = with_structured(problem, warm_starts=own.warm_starts, channels=own.channels,
                                  frequencies=own.frequencies)  # fmt: skip
    options = range(1 + len(structured_of(problem).uncertainty.options))
    model = uncertain_plant(problem, theta).nominal
    models = tuple(scenario_of((option, model)) for option in options)
    own_sampler = sampler.of(with_structured(problem, scenarios=models))
    start = own_sampler.value_from(theta, kappa.tolist())
    if not start.feasible:
        raise NoDesign(f"no controller was found for the model alone: {start.shortfall}")
    return ShareSearch(own_sampler, start, plan, distribution, seed)


def search_share(
    search: ShareSearch, tell: Tell, *, moves: bool, options: ShareOptions = ShareOptions()
) -> ShareSearch:
    """Search over θ and controller.

    Parameters
    ----------
    search : ShareSearch
        As it begins.
    tell : callable
        Is given lines of progress.
    moves : bool
        Whether θ may move.
    options : ShareOptions

    Returns
    -------
    ShareSearch
        The best that a round of draws has settled, or the last.
    """
    search = search.at_its_theta(tell, options)
    J = partial(objective_of, search.problem)
    elsewhere = multistart_at(search.sampler, search.best)  # another controller may be better there
    if J(elsewhere) < J(search.best) - options.settled * abs(J(search.best)):
        best = search.sampler.value_from(search.best.theta, elsewhere.design.kappa.tolist())
        other = replace(search, best=best).at_its_theta(tell, options, J(search.best))
        search = min((search, other), key=lambda one: (not one.settled, J(one.best)))
    for _ in range(options.moves if moves else 0):
        if ends_early("move of theta"):
            break
        moved = pieces_from(search.sampler, search.best, options.settled)
        before = J(search.best)
        if not J(moved) < before - options.settled * abs(before):
            break
        other = replace(search, best=moved).at_its_theta(tell, options, before)
        better = J(other.best) < before - options.settled * abs(before)
        if not (better and other.settled >= search.settled):
            break
        search = other
    return search
