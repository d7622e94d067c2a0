"""A controller of fixed structure on the whole box of plants: the worst of them, judge, proof.

The worst plants join the set that `structured_bandwidth` designs for; the judge looks at a lattice
of the box beside them, branch and bound at all of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import call
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.fixed_structure.certificate import JudgeOptions, SetCertificate, certify
from ccd_casadi.fixed_structure.design import SectionsDesign, SectionsOutcome, bandwidth_envelope
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import (
    Excess,
    LoopOnBox,
    WorstPlantOptions,
    lattice,
    worst_plants,
)
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, MOVE_TIME
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, require_as_returned
from ccd_casadi.inner_problem.searched_problem import Scenario, state_of
from ccd_casadi.inner_problem.structured_bandwidth import (
    ProblemAt,
    StructuredValueOptions,
    latest_plant,
)
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    plants_of,
    structure_of,
    uncertain_plant,
)
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, Workers, results
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, of_a_bound

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.box_proof import Proof


@dataclass(frozen=True)
class BoxCheckOptions:
    """Numbers of the check of a design on the box of plants.

    Plants are drawn for the yield by their cost (2 ms, and 120 ms with four channels): where none
    fails they prove 99.54 % and 95.5 % at confidence 1 - 1e-6.

    Attributes
    ----------
    added : int
        Plants added to the set in a round, at most.
    apart : float
        Of the box: plants that are closer are the same plant.
    lattice, lattice_seed : int
        Plants that the judge sees in the end, and what is added to the problem's seed to draw them.
    looseness : float
        Relative: by how much they exceed a bound.
    fresh : int
        Plants drawn for the yield.
    fresh_of_several : int
        With several channels.
    fresh_seed : int
        Added to the problem's, so that no other draw is repeated.
    turn : int
        How many designs these checks have refuted before: each is judged on a lattice and on draws
        of its own.
    """

    added: int = 8
    apart: float = 1e-4
    lattice: int = 200
    lattice_seed: int = 1000
    looseness: float = 2.0 * WorstPlantOptions.within
    fresh: int = 3000
    fresh_of_several: int = 300
    fresh_seed: int = 2000
    turn: int = 0


@dataclass(frozen=True)
class DesignOnBox:
    """A design of a problem at θ, checked on the whole box of plants there.

    Attributes
    ----------
    problem, theta, design : CoDesignProblem, sequence of float (n,), SectionsDesign
    options : BoxCheckOptions
    """

    problem: CoDesignProblem
    theta: Sequence[float]
    design: SectionsDesign
    options: BoxCheckOptions = BoxCheckOptions()

    @property
    def uncertain(self) -> UncertainPlant:
        """The plants of the box at θ."""
        return uncertain_plant(self.problem, self.theta)

    def worst(
        self, turn: int = 0, log: Log = silent, workers: Pool | None = None
    ) -> tuple[Excess, tuple[Scenario, ...]]:
        """The worst plant of the box, and those to add: past a bound, each a new one.

        Where a move's time counts the plant that settles latest besides, if it is later than v.
        """
        problem, theta, design = self.problem, self.theta, self.design
        worst, found = violations(
            problem, self.uncertain, design.kappa, design.bandwidth, turn, log,
            options=self.options, workers=workers,
        )  # fmt: skip
        if problem.figure is MOVE_TIME and design.controller is not None:
            value = float(np.exp(ProblemAt(problem, theta).goal.at(design.kappa)[0]))
            seed = state_of(problem).seed + turn
            time, option, point = latest_plant(problem, theta, design.controller, seed, workers)
            late = f"{1e3 * time:.5g} ms" if np.isfinite(time) else "not settled"
            log(f"{late} on the latest plant, {1e3 * value:.5g} ms counted")
            if time > value:
                found = (*found, (option, tuple(map(float, point))))
        return worst, found

    def worst_elsewhere(
        self, turns: range, workers: Pool, log: Log
    ) -> tuple[Excess, tuple[Scenario, ...]]:
        """The worst plant of several searches, and those to add of the first that finds any; as
        many at a time as there are workers, which share one that is left over."""
        seen: list[Excess] = []
        for first in turns[:: workers.count]:
            own = range(first, min(first + workers.count, turns.stop))
            inside = (silent, workers) if len(own) == 1 else ()
            found = dict(results(workers, self.worst, {turn: (turn, *inside) for turn in own}))
            seen += [worst for worst, _ in found.values()]
            largest = max(seen, key=lambda one: one.value)
            log(f"{of_a_bound(largest.value)} at most, searched from elsewhere")
            added = next((found[turn][1] for turn in own if found[turn][1]), ())
            if added:
                break
        return largest, added

    def lattice_points(self, worst: Excess) -> list[tuple[int, Array]]:
        """The plants of the judge: a lattice of the box, the worst plant and those of the set."""
        structured, uncertain, options = structured_of(self.problem), self.uncertain, self.options
        if not uncertain.names:
            return list(uncertain.corners()[: 1 + len(structured.uncertainty.options)])
        points = lattice(
            uncertain,
            options.lattice,
            state_of(self.problem).seed + options.lattice_seed + options.turn,
        )
        known = [(option, np.array(point)) for option, point in state_of(self.problem).scenarios]
        return [*points, (worst.option, worst.point), *known]

    def on_lattice(self, worst: Excess, workers: Pool | None = None) -> tuple[SetCertificate, int]:
        """The independent judge on `lattice_points`; how many plants it saw.

        The bounds count as met within `looseness`, since the search stops at half of it.
        """
        points, K = self.lattice_points(worst), self.design.controller
        assert K is not None
        require_as_returned(self.problem, self.theta)
        plants, loose = self.uncertain.as_written(points), self.options.looseness
        return _judge(self.problem, plants, K, loose, workers), len(points)

    def counterexamples(
        self, wide: SetCertificate, proof: "Proof", worst: Excess, lost: Sequence[Scenario] = ()
    ) -> tuple[Scenario, ...]:
        """Plants of the box by which judge and proof refute the design, the worst first, then those
        that fresh draws have `lost`.

        A design that was changed by draws makes their statement void: the next `turn` has others.
        """
        if not self.uncertain.names:
            return ()
        bounds, state = bounds_of(self.problem), state_of(self.problem)
        level = (1.0 + self.options.looseness) * (1.0 + JudgeOptions.tolerance)
        found: list[tuple[float, Scenario]] = []
        for one, (option, point) in zip(wide.plants, self.lattice_points(worst), strict=True):
            shares = bounds.shares(one) | bounds.channel_shares(one.channels)
            excess = max(shares.values(), default=np.inf) if one.stable else np.inf
            if not excess <= level:
                found.append((float(excess), (option, tuple(map(float, point)))))
        found.sort(key=lambda pair: -pair[0])
        if proof.refuted:
            found.insert(0, (np.inf, (proof.option, tuple(map(float, proof.point)))))
        known, all_found = state.scenarios, [*(plant for _, plant in found), *lost]
        fresh = dict.fromkeys(plant for plant in all_found if plant not in known)
        return tuple(fresh)[: self.options.added]

    def fresh_yield(self, workers: Pool | None = None) -> tuple[Yield | None, tuple[Scenario, ...]]:
        """Judge plants that are drawn uniformly from the box: how many keep every bound and ω_b,
        and those that do not.

        Options are equally likely. None where there is no box. Every `turn` has draws of its own,
        and each may be wrong: the confidence counts all of them.
        """
        state, uncertain, options = state_of(self.problem), self.uncertain, self.options
        if not uncertain.names or self.design.controller is None:
            return None, ()
        count = options.fresh if plant_of(self.problem).outputs == 1 else options.fresh_of_several
        rng = np.random.default_rng((state.seed, options.fresh_seed + options.turn))
        points = uncertain.drawn(rng, count)
        kept = self.find_kept(points, workers)
        lost = [(option, tuple(map(float, point))) for (option, point), good
                in zip(points, kept, strict=True) if not good]  # fmt: skip
        return Yield(sum(kept), count, 1 + options.turn), tuple(lost)

    def find_kept(
        self, points: Sequence[tuple[int, Array]], workers: Pool | None = None
    ) -> list[bool]:
        """Decide which plants (option, point) keep every bound and ω_b, by the judge, to
        `looseness`."""
        assert self.design.controller is not None
        plants, loose = self.uncertain.as_written(points), self.options.looseness
        found = _judge(self.problem, plants, self.design.controller, loose, workers).plants
        bounds = bounds_of(self.problem).looser(loose)
        least = self.design.bandwidth * (1.0 - loose)
        return [
            one.stable and one.confirmed and one.bandwidth >= least
            and all(
                share <= 1.0 + JudgeOptions.tolerance
                for share in (bounds.shares(one) | bounds.channel_shares(one.channels)).values()
            )
            for one in found
        ]  # fmt: skip

    def proof(self, workers: Pool | None = None, most_boxes: int | None = None) -> "Proof":
        """Branch and bound over the whole box, by `most_boxes` enclosures at most."""
        from ccd_casadi.fixed_structure.box_proof import prove

        design, problem = self.design, self.problem
        return prove(
            self.uncertain, design.structure, design.kappa, design.bandwidth, bounds_of(problem),
            problem.sampling, workers=workers, most_boxes=most_boxes,
        )  # fmt: skip

    def judge(self, worst: Excess, workers: Pool) -> "tuple[SetCertificate, int, Proof]":
        """On a lattice and by proof, one after the other, each spread over the workers; at one time
        by those of a cluster, unless there are several options."""
        if isinstance(workers, Workers) or structured_of(self.problem).uncertainty.options:
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
        for option, point in state_of(problem).scenarios or uncertain.corners():
            further = (np.array(point) - uncertain.nominal)[:, None, None]
            plants.append(uncertain.with_slopes(np.array(point), option).with_slopes_times(further))
        found = bandwidth_envelope(plants, bounds_of(problem), self.design, problem.sampling)
        gradient = [] if found is None else found.gradient.tolist()
        return dict(zip(uncertain.names, gradient, strict=False))


def violations(
    problem: CoDesignProblem,
    uncertain: UncertainPlant,
    kappa: Array,
    bandwidth: float,
    turn: int,
    log: Log | None = None,
    within: float = WorstPlantOptions.within,
    others: Sequence[Scenario] = (),
    count: int = WorstPlantOptions.lattice,
    options: BoxCheckOptions = BoxCheckOptions(),
    workers: Pool | None = None,
) -> tuple[Excess, tuple[Scenario, ...]]:
    """Search the worst plant of a box for a controller.

    Parameters
    ----------
    problem, uncertain : CoDesignProblem, UncertainPlant
    kappa, bandwidth : array (n,), float
        κ in SI; ω_b in rad/s.
    turn, count : int
        Added to the problem's seed; plants of the lattice.
    log : callable, optional
        Is given a line.
    within : float
        ln of a bound, above which a plant violates it.
    others : sequence of (option, point)
        Known plants, which are tried besides.
    options, workers : BoxCheckOptions, Pool

    Returns
    -------
    worst : Excess
    found : tuple of (option, point)
        New plants that violate a bound, `options.added` at most.
    """
    structured = structured_of(problem)
    loop = LoopOnBox(uncertain, structure_of(problem), kappa, bandwidth, bounds_of(problem),
                     structured.sampling)  # fmt: skip
    known = [(option, np.array(point)) for option, point in others]
    tried = loop.excesses(known).tolist() if known else []
    lines, width = WorstPlantOptions(), uncertain.box[1] - uncertain.box[0]
    before = [Excess(*one, value) for one, value in zip(known, tried, strict=True)]

    def fresh(heads: Sequence[Excess]) -> tuple[Scenario, ...]:
        found: list[Scenario] = []
        for head in heads:
            near = [
                float(np.abs((head.point - np.array(point)) / width).max(initial=0.0))
                for option, point in (*state_of(problem).scenarios, *found)
                if option == head.option
            ]
            apart = not near or min(near) > options.apart
            if head.value > within and apart and len(found) < options.added:
                found.append((head.option, tuple(map(float, head.point))))
        return tuple(found)

    examined = 0
    for along in (lines.along_first, lines.along) if uncertain.ranges else (lines.along,):
        seed = state_of(problem).seed + turn
        heads, more = worst_plants(loop, seed, count, workers=workers, along=along)
        heads, examined = sorted([*before, *heads], key=lambda head: -head.value), examined + more
        worse = fresh(heads)
        if worse:
            break
    if log is not None:
        log(f"{of_a_bound(heads[0].value)} at most on {examined} plants tried of the set")
    return heads[0], worse


def recertify(
    problem: CoDesignProblem, theta: Sequence[float], design: SectionsDesign
) -> SectionsDesign:
    """Judge a design again on the problem's plants, which may be newer than a stored design.

    Parameters
    ----------
    problem, theta, design : CoDesignProblem, sequence of float, SectionsDesign

    Returns
    -------
    SectionsDesign
        With the new certificate; not certified where that fails.
    """
    if design.controller is None:
        return design
    judged = certify(
        plants_of(problem, theta), design.controller, bounds_of(problem), problem.sampling,
        integrator=structure_of(problem).integrates(bounds_of(problem).error),
    )  # fmt: skip
    again = replace(design, certificate=judged)
    least = design.bandwidth * (1.0 - StructuredValueOptions.rounding)
    if judged.passed and judged.bandwidth >= least:
        return again
    words = f"judged anew, {judged.bandwidth / HZ:.6g} Hz: {judged.words}"
    outcome = SectionsOutcome.NOT_CERTIFIED if design.certified else design.outcome
    return replace(again, outcome=outcome, words=words)


def certify_corners(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace,
    points: Sequence[tuple[int, Array]] = (),
) -> SetCertificate:  # fmt: skip
    """Judge a controller on the model of every option and on the corners of the box.

    Parameters
    ----------
    problem, theta, controller : CoDesignProblem, sequence of float, StateSpace
        K(s) in SI.
    points : sequence of (option, point)
        The plants of the box that are judged in their place.

    Returns
    -------
    SetCertificate
    """
    uncertain = uncertain_plant(problem, theta)
    plants = uncertain.as_written(points or uncertain.corners())
    return _judge(problem, plants, controller, BoxCheckOptions.looseness)


def _judge(
    problem: CoDesignProblem,
    plants: Sequence[StateSpace],
    controller: StateSpace,
    loose: float,
    workers: Pool | None = None,
) -> SetCertificate:
    return certify(
        plants, controller, bounds_of(problem).looser(loose), problem.sampling,
        integrator=structure_of(problem).integrates(bounds_of(problem).error), workers=workers,
    )  # fmt: skip
