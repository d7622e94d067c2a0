"""The outer problem with controllers of fixed structure, over θ alone.

A formulation works on v(θ) of the problem's anchors and plant set, with envelope gradients. At its
end a multi-start search and a search for worse plants ask whether these were good enough at that
θ; if not, what they find joins, and the outer problem is solved again.

The polish works on the true value: it passes kinks, and keeps its controller. Multi-start searches
are kept in the store of samples: a run that goes on from its store repeats none.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from ccd_casadi.cases.run_folder import read_json, sections_kappa, with_function
from ccd_casadi.codesign.outer import End, dear
from ccd_casadi.codesign.outer_theta import ThetaOuter
from ccd_casadi.codesign.post_optimal import PostOptimal, structured_responses
from ccd_casadi.codesign.robust_check import other_damping, survived
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.theta_direct import pieces_from
from ccd_casadi.codesign.theta_joint import objectives_beside, together, with_members
from ccd_casadi.codesign.theta_kkt import theta_kkt
from ccd_casadi.codesign.verified_structured import Costs, VerifiedStructured, costs_of
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.constraints import unmet
from ccd_casadi.inner_problem.figure import BANDWIDTH, MOVE_TIME
from ccd_casadi.inner_problem.move_figures import told_time
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue, structured_value, valued
from ccd_casadi.inner_problem.structured_plant_set import (
    plants_of,
    structure_of,
    structured_of,
    uncertain_plant,
)
from ccd_casadi.inner_problem.structured_problem import Member
from ccd_casadi.inner_problem.structured_robustness import (
    fresh_yield,
    judged_widely,
    proof_of,
    tolerance_prices,
    worst_members,
)
from ccd_casadi.inner_problem.structured_search import (
    joined,
    least_from,
    prepared,
    race,
    with_range,
)
from ccd_casadi.limitations.of_problem import known_gap
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.neighbours import WORTH, alone
from ccd_casadi.sampling.rows import problem_hash, sample_key
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.support.progress import Progress
from ccd_casadi.support.terminal import say


@dataclass(frozen=True)
class Seeds:
    """Anchors (κ in SI, rad/s) and members that the search at the start found; `words` why none."""

    anchors: tuple[tuple[float, ...], ...]
    members: tuple[Member, ...]
    error_anchors: tuple[tuple[float, ...], ...]
    words: str


def seeded_and_prepared(
    store: SampleStore,
    problem: CoDesignProblem,
    seed: int,
    quiet: bool,
    workers: Pool | None = None,
) -> tuple[CoDesignProblem, str]:
    """Anchors and members, from the store where an earlier run has found them.

    Second, in words, why there are no anchors; empty where there are.
    """
    own = replace(structured_of(problem), seed=seed)
    problem = with_range(replace(problem, controller=own))
    owner = problem_hash({"seeds": problem.identity(), "inner": problem.inner_identity()})

    def found() -> Seeds:
        tell = teller("search at the start", quiet)
        anchored, made = prepared(problem, tell, workers)
        anchored, made, _ = least_from(anchored, problem.start, made, tell)
        own, start = structured_of(anchored), problem.start
        words = "" if made.certified else made.words
        alone = len(own.members) == len(uncertain_plant(problem, start).corners())
        if made.certified and alone and problem.figure is BANDWIDTH:
            # No plant was found worse: this is the search that an end at the start would ask for.
            value = valued(anchored, start, plants_of(anchored, start), made, 1)
            Sampler(anchored, store, Workers(1)).kept("race", start, StructuredValue, lambda: value)
        return Seeds(own.anchors, own.members, own.error_anchors, words)

    key = sample_key(owner, problem.start, 0.0, 0.0)
    seeds = store.kept(key, owner, problem.start, Seeds, found)
    structured = replace(
        structured_of(problem), anchors=seeds.anchors, members=seeds.members,
        error_anchors=seeds.error_anchors,
    )  # fmt: skip
    return replace(problem, controller=structured), seeds.words


def raced_at(sampler: Sampler, best: BandwidthSample) -> StructuredValue:
    """A multi-start search at the θ of a sample, from its controller too, with all its optima,
    counted; from the store if it is there."""
    problem, theta = joined(sampler.problem, np.array(best.kappa), ()), best.theta

    def raced() -> StructuredValue:
        made = race(problem, theta, teller("search at the end", sampler.quiet), sampler.workers)
        found = valued(problem, theta, plants_of(problem, theta), made, 1)
        return replace(found, design=replace(found.design, local_optima=made.local_optima))

    sampler.raced(sample_key(sampler.hash, theta, 0.0, 0.0))
    return sampler.kept("race", theta, StructuredValue, raced)


def value_at(sampler: Sampler, best: BandwidthSample) -> StructuredValue:
    """A sample with its design and envelope, from the store where it was made before."""
    problem = alone(sampler.problem, best.kappa) if best.kappa else sampler.problem
    make = partial(structured_value, problem, best.theta)
    return sampler.of(problem).kept("value", best.theta, StructuredValue, make)


def teller(label: str, quiet: bool) -> Callable[[str], None]:
    """Lines of progress on stderr."""

    def tell(words: str) -> None:
        if not quiet:
            with suppress(OSError, ValueError):  # a stream that fails ends the printing
                say(f"{label}: {words}", sys.stderr)

    return tell


STATIONARY = 1e-5  # scaled residual below which a polish has nothing to do
LEVEL = 1e-9  # of J: what the pieces of a kink promise less than that is not known
WORTH_ELEMENTS = 1e-3  # relative: what one has to gain where each θ is a finite-element model
LOOKS, APART = 5, 100  # for plants that an end does not keep, each elsewhere in the box
TAKEN = 4  # times at most that a search at the end may find a better controller


@dataclass(frozen=True)
class StructuredEnd(End):
    """With the sampler of the problem that has it, its value and that one's design and gradients,
    a multi-start search there (None where plants are to be added first), the worst plant, and those
    to add."""

    asked: Sampler
    best: BandwidthSample
    found: StructuredValue
    raced: StructuredValue | None
    worst: Excess
    members: tuple[Member, ...]


class StructuredOuter(ThetaOuter):
    """See the module; `words` say why the search at the start found no anchors."""

    kkt_level = VerifiedStructured.kkt_level

    def __init__(self, sampler: Sampler, words: str = "") -> None:
        super().__init__(sampler)
        self.words = words

    @property
    def may_try_again(self) -> bool:
        return not dear(self.problem)

    def prepared(self, seed: int) -> "StructuredOuter":
        """Searched at the start for anchors and the plant set, where there are none."""
        sampler = self.sampler
        if structured_of(sampler.problem).anchors:
            return self
        problem, words = seeded_and_prepared(
            sampler.store, sampler.problem, seed, sampler.quiet, sampler.workers
        )
        sampler.raced(sampler.hash)
        lost = words and not structured_of(problem).anchors
        return StructuredOuter(sampler.of(problem), words if lost else "")

    def continued(self, folder: Path, seed: int) -> "StructuredOuter":
        """With the anchors, plants and controller of a run; those of a search where it has none."""
        path, sampler = folder / "result.json", self.sampler
        if not path.exists():
            return self.prepared(seed)
        result = read_json(path)
        problem = with_function(path, sampler.problem, result)
        outer = StructuredOuter(sampler.of(problem)).prepared(seed)
        if (folder / "controller.json").exists():
            theta = [float(result["theta"][name]) for name in problem.names]
            outer.sampler.climbed(theta, sections_kappa(folder, structure_of(problem)))
        return outer

    def ended(self, x: Array) -> StructuredEnd:
        asked, theta = self.sampler, self.theta_of(x)
        for _ in range(TAKEN):
            with asked.spent.on("polish"):
                asked, best = polish_structured(asked, theta)
            problem, found = asked.problem, value_at(asked, best)
            tell = teller("at the end", asked.quiet)
            worst, members = worst_members(problem, best.theta, found.design, 0, tell)
            raced = None if members else raced_at(asked, best)
            gap = 0.0 if raced is None else _gap(problem, best, raced)
            if raced is None or gap <= (WORTH if self.may_try_again else WORTH_ELEMENTS):
                break
            asked.climbed(best.theta, raced.design.kappa.tolist())
            theta = np.array(best.theta)
        return StructuredEnd(
            np.array(best.theta), best.value, objective_of(problem, best),
            theta_kkt(problem, best, envelope=found.envelope), gap, asked, best, found, raced,
            worst, members,
        )  # fmt: skip

    def joined(self, end: End) -> "StructuredOuter | None":
        """With plants that it does not keep, of those searched or drawn for this alone: fresh ones
        judge the answer."""
        end = cast(StructuredEnd, end)
        problem, theta, members = end.asked.problem, end.best.theta, end.members
        tell = teller("at the end", end.asked.quiet)
        for look in range(1, LOOKS + 1 if end.feasible and not members else 1):
            members = worst_members(problem, theta, end.found.design, APART + look, tell)[1]
            if members:
                break
        if not members:
            return None
        anchored = joined(problem, end.found.design.kappa, ())
        return StructuredOuter(with_members(end.asked.of(anchored), members))

    def verified(self, end: End, rounds: int) -> VerifiedStructured:
        end = cast(StructuredEnd, end)
        asked, best, made, worst = end.asked, end.best, end.found.design, end.worst
        problem = asked.problem
        raced = raced_at(asked, best) if end.raced is None else end.raced
        assert made.controller is not None
        loops = loops_of(problem, best.theta, made.controller)
        beside = partial(objectives_beside, problem, best)
        known = dear(problem) and problem.figure is BANDWIDTH
        kkt = theta_kkt(problem, best, asked, end.found.envelope, beside if known else None)
        wide, checked = judged_widely(problem, best.theta, made.controller, worst, asked.workers)
        proof = proof_of(problem, best.theta, made, asked.workers)
        drawn = None if proof.conclusive else fresh_yield(problem, best.theta, made, asked.workers)
        with Progress(1, "what limits it", quiet=asked.quiet) as bar:
            make = partial(costs_of, problem, best.theta, made.kappa)
            costs = asked.kept("costs", best.theta, Costs, make)
            gap = known_gap(problem, best.theta)
            told = None
            if problem.figure is MOVE_TIME:
                told = told_time(problem, best.theta, made.controller, best.value)
            bar.advance()
        return VerifiedStructured(
            problem=problem,
            theta=best.theta,
            value=best.value,
            objective=end.objective,
            hardware_cost=hardware_cost(plant_of(problem), best.theta),
            kkt=kkt,
            inner_gap=float(max(_gap(problem, best, raced), 0.0)),
            feasible=made.certified and not unmet(problem, best.theta),
            survival=survived(problem, loops, made.bandwidth)[0] if made.certified else None,
            damping=other_damping(problem, loops),
            design=made,
            raced=raced,
            wide=wide,
            checked=checked,
            proof=proof,
            drawn=drawn,
            worst=worst,
            rounds=rounds,
            costs=costs,
            prices=tolerance_prices(problem, best.theta, made),
            gap=gap,
            told=told,
        )

    def responses(self, x: Array) -> PostOptimal:
        sample = self.sampler.bandwidths(x, "the run's own design")[0]
        return structured_responses(self.problem, sample, value_at(self.sampler, sample))


def _gap(problem: CoDesignProblem, best: BandwidthSample, raced: StructuredValue) -> float:
    return problem.figure.gain(raced.value, best.value) if raced.feasible else 0.0


def polish_structured(sampler: Sampler, theta: Array) -> tuple[Sampler, BandwidthSample]:
    """From a design nearly optimal to the best θ that is found near it on the true problem, and
    the sampler of the problem that has it: with more plants, where worse ones were found.

    By the joint search where J counts the bandwidth; from there, where J is not stationary, by
    pieces (`pieces`), which know kinks, unless each θ is a finite-element model.
    """
    problem = sampler.problem
    if problem.figure is BANDWIDTH:
        sampler, best, _ = together(sampler, theta, teller("on the way", sampler.quiet))
        problem = sampler.problem
        if best.feasible and (dear(problem) or _stationary(sampler, best)):
            return sampler, best
        theta = np.array(best.theta)
    lower, upper = box(problem)
    near = np.where(theta - lower <= 1e-3 * (upper - lower), lower, theta)
    near = np.where(upper - near <= 1e-3 * (upper - lower), upper, near)
    candidates = sampler.bandwidths(np.unique([near, theta], axis=0), "polishing")
    best = min(candidates, key=lambda s: objective_of(problem, s))
    if theta_kkt(problem, best).stationarity > STATIONARY:
        best = pieces_from(sampler, best, LEVEL)
    return sampler, best


def _stationary(sampler: Sampler, best: BandwidthSample) -> bool:
    """Whether a sample is optimal to first order, by the gradients of several sides of it."""
    envelope = value_at(sampler, best).envelope
    kkt = theta_kkt(sampler.problem, best, envelope=envelope)
    return kkt.stationarity <= VerifiedStructured.kkt_level
