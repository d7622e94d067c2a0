"""The outer problem with controllers of fixed structure, over θ alone.

A formulation works on v(θ) of the problem's warm starts and plant set, with envelope gradients. At
its end a multi-start search and a search for worse plants ask whether these were good enough at
that θ; if not, what they find joins, and the outer problem is solved again.

The polish works on the true value: it passes kinks, and keeps its controller.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.cases.run_folder import read_json, sections_kappa, with_function
from ccd_casadi.codesign.final_judgement import (
    between_on_set,
    judge_survival,
    other_damping,
    second_on_set,
)
from ccd_casadi.codesign.optimality import theta_kkt
from ccd_casadi.codesign.outer import Place, PolishedDesign, ThetaOuter, is_expensive, pieces_from
from ccd_casadi.codesign.post_optimal import PostOptimal, structured_responses
from ccd_casadi.codesign.stored_searches import (
    multistart_at,
    printer,
    value_with_design,
    with_initial_search,
)
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.theta_joint import joint_search, objectives_beside
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.codesign.verified_structured import Costs, VerifiedStructured, costs_of
from ccd_casadi.codesign.working_set import with_scenarios
from ccd_casadi.fixed_structure.certificate import SetCertificate
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, MOVE_TIME
from ccd_casadi.inner_problem.objective import objective, objective_of, violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.searched_problem import Scenario, state_of, with_warm_start
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue, stated_time
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.inner_problem.structured_robustness import BoxCheckOptions, DesignOnBox, recertify
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.structured_units import NeighbourOptions
from ccd_casadi.support import extensions
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import NoDesign
from ccd_casadi.support.process_pool import Workers, results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.time_budget import StageOptions, ends_early, stage
from ccd_casadi.support.worker_process import alongside

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.box_proof import Proof


@dataclass(frozen=True)
class StructuredOuterOptions:
    """Numbers of the outer problem with controllers of fixed structure."""

    stationary: float = 1e-5  # scaled residual below which a polish has nothing to do
    least_gain: float = 1e-9  # of J: pieces of a kink that promise less are not known so well
    better_at_elements: float = 1e-3  # relative: a controller that is better by less is the same
    searches: int = 5  # for plants that exceed a bound at an end, each elsewhere in the box
    searches_at_elements: int = 2  # of these where each θ is a finite-element model
    first_seed: int = 101  # they are numbered from it
    polishes: int = 4  # at most, each from a better controller that a search at the end has found


@dataclass(frozen=True)
class PolishedStructured(PolishedDesign):
    """The end of a polish of fixed structure: the sampler whose problem has it, its value with
    design and gradients, a multi-start search there (None where plants are to be added first), the
    worst plant, and those to add."""

    sampler: Sampler
    best: InnerSample
    inner: StructuredValue
    multistart: StructuredValue | None
    worst: Excess
    scenarios: tuple[Scenario, ...]


class StructuredOuter(ThetaOuter):
    """See the module; `words` say why the search at the start found no warm starts, where one
    `ended` before, no places far from there are tried again, and `repairs` counts designs that the
    judge has refuted: each is judged on a lattice of its own."""

    kkt_level = VerifiedStructured.kkt_level
    structured_options = StructuredOuterOptions()

    def __init__(
        self, sampler: Sampler, words: str = "", ended: bool = False, repairs: int = 0
    ) -> None:
        super().__init__(sampler)
        self.words, self.ended, self.repairs = words, ended, repairs

    @property
    def retries_pay(self) -> bool:
        return not is_expensive(self.problem)

    def promising(self, thetas: Array, threshold: float) -> Array:
        """Keep the θ that the bound of every controller does not exclude: far sooner than a search
        finds none."""
        tasks = {i: (self.problem, theta, threshold) for i, theta in enumerate(thetas.tolist())}
        excluded = dict(results(self.sampler.workers, _is_excluded, tasks))
        return thetas[[not excluded[i] for i in tasks]]

    def prepare(self, seed: int) -> "StructuredOuter":
        """Searched at the start for warm starts and the plant set, where there are none."""
        sampler = self.sampler
        if state_of(sampler.problem).warm_starts:
            return self
        with stage(StageOptions.start):
            problem, words = with_initial_search(sampler, seed)
        sampler.count_multistart(sampler.hash)
        lost = words and not state_of(problem).warm_starts
        return StructuredOuter(sampler.of(problem), words if lost else "")

    def resume(self, folder: Path, seed: int) -> "StructuredOuter":
        """Take up the warm starts, plants and controller of a run; those of a search where it has
        none."""
        path, sampler = folder / "result.json", self.sampler
        if not path.exists():
            return self.prepare(seed)
        result = read_json(path)
        problem = with_function(path, sampler.problem, result)
        outer = StructuredOuter(sampler.of(problem)).prepare(seed)
        if (folder / "controller.json").exists():
            theta = [float(result["theta"][name]) for name in problem.names]
            outer.sampler.value_from(theta, sections_kappa(folder, structure_of(problem)))
        return outer

    def local_solve(
        self, sample: InnerSample, earlier: Sequence[Place], settled: float | None = None
    ) -> Place | None:
        """Solve by the joint search where J counts the bandwidth, on the worse plants of its
        way."""
        if self.problem.figure is not BANDWIDTH or settled is not None:
            return super().local_solve(sample, earlier, settled)
        log = printer("local solve", self.sampler.quiet)
        ends = [(place.x, place.objective) for place in earlier]
        sampler, best, ended = joint_search(self.sampler, np.array(sample.theta), log, ends)
        J = objective_of(sampler.problem, best)
        if not np.isfinite(J):
            return None
        if best.theta != sample.theta:
            self.sampler.value_from(best.theta, best.kappa)  # a polish there begins with it
        return Place(np.array(best.theta), J, ended)

    def polish(self, x: Array) -> PolishedStructured:
        sampler, theta, options = self.sampler, self.theta_of(x), self.structured_options
        enough = NeighbourOptions().least_gain if self.retries_pay else options.better_at_elements
        for attempt in range(options.polishes):
            with sampler.spent.on("polish"):
                sampler, best = polish_structured(
                    sampler, theta, self.ended or attempt > 0, options
                )
            problem, found = sampler.problem, value_with_design(sampler, best)
            if found.design.controller is None:  # its own controller leads to none: from others
                found = multistart_at(sampler, best)
            if found.design.controller is None:
                at = dict(zip(problem.names, best.theta, strict=True))
                words = f"no controller was found again at {at}: {found.design.words}"
                raise NoDesign(f"{words}; give more controller.starts, or another --seed")
            worst, scenarios = _worst_plants(sampler, best, found.design, options)
            over = scenarios or ends_early("multi-start check")
            multistart = None if over else multistart_at(sampler, best)
            gap = _gap(problem, best, multistart)
            if multistart is None or not gap > enough or ends_early("polishing round"):
                break
            sampler.value_from(best.theta, multistart.design.kappa.tolist())
            theta = np.array(best.theta)
        return PolishedStructured(
            np.array(best.theta), best.value, objective_of(problem, best),
            theta_kkt(problem, best, envelope=found.envelope), gap, sampler, best, found,
            multistart, worst, scenarios,
        )  # fmt: skip

    def add_exceeding_plants(self, end: PolishedDesign) -> "StructuredOuter | None":
        """Add the plants that the end does not keep, searched for this alone: fresh ones judge the
        answer."""
        end = cast(PolishedStructured, end)
        if not end.scenarios:
            return None
        anchored = with_warm_start(end.sampler.problem, end.inner.design.kappa)
        sampler = with_scenarios(end.sampler.of(anchored), end.scenarios)
        return StructuredOuter(sampler, ended=True, repairs=self.repairs)

    def add_refuting_plants(self, verified: Verified) -> "StructuredOuter | None":
        verified = cast(VerifiedStructured, verified)
        if not verified.counterexamples:
            return None
        anchored = with_warm_start(verified.problem, verified.design.kappa)
        sampler = with_scenarios(self.sampler.of(anchored), verified.counterexamples)
        return StructuredOuter(sampler, ended=True, repairs=self.repairs + 1)

    def verify(self, end: PolishedDesign, rounds: int) -> VerifiedStructured:
        end = cast(PolishedStructured, end)
        sampler, best, design, worst = end.sampler, end.best, end.inner.design, end.worst
        problem = sampler.problem
        design = recertify(problem, best.theta, design)  # what a store holds is not relied on
        judging = BoxCheckOptions()
        judging = replace(judging, turn=self.repairs)
        on_box = DesignOnBox(problem, best.theta, design, judging)
        multistart = end.multistart
        if multistart is None and not ends_early("multi-start check"):
            multistart = multistart_at(sampler, best)
        assert design.controller is not None
        loops = loops_of(problem, best.theta, design.controller)
        known = is_expensive(problem) and problem.figure is BANDWIDTH
        beside = partial(objectives_beside, problem, best) if known else None
        certificate = partial(theta_kkt, problem, best, sampler, end.inner.envelope, beside)
        kkt = None if known else certificate()  # which spreads values over the workers itself

        def judged() -> "tuple[SetCertificate, int, Proof, Yield | None, tuple[Scenario, ...]]":
            whole = on_box.judge(worst, sampler.workers)
            if whole[-1].conclusive:
                return *whole, None, ()
            return *whole, *on_box.fresh_yield(sampler.workers)

        judgement = alongside(judged)
        with Progress(1, "what limits it", quiet=sampler.quiet) as bar:
            kkt = kkt or certificate()
            make = partial(costs_of, problem, best.theta, design.kappa)
            costs = sampler.recall("costs", best.theta, Costs, make)
            known_gap = extensions.function("known_gap")
            gap = None if known_gap is None else known_gap(problem, best.theta)
            prices = on_box.tolerance_prices()
            survival = judge_survival(problem, loops, design)[0]
            damping, reported = other_damping(problem, loops), None
            if problem.figure is MOVE_TIME:
                reported = stated_time(problem, best.theta, design.controller, best.value)
            second = second_on_set(problem, best.theta, design)
            between = between_on_set(problem, best.theta, design)
            wide, checked, proof, drawn, lost = judgement()
            bar.advance()
        return VerifiedStructured(
            problem=problem,
            theta=best.theta,
            value=best.value,
            objective=end.objective,
            hardware_cost=hardware_cost(plant_of(problem), best.theta),
            kkt=kkt,
            inner_gap=float(np.maximum(_gap(problem, best, multistart), 0.0)),
            feasible=design.certified and not violations(problem, best.theta),
            survival=survival,
            damping=damping,
            design=design,
            multistart=multistart,
            wide=wide,
            checked=checked,
            proof=proof,
            drawn=drawn,
            worst=worst,
            rounds=rounds,
            costs=costs,
            prices=prices,
            gap=gap,
            reported=reported,
            second=second,
            between=between,
            counterexamples=on_box.counterexamples(wide, proof, worst, lost),
        )

    def responses(self, x: Array) -> PostOptimal:
        sample = self.sampler.values(x, "the run's own design")[0]
        return structured_responses(self.problem, sample, value_with_design(self.sampler, sample))


def _worst_plants(
    sampler: Sampler, best: InnerSample, design: SectionsDesign, options: StructuredOuterOptions
) -> tuple[Excess, tuple[Scenario, ...]]:
    """The worst plant found for a design and those to add, by one search and, where that finds
    none, by several elsewhere in the box: before a multi-start search, which they would outdate."""
    problem, log = sampler.problem, printer("at the end", sampler.quiet)
    on_box = DesignOnBox(problem, best.theta, design)
    worst, scenarios = on_box.worst(0, log, sampler.workers)
    if scenarios or not np.isfinite(objective_of(problem, best)):
        return worst, scenarios
    if ends_early("worst-plant check", options.searches):
        return worst, scenarios
    few = is_expensive(problem)
    count = options.searches_at_elements if few else options.searches
    turns = range(options.first_seed, options.first_seed + count)
    workers = Workers(1) if few else sampler.workers  # this process knows the elements
    other, scenarios = on_box.worst_elsewhere(turns, workers, log)
    return max(worst, other, key=lambda one: one.value), scenarios


def _is_excluded(problem: CoDesignProblem, theta: Sequence[float], least: float) -> bool:
    """Whether it is shown that J is at least that at θ."""
    if problem.figure is not BANDWIDTH or not (problem.w2 < 0.0 and np.isfinite(least)):
        return False
    none_reaches = extensions.function("none_reaches")
    reached = (least - objective(problem, theta, 0.0)) / problem.w2
    return none_reaches is not None and none_reaches(problem, theta, reached)


def _gap(problem: CoDesignProblem, best: InnerSample, multistart: StructuredValue | None) -> float:
    """NaN where the search found no controller, or was not made: nothing was set against the
    design."""
    if multistart is None or not multistart.feasible:
        return np.nan
    return problem.figure.gain(multistart.value, best.value)


def polish_structured(
    sampler: Sampler,
    theta: Array,
    ended: bool = False,
    options: StructuredOuterOptions = StructuredOuterOptions(),
) -> tuple[Sampler, InnerSample]:
    """Polish a nearly optimal design to the best θ that is found near it on the true problem;
    return it with the sampler of the problem that has it: with more plants, where worse ones were
    found.

    By the joint search where J counts the bandwidth, which tries no places far from where one has
    `ended`; from there, where J is not stationary, by pieces (`pieces`), which know kinks, unless
    each θ is a finite-element model.
    """
    problem = sampler.problem
    if problem.figure is BANDWIDTH:
        log = printer("on the way", sampler.quiet)
        sampler, best, _ = joint_search(sampler, theta, log, polls=not ended)
        problem = sampler.problem
        if best.feasible and is_expensive(problem):
            return sampler, best
        if best.feasible:  # optimal to first order, by the gradients of several sides of it
            kkt = theta_kkt(problem, best, envelope=value_with_design(sampler, best).envelope)
            if kkt.stationarity <= VerifiedStructured.kkt_level:
                return sampler, best
        theta = np.array(best.theta)
    lower, upper = box(problem)
    near = np.where(theta - lower <= 1e-3 * (upper - lower), lower, theta)
    near = np.where(upper - near <= 1e-3 * (upper - lower), upper, near)
    candidates = sampler.values(np.unique([near, theta], axis=0), "polishing")
    best = min(candidates, key=lambda s: objective_of(problem, s))
    if theta_kkt(problem, best).stationarity > options.stationary:
        best = pieces_from(sampler, best, options.least_gain)
    return sampler, best
