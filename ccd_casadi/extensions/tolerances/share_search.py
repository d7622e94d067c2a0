"""Search of a machine and controller whose bounds hold for a share of all machines.

    max over (θ, κ) of -J  s.t.  every bound holds on all but K of N drawn machines

by constraint removal with re-ranking (Campi and Garatti 2011): on a working set of draws the
design is that of the core, with its exact slopes; the draws are then ranked by their largest figure
over its bound; the K worst are given up, and those after them that exceed a bound join the set.
A design is accepted by new draws alone, of which only its own failures count: those of earlier
designs say nothing of it, and the draws that made it flatter it. While θ moves one round accepts;
the last design is accepted by all rounds of the plan's trial (`machines.Plan`). What fails there
joins the set, and the search goes on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ccd_casadi.codesign.outer import pieces_from
from ccd_casadi.codesign.stored_searches import multistart_at, value_with_design
from ccd_casadi.extensions.tolerances.machines import Machine, Plan, Trial, draw_machines
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.worst_plant import LoopOnBox, WorstPlantOptions
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import (
    Scenario,
    state_of,
    with_state,
    with_warm_start,
)
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import Uncertainty, structured_of, with_structured
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import NoDesign
from ccd_casadi.support.terminal import Log
from ccd_casadi.support.text import plural
from ccd_casadi.support.time_budget import ends_early


@dataclass(frozen=True)
class ShareOptions:
    """Numbers of the search for a share.

    Attributes
    ----------
    rounds : int
        Of new draws at one θ while it moves, at most.
    aimed : float
        Failures that a design may have in the draws seen, over those that its trial allows in as
        many: of fresh draws it has more.
    designs : int
        Between two rounds, at most.
    tail : int
        Draws of a round that are ranked again: those nearest to a bound.
    added : int
        Draws that join the working set at once.
    binds : float
        What a machine of the set that binds is within, of ln of a figure over its bound.
    moves : int
        Local solves over θ, each on the working set of the θ before.
    settled : float
        Of J: a move that gains less ends them.
    seed : int
        Beside the run's: no other draw is repeated.
    """

    rounds: int = 12
    aimed: float = 0.5
    designs: int = 12
    tail: int = 200
    added: int = 4
    binds: float = 1e-3
    moves: int = 3
    settled: float = 1e-4
    seed: int = 4000


@dataclass(frozen=True)
class ShareSearch:
    """A search as far as it is."""

    sampler: Sampler  # of the problem whose scenarios are the working set
    best: InnerSample  # θ and κ on that set
    plan: Plan  # what is required
    distribution: Mapping[str, str]  # how tolerances are drawn
    seed: int  # the run's
    tail: tuple[Machine, ...] = ()  # draws that are ranked again
    rounds: int = 0  # of new draws, each of the certificate's number
    settled: bool = False  # whether new draws have accepted it
    whole_box: tuple[float, ...] = ()  # κ (SI) of the design for the whole box, to start from again

    @property
    def problem(self) -> CoDesignProblem:
        """The problem with the working set."""
        return self.sampler.problem

    @property
    def design(self) -> SectionsDesign:
        """The design with its controller and certificate on the working set."""
        return value_with_design(self.sampler, self.best).design

    def may_fail(self, options: ShareOptions) -> int:
        """K: how many of the draws seen are given up."""
        return int(options.aimed * self.plan.trial.allowed / self.plan.trial.rounds * self.rounds)

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
        """After a round of new draws; how many machines of it fail."""
        rng = np.random.default_rng((self.seed, options.seed, self.rounds))
        uncertain = uncertain_plant(self.problem, self.best.theta)
        new = draw_machines(uncertain, self.distribution, rng, self.plan.draws)
        value = self.excesses(new)
        nearest = [new[i] for i in np.argsort(-value, kind="stable")[: options.tail]]
        wider = replace(self, tail=(*self.tail, *nearest), rounds=self.rounds + 1)
        return wider, int((value > WorstPlantOptions.within).sum())

    def rank(self) -> dict[Scenario, float]:
        """The draws ranked again and their excesses, the worst first."""
        value = self.excesses(self.tail)
        order = np.argsort(-value, kind="stable")
        return {scenario_of(self.tail[i]): float(value[i]) for i in order}

    def failing(self) -> list[Scenario]:
        """List those machines that exceed a bound."""
        return [one for one, value in self.rank().items() if value > WorstPlantOptions.within]

    def redesign(self, log: Log, options: ShareOptions, fewer: int = 0) -> "ShareSearch":
        """Add the machines that exceed a bound and are not given up, until there are none.

        `fewer`: by which the next design fails on at least, so that none is tried twice.
        """
        search, may = self, self.may_fail(options)
        for _ in range(options.designs):
            known = state_of(search.problem).scenarios
            over = [one for one in search.failing() if one not in known]
            may, fewer = max(min(may, len(over) - fewer), 0) if fewer else may, 0
            added = over[may:][: options.added]
            if not added or ends_early("design on drawn machines"):
                break
            search = search.on((*known, *added))
            search.log(log, f"{plural(len(over), 'machine')} exceeded a bound, {may} may")
        return search.relieve(log, options, may)

    def relieve(self, log: Log, options: ShareOptions, may: int) -> "ShareSearch":
        """Drop the machine that costs most, again and again, while no more than may fail do: the
        set has machines that joined when fewer were given up."""
        search, J = self, partial(objective_of, self.problem)
        while not ends_early("design without a machine"):
            ranked, known = search.rank(), state_of(search.problem).scenarios
            if sum(value > WorstPlantOptions.within for value in ranked.values()) >= may:
                break
            binding = [one for one in known if ranked.get(one, -np.inf) > -options.binds]
            others = [search.on(tuple(each for each in known if each != one)) for one in binding]
            least = J(search.best) - options.settled * abs(J(search.best))
            better = sorted((J(one.best), i) for i, one in enumerate(others) if J(one.best) < least)
            found = (others[i] for _, i in better if len(others[i].failing()) <= may)
            if (other := next(found, None)) is None:
                break
            search = other
            search.log(log, "one that binds was given up")
        return search

    def log(self, log: Log, words: str) -> None:
        """A line of progress."""
        shown = self.problem.figure.format_value(self.best.value)
        log(f"{shown} on {len(state_of(self.problem).scenarios)} machines; {words}")

    def on(self, scenarios: tuple[Scenario, ...]) -> "ShareSearch":
        """The best from its own controller on another working set, at the same θ.

        Raises
        ------
        NoDesign
            None meets the bounds there.
        """
        problem = with_warm_start(self.problem, self.best.kappa)
        sampler = self.sampler.of(with_state(problem, scenarios=scenarios))
        best = sampler.value_from(self.best.theta, self.best.kappa)
        if not best.feasible and self.whole_box:  # that from the model alone may be unstable there
            best = sampler.value_from(self.best.theta, list(self.whole_box))
        if not best.feasible:
            raise NoDesign(f"no controller was found for this share: {best.shortfall}")
        return replace(self, sampler=sampler, best=best)

    def at_its_theta(
        self, log: Log, options: ShareOptions, trial: Trial, designs: int
    ) -> "ShareSearch":
        """Trials and designs at one θ, until new draws accept a design."""
        search = replace(self, settled=False)
        for _ in range(designs):
            failing = 0
            for number in range(1, trial.rounds + 1):
                search, more = search.with_draws(options)
                failing += more
                log(
                    f"{failing} of {number * search.plan.draws} new machines fail; "
                    f"{trial.allowed} of {trial.rounds * search.plan.draws} may"
                )
                if failing > trial.allowed:
                    break
                if number == trial.rounds:
                    return replace(search, settled=True)
                if ends_early("round of drawn machines"):
                    return search
            if ends_early("round of drawn machines"):
                break
            search = search.redesign(log, options, fewer=1)
        return search


def scenario_of(machine: Machine) -> Scenario:
    """A drawn machine as a plant of a problem's set."""
    option, point = machine
    return option, tuple(map(float, point))


def start_search(
    sampler: Sampler, theta: tuple[float, ...], kappa: Array | None, plan: Plan,
    distribution: Mapping[str, str], seed: int, log: Log,
) -> ShareSearch:  # fmt: skip
    """Begin with the model of every option alone.

    From κ of the design for the whole box at θ (SI); None where there is none: then from the
    model's own. `sampler` is of the problem with the box.
    """
    problem = sampler.problem
    if kappa is None:
        known = structured_of(problem).uncertainty.options
        alone = with_state(replace(problem, start=theta), seed=seed)
        alone = with_structured(alone, uncertainty=Uncertainty(options=known))
        found, made, _ = prepare_search(alone, log, sampler.workers)
        if not made.certified:
            raise NoDesign(f"no controller was found for the model alone: {made.words}")
        own, kappa = structured_of(found), made.kappa
        problem = with_state(problem, warm_starts=state_of(found).warm_starts)
        problem = with_structured(problem, channels=own.channels, frequencies=own.frequencies)
    options = range(1 + len(structured_of(problem).uncertainty.options))
    model = uncertain_plant(problem, theta).nominal
    models = tuple(scenario_of((option, model)) for option in options)
    own_sampler = sampler.of(with_state(problem, scenarios=models))
    start = own_sampler.value_from(theta, kappa.tolist())
    if not start.feasible:
        raise NoDesign(f"no controller was found for the model alone: {start.shortfall}")
    return ShareSearch(own_sampler, start, plan, distribution, seed, whole_box=(*kappa.tolist(),))


def search_share(
    search: ShareSearch, log: Log, *, moves: bool, options: ShareOptions = ShareOptions()
) -> ShareSearch:
    """Search over θ, where it may move, and controller: the best, settled where the plan's trial
    has accepted it. `log` is given lines of progress.
    """
    trial = search.plan.trial
    short = Trial(1, -(-trial.allowed // trial.rounds))

    def screen(one: ShareSearch) -> ShareSearch:
        return one.at_its_theta(log, options, short, options.rounds)

    J = partial(objective_of, search.problem)

    def better(best: InnerSample) -> ShareSearch:
        """Continue from a better design where it is better than the present one on the draws of
        both."""
        if not J(best) < J(search.best) - options.settled * abs(J(search.best)):
            return search
        there = screen(replace(search, best=best))
        here = replace(search, tail=there.tail, rounds=there.rounds).redesign(log, options)
        return min((here, there), key=lambda one: J(one.best))

    search = screen(search)
    elsewhere = multistart_at(search.sampler, search.best).design.kappa.tolist()
    search = better(search.sampler.value_from(search.best.theta, elsewhere))
    for _ in range(options.moves if moves else 0):
        before = search.best.theta
        if ends_early("move of theta"):
            break
        search = better(pieces_from(search.sampler, search.best, options.settled))
        if search.best.theta == before:
            break
    return search.at_its_theta(log, options, trial, search.plan.options.attempts)
