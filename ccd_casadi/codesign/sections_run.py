"""A co-design with a controller of fixed structure: anchors, formulation, polish, race, judge.

The formulation works on ω_b*(θ) of the problem's anchors and plant set. At its end a full race and
a search for worse plants ask whether these were good enough at the θ that was found; if not, what
they find joins, and the outer problem is solved again, a few times at most.
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.codesign.direct import Direct
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.full_order import full_order_beside
from ccd_casadi.codesign.lifted import Lifted
from ccd_casadi.codesign.nested import Nested, solve_nested
from ccd_casadi.codesign.robust_check import other_damping, survived
from ccd_casadi.codesign.sections_direct import polish_sections, solve_direct_sections
from ccd_casadi.codesign.sections_kkt import sections_kkt
from ccd_casadi.codesign.sections_races import Raced, raced_at, seeded_and_prepared, teller
from ccd_casadi.codesign.stored import Surrogates
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.true_value import TrueBandwidth
from ccd_casadi.codesign.verified_sections import VerifiedSections
from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.fixed_structure.optimality import Envelope
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.constraints import unmet
from ccd_casadi.inner_problem.objective import objective_of
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.sections_bandwidth import joined, sections_value
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem
from ccd_casadi.inner_problem.sections_problem import Member
from ccd_casadi.inner_problem.sections_robustness import judged_widely, proof_of, worst_members
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.progress import Progress

AGAIN = 3  # times that the outer problem is solved at most
BETTER = 1e-3  # relative: what a race at the end has to gain to be worth another round


@dataclass(frozen=True)
class SectionsRun:
    """What `run_sections` ends with; `verified` None where no design was found."""

    outcome: FormulationResult
    verified: VerifiedSections | None
    spent: dict[str, int]


@dataclass(frozen=True)
class Searched:
    """What a search ends with; `end` None where no design was found."""

    outcome: FormulationResult
    end: "_End | None"
    rounds: int


def run_sections(sampler: Sampler, formulation: Nested | Lifted | Direct, seed: int) -> SectionsRun:
    """Sections' co-design on the sampler's store and workers."""
    found = search_sections(sampler, formulation, seed)
    made = None
    if found.end is not None:
        made = _verified(found.end, found.rounds)
    return SectionsRun(found.outcome, made, sampler.spent.by_purpose)


def search_sections(sampler: Sampler, formulation: Nested | Lifted | Direct, seed: int) -> Searched:
    """The same without the judge's look at the whole set; a problem that has anchors is not raced
    at its start."""
    problem, first = sampler.problem, ""
    if not sections_of_problem(problem).anchors:
        problem, first = seeded_and_prepared(
            sampler.store, problem, seed, sampler.quiet, sampler.workers
        )
        sampler.raced(sampler.hash)
    rounds = 0
    while True:
        rounds += 1
        asked = sampler.of(problem)
        outcome = _formulated(asked, formulation, seed)
        if outcome.x is None:
            words = first if first and not sections_of_problem(problem).anchors else ""
            if asked.nearest is not None:
                words = asked.nearest.shortfall
            outcome = replace(outcome, message=words or outcome.message)
            return Searched(outcome, None, rounds)
        sampled = np.array([*asked.solved])
        end = _end(asked, outcome.x[: len(problem.names)])
        if not (end.better or end.members) or rounds == AGAIN:
            break
        kappa = np.array(end.raced.kappa) if end.better else end.design.kappa
        problem = joined(end.asked.problem, kappa, end.members)
        if end.members:  # what was found for fewer plants is worth nothing on these
            sampler.trace[:] = [
                replace(entry, bandwidth=np.nan, objective=np.nan) for entry in sampler.trace
            ]
    if not isinstance(formulation, Direct):
        outcome, end = _foreseen(formulation, seed, outcome, end, sampled)
    return Searched(outcome, end, rounds)


def conclude_sections(sampler: Sampler, outcome: FormulationResult) -> SectionsRun:
    """Polish, race and judge the θ that an outcome ends at, on the sampler's anchors and set."""
    if outcome.x is None:
        words = "" if sampler.nearest is None else sampler.nearest.shortfall
        outcome = replace(outcome, message=outcome.message or words)
        return SectionsRun(outcome, None, sampler.spent.by_purpose)
    end = _end(sampler, outcome.x[: len(sampler.problem.names)])
    verified = _verified(end, 1)
    return SectionsRun(outcome, verified, sampler.spent.by_purpose)


@dataclass(frozen=True)
class _End:
    """The polished θ by a problem's sampler, its design and that one's gradients, a race there, the
    worst plant, and those to add."""

    asked: Sampler
    best: BandwidthSample
    design: SectionsDesign
    envelope: Envelope | None
    raced: Raced
    worst: Excess
    members: tuple[Member, ...]

    @property
    def gap(self) -> float:
        """By how much (relative) the race beats the design."""
        figure = self.asked.problem.figure
        return figure.gain(self.raced.value, self.best.value) if self.raced.certified else 0.0

    @property
    def better(self) -> bool:
        """Whether that is worth another round."""
        return self.gap > BETTER


def _end(asked: Sampler, theta: Array) -> _End:
    with asked.spent.on("polish"):
        asked, best = polish_sections(asked, theta)
    problem = asked.problem
    found = sections_value(problem, best.theta)
    raced = raced_at(asked, best.theta)
    tell = teller("at the end", asked.quiet)
    worst, members = worst_members(problem, best.theta, found.design, 0, tell)
    return _End(asked, best, found.design, found.envelope, raced, worst, members)


def _foreseen(
    formulation: Nested | Lifted, seed: int, outcome: FormulationResult, end: _End, sampled: Array
) -> tuple[FormulationResult, _End]:
    """Where the surrogate misses the polished design it learns it, and goes on from there."""
    error = abs(_predicted(outcome, end.best) / end.best.value - 1.0)
    if error <= formulation.tolerance or len(outcome.iterates) > formulation.max_refinements:
        return outcome, end
    asked, thetas = end.asked, np.unique(np.vstack([sampled, end.best.theta]), axis=0)
    found = _nested(asked, formulation, seed, Surrogates((), thetas, ()))
    if found.x is None:
        return outcome, end
    theta = found.x[: len(asked.problem.names)]
    if not np.array_equal(theta, end.best.theta):
        end = _end(asked, theta)
    return replace(found, iterates=(*outcome.iterates, *found.iterates)), end


def _predicted(outcome: FormulationResult, sample: BandwidthSample) -> float:
    """What the surrogate says at a sample; the sample's own value where there is none."""
    if not outcome.surrogates:
        return sample.value
    return float(outcome.surrogates[0].predict(np.array(sample.theta)[None, :])[0])


def _verified(end: _End, rounds: int) -> VerifiedSections:
    asked, best, made = end.asked, end.best, end.design
    problem = asked.problem
    assert made.controller is not None
    worst = end.worst
    loops = loops_of(problem, best.theta, made.controller)
    with asked.spent.on("checks"):
        kkt = sections_kkt(problem, best, TrueBandwidth(asked, "certificate"), end.envelope)
    wide, checked = judged_widely(problem, best.theta, made.controller, worst, asked.workers)
    with Progress(1, "full order beside it", quiet=asked.quiet) as bar:
        beside = full_order_beside(problem, best.theta, made)
        bar.advance()
    return VerifiedSections(
        problem=problem,
        theta=best.theta,
        value=best.value,
        objective=objective_of(problem, best),
        hardware_cost=hardware_cost(plant_of(problem), best.theta),
        kkt=kkt,
        inner_gap=float(max(end.gap, 0.0)),
        feasible=made.certified and not unmet(problem, best.theta),
        survival=survived(problem, loops, made.bandwidth)[0] if made.certified else None,
        damping=other_damping(problem, loops),
        design=made,
        raced=end.raced,
        wide=wide,
        checked=checked,
        proof=proof_of(problem, best.theta, made),
        worst=worst,
        rounds=rounds,
        beside=beside,
    )


def _formulated(
    asked: Sampler, formulation: Nested | Lifted | Direct, seed: int
) -> FormulationResult:
    if isinstance(formulation, Direct):
        with asked.spent.on("search"):
            return solve_direct_sections(asked, formulation.starts, seed=seed)
    return _nested(asked, formulation, seed)


def _nested(
    asked: Sampler, formulation: Nested | Lifted, seed: int, given: Surrogates | None = None
) -> FormulationResult:
    if isinstance(formulation, Nested):
        return solve_nested(asked, formulation, seed=seed, given=given)
    # The constituents ω_S and ω_T do not exist here: what is lifted are the exact gradients.
    points = formulation.points or 6 * len(asked.problem.names)
    options = Nested("sobol", points, formulation.starts, formulation.tolerance,
                     formulation.max_refinements, formulation.kernel)  # fmt: skip
    return solve_nested(asked, options, seed=seed, given=given, gradients=True)
