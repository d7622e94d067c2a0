"""A controller of fixed structure on the whole box of plants: the worst of them, judge, proof.

The worst plants join the set that `structured_bandwidth` designs for; the judge looks at a lattice
of the box beside them, branch and bound at all of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import call

import numpy as np

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.fixed_structure import SectionsDesign, SetCertificate, certify
from ccd_casadi.fixed_structure.box_proof import Proof, prove
from ccd_casadi.fixed_structure.certificate import CertificateOptions
from ccd_casadi.fixed_structure.design import SectionsOutcome, bandwidth_envelope
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import (
    Excess,
    LoopOnBox,
    WorstPlantOptions,
    lattice,
    worst_plants,
)
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, MOVE_TIME
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import LOST, ProblemAt, latest_plant
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    plants_of,
    structure_of,
    structured_of,
    uncertain_plant,
)
from ccd_casadi.inner_problem.structured_problem import Scenario
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Tell, silent
from ccd_casadi.support.text import HZ, of_a_bound

AT_ONCE = 8  # plants added in a round
APART = 1e-4  # of the box: plants that are closer are the same plant
CHECKED = 200  # plants that the judge looks at in the end
LOOSE = 2.0 * WorstPlantOptions.within  # relative: by how much they may pass a bound
# Plants drawn for the yield, by their cost (2 ms, and 120 ms with four channels): where none fails
# they prove 99.54 % and 95.5 % at confidence 1 - 1e-6.
FRESH, FRESH_OF_SEVERAL = 3000, 300
FRESH_SEED = 2000  # apart from those of the search and of the lattice


@dataclass(frozen=True)
class DesignOnBox:
    """A design of a problem at θ, held against the whole box of plants there."""

    problem: CoDesignProblem
    theta: Sequence[float]
    design: SectionsDesign

    @property
    def uncertain(self) -> UncertainPlant:
        """The box."""
        return uncertain_plant(self.problem, self.theta)

    def worst(self, turn: int = 0, tell: Tell = silent) -> tuple[Excess, tuple[Scenario, ...]]:
        """The worst plant of the box, and those to add: past a bound, each a new one.

        Where a move's time counts the plant that settles latest besides, if it is later than v.
        """
        problem, theta, design = self.problem, self.theta, self.design
        worst, found = violations(
            problem, self.uncertain, design.kappa, design.bandwidth, turn, tell
        )
        if problem.figure is MOVE_TIME and design.controller is not None:
            value = float(np.exp(ProblemAt(problem, theta).goal.at(design.kappa)[0]))
            seed = structured_of(problem).seed + turn
            time, option, point = latest_plant(problem, theta, design.controller, seed)
            tell(f"{1e3 * time:.5g} ms on the latest plant, {1e3 * value:.5g} ms counted")
            if time > value:
                found = (*found, (option, tuple(map(float, point))))
        return worst, found

    def worst_elsewhere(
        self, turns: range, workers: Pool, tell: Tell
    ) -> tuple[Excess, tuple[Scenario, ...]]:
        """The worst plant of several searches, and those to add of the first that finds any; as
        many at a time as there are workers."""
        seen: list[Excess] = []
        for first in turns[:: workers.count]:
            own = range(first, min(first + workers.count, turns.stop))
            found = dict(results(workers, self.worst, {turn: (turn,) for turn in own}))
            seen += [worst for worst, _ in found.values()]
            largest = max(seen, key=lambda one: one.value)
            tell(f"{of_a_bound(largest.value)} at most, searched from elsewhere")
            added = next((found[turn][1] for turn in own if found[turn][1]), ())
            if added:
                break
        return largest, added

    def on_lattice(self, worst: Excess, workers: Pool | None = None) -> tuple[SetCertificate, int]:
        """The independent judge on a lattice of the box and the worst plant; how many plants it
        saw.

        The bounds count as met within `LOOSE`, since the search stops at half of it.
        """
        structured, uncertain = structured_of(self.problem), self.uncertain
        points = [*lattice(uncertain, CHECKED, structured.seed + 1000), (worst.option, worst.point)]
        if not uncertain.names:
            points = uncertain.corners()[: 1 + len(structured.uncertainty.options)]
        else:
            points += [(option, np.array(point)) for option, point in structured.scenarios]
        K = self.design.controller
        assert K is not None
        return _judged(self.problem, uncertain.as_written(points), K, workers), len(points)

    def fresh_yield(self, workers: Pool | None = None) -> Yield | None:
        """How many of so many plants drawn uniformly from the box keep every bound and ω_b, judged.

        The options are drawn alike often. None where there is no box to draw from.
        """
        structured, uncertain = structured_of(self.problem), self.uncertain
        if not uncertain.names or self.design.controller is None:
            return None
        count = FRESH if plant_of(self.problem).outputs == 1 else FRESH_OF_SEVERAL
        points = uncertain.drawn(np.random.default_rng((structured.seed, FRESH_SEED)), count)
        plants = uncertain.as_written(points)
        found = _judged(self.problem, plants, self.design.controller, workers).plants
        bounds = bounds_of(self.problem).looser(LOOSE)
        least = self.design.bandwidth * (1.0 - LOOSE)
        kept = [
            one.stable and one.confirmed and one.bandwidth >= least
            and all(
                share <= 1.0 + CertificateOptions.tolerance
                for share in (bounds.shares(one) | bounds.channel_shares(one.channels)).values()
            )
            for one in found
        ]  # fmt: skip
        return Yield(sum(kept), count)

    def proof(self, workers: Pool | None = None) -> Proof:
        """Branch and bound over the whole box."""
        design, problem = self.design, self.problem
        return prove(
            self.uncertain, design.structure, design.kappa, design.bandwidth, bounds_of(problem),
            problem.sampling, workers=workers,
        )  # fmt: skip

    def judged(self, worst: Excess, workers: Pool) -> tuple[SetCertificate, int, Proof]:
        """On a lattice and by proof, at one time; of several options, whose proofs are spread over
        the workers, one after the other."""
        if structured_of(self.problem).uncertainty.options:
            return *self.on_lattice(worst, workers), self.proof(workers)
        tasks = {"proof": (self.proof,), "lattice": (self.on_lattice, worst)}
        found = dict(results(workers, call, tasks))
        return *found["lattice"], found["proof"]

    def tolerance_prices(self) -> dict[str, float]:
        """dω_b*/d ln t in rad/s of every tolerance t of [robust], at an optimal design.

        Where t grows by 1 % every plant p of the set goes (p - model)/100 further off the model, so
        that with the multipliers μ of its rows c, dω_b*/d ln t = -Σ μ_j ∂c_j/∂p (p - model). None
        are known at a design that is not stationary or where J counts another figure.
        """
        problem, uncertain, plants = self.problem, self.uncertain, []
        if problem.figure is not BANDWIDTH or not uncertain.names:
            return {}
        for option, point in structured_of(problem).scenarios or uncertain.corners():
            plant = uncertain.sloped(np.array(point), option)
            further = (np.array(point) - uncertain.nominal)[:, None, None]
            slopes = {name: further * getattr(plant, name) for name in ("dA", "dB", "dC")}
            plants.append(replace(plant, **slopes))
        found = bandwidth_envelope(plants, bounds_of(problem), self.design, problem.sampling)
        gradient = [] if found is None else found.gradient.tolist()
        return dict(zip(uncertain.names, gradient, strict=False))


def violations(
    problem: CoDesignProblem,
    uncertain: UncertainPlant,
    kappa: Array,
    bandwidth: float,
    turn: int,
    tell: Tell | None = None,
    within: float = WorstPlantOptions.within,
    others: Sequence[Scenario] = (),
    count: int = WorstPlantOptions.lattice,
) -> tuple[Excess, tuple[Scenario, ...]]:
    """The worst plant found for κ (SI) at ω_b in rad/s from a lattice of `count`, and new ones over
    a bound by `within`; the `others` are known and tried besides."""
    structured = structured_of(problem)
    loop = LoopOnBox(uncertain, structure_of(problem), kappa, bandwidth, bounds_of(problem),
                     structured.sampling)  # fmt: skip
    known = [(option, np.array(point)) for option, point in others]
    tried = loop.excesses(known).tolist() if known else []
    heads, count = worst_plants(loop, structured.seed + turn, count)
    heads = [*(Excess(*one, value) for one, value in zip(known, tried, strict=True)), *heads]
    heads.sort(key=lambda head: -head.value)
    if tell is not None:
        tell(f"{of_a_bound(heads[0].value)} at most on {count} plants")
    width = uncertain.box[1] - uncertain.box[0]
    counted = structured.scenarios
    found: list[Scenario] = []
    for head in heads:
        near = [
            float(np.abs((head.point - np.array(point)) / width).max(initial=0.0))
            for option, point in (*counted, *found)
            if option == head.option
        ]
        if head.value > within and (not near or min(near) > APART) and len(found) < AT_ONCE:
            found.append((head.option, tuple(map(float, head.point))))
    return heads[0], tuple(found)


def recertified(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> SectionsDesign:
    """The design judged anew on the problem's plants: what a store of designs holds of it may be
    older than they are. No longer certified where that fails."""
    if design.controller is None:
        return design
    judged = certify(
        plants_of(problem, theta), design.controller, bounds_of(problem), problem.sampling,
        integrator=structure_of(problem).integrator,
    )  # fmt: skip
    again = replace(design, certificate=judged)
    if judged.passed and judged.bandwidth >= design.bandwidth * (1.0 - LOST):
        return again
    words = f"judged anew, {judged.bandwidth / HZ:.6g} Hz: {judged.words}"
    outcome = SectionsOutcome.NOT_CERTIFIED if design.certified else design.outcome
    return replace(again, outcome=outcome, words=words)


def certify_corners(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> SetCertificate:
    """The judge on the model of every option and the corners of the box."""
    uncertain = uncertain_plant(problem, theta)
    return _judged(problem, uncertain.as_written(uncertain.corners()), controller)


def _judged(
    problem: CoDesignProblem,
    plants: Sequence[StateSpace],
    controller: StateSpace,
    workers: Pool | None = None,
) -> SetCertificate:
    return certify(
        plants, controller, bounds_of(problem).looser(LOOSE), problem.sampling,
        integrator=structure_of(problem).integrator, workers=workers,
    )  # fmt: skip
