"""J over θ, the controller and ω_b at once, on the plants of a set that hold it."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import in_units_of
from ccd_casadi.fixed_structure.composite import on_plants
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.figures import HessianOptions, assess, hessians, to_theta
from ccd_casadi.fixed_structure.local_search import Point, all_rows, ascend
from ccd_casadi.fixed_structure.loop_problem import Assessment, LoopProblem
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import WorstPlantOptions
from ccd_casadi.inner_problem.objective import hardware_at
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    structure_of,
    structured_of,
    uncertain_plant,
    with_structured,
)
from ccd_casadi.inner_problem.structured_problem import Scenario
from ccd_casadi.inner_problem.structured_robustness import violations
from ccd_casadi.optim.trust_region import Iterate, Radius, Rows, TrustRegionModel, minimise
from ccd_casadi.plants.plant import Evaluate, Mechanics, hardware_cost, to_first_order
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array

# A few times the sum of multipliers: less, and a violation of second order counts less.
PENALTY = 6.0
STEPS, ADAPTING = 60, 15  # of a search, and of the controller alone at its end
FIRST, WIDEST, NARROWEST = 0.05, 0.5, 1e-7  # radii of κ and z
LEAST_GAIN = 1e-7  # of w2 ω_b
LAST, FADED = 12, 0.15  # trials that gain less of all that was gained: made anew, plants tell more
SETTLED = 3e-4  # of J: less is not worth another set of plants
INSIDE = 1e-8  # of λ's size: what rounding leaves of an elastic row must not break it
FLAT = 1e-3  # slope of λ per box, over its size: less is none
FAR = 3.0  # radii of κ and τ by which a row may lie below its bound and still be looked at


@dataclass(frozen=True)
class JointPoint:
    """θ, κ (SI) and ω_b in rad/s, which may exceed the bounds a little."""

    theta: tuple[float, ...]
    kappa: tuple[float, ...]
    bandwidth: float


@dataclass(frozen=True)
class Proposal:
    """The end of a search and by how much J falls there, on the plants as models know them."""

    end: JointPoint
    gain: float


def proposed(
    problem: CoDesignProblem,
    models: Sequence[Evaluate],
    at: JointPoint,
    reach: float,
    least_gain: float = LEAST_GAIN,
    bent: bool = False,
) -> Proposal:
    """The end of one search around a place, on the plants of these models; see `JointModel`."""
    model = JointModel(problem, models, at, reach)
    model.bent = bent
    start = model.at(model.start)
    if start is None:
        return Proposal(at, 0.0)
    if least_gain == LEAST_GAIN:
        model.enough = SETTLED * abs(start.value)
    n, radius = len(start.x), Radius(min(FIRST, reach), NARROWEST, WIDEST)
    end = minimise(
        model, start, np.zeros((n, n)), radius, steps=STEPS, penalty=PENALTY, least_gain=least_gain
    ).best
    gain = start.value - end.value + PENALTY * (start.violation - end.violation)
    return Proposal(model.place(end.x), model.unit * float(gain))


class JointModel(TrustRegionModel[tuple[LoopProblem, Assessment]]):
    """J over its `unit`, w2 ω_b in the middle, around a place; over x = (z, κ, τ), with the loops
    at x. With `bent` the plants' own curvature counts: not far from an optimum, as a model may jump
    where a mode that it keeps meets another."""

    corrected = bending = True
    programmes, little = 60, 1e-3  # that cost little beside a trial
    bent = False
    enough = np.inf  # of what is minimised: with less gained no search ends before its optimum

    def __init__(
        self, problem: CoDesignProblem, models: Sequence[Evaluate], place: JointPoint, reach: float
    ) -> None:
        self.problem, self.models, self.middle = problem, models, np.array(place.theta)
        structured = structured_of(problem)
        known = [(option, np.array(point)) for option, point in structured.scenarios]
        lower, upper = box(problem)
        self.lower, self.width = lower, upper - lower
        middle = (self.middle - lower) / self.width
        uncertain = self.uncertain(middle, self.known(middle))
        self.scenarios = known or uncertain.corners()
        self.first = uncertain.plants(self.scenarios[:1])[0]
        self.unit = -problem.w2 * place.bandwidth
        loops = self.first_loops = self.loops(middle)
        # λ in units in which the penalty exceeds what breaking it saves of the hardware.
        own = hardware_at(problem, self.middle)
        saved = np.abs(own.cost_gradient).max(initial=0.0) / self.unit
        steep = np.maximum(np.abs(own.slopes).max(axis=1, initial=0.0), FLAT)
        self.weight = np.maximum(1.0, 2.0 * saved / (PENALTY * steep))
        self.merits: list[float] = []  # before every trial
        # A step that fails is followed by one from the same place.
        self.loops_beside = lru_cache(1)(self._loops_beside)
        self.all_rows = lru_cache(2)(
            lambda here: all_rows(here.data[0], *self.parts(here.x)[1:], here.data[1])
        )
        self.tau = float(np.log(place.bandwidth / loops.plants.omega_0))
        kappa = np.clip(in_problem_units(loops, np.array(place.kappa)), *loops.box)
        self.start = np.concatenate([middle, kappa, [self.tau]])
        low, high = np.maximum(middle - reach, 0.0), np.minimum(middle + reach, 1.0)
        self.low = np.concatenate([low, loops.box[0], [-np.inf]])
        self.high = np.concatenate([high, loops.box[1], [np.inf]])

    def place(self, x: Array) -> JointPoint:
        """That of x."""
        z, kappa, tau = self.parts(x)
        loops = self.first_loops
        kappa = loops.structure.in_units(kappa, loops.plants.omega_0, loops.plants.force)
        theta = np.clip(self.theta(z), *box(self.problem))
        omega_b = float(np.exp(tau) * loops.plants.omega_0)
        return JointPoint(tuple(map(float, theta)), tuple(map(float, kappa)), omega_b)

    def adapted(self, steps: int = ADAPTING) -> tuple[JointPoint, float]:
        """The middle after a few steps of the controller alone, and J there with what is left of a
        violation; infinite where a loop is unstable."""
        z, kappa, tau = self.parts(self.start)
        found = assess(self.first_loops, kappa, tau)
        if not found.stable:
            return self.place(self.start), np.inf
        point = ascend(self.first_loops, Point(kappa, tau, found), iterations=steps,
                       radius=FIRST).point  # fmt: skip
        x = np.concatenate([z, point.kappa, [point.tau]])
        unmet = hardware_at(self.problem, self.middle).constraints * self.weight
        worth = np.exp(point.tau - self.tau)
        worth -= PENALTY * max(point.assessment.violation, float(unmet.max(initial=0.0)))
        cost = self.problem.w1 * hardware_cost(plant_of(self.problem), self.middle)
        return self.place(x), float(cost - self.unit * worth)

    def theta(self, z: Array) -> Array:
        """θ of its shares."""
        return np.asarray(self.lower + self.width * z)

    def parts(self, x: Array) -> tuple[Array, Array, float]:
        """z, κ and τ."""
        count = len(self.middle)
        return x[:count], x[count:-1], float(x[-1])

    def known(self, z: Array) -> list[Mechanics]:
        """The plant and its options at z, as the models know them."""
        return [model(tuple(self.theta(z).tolist())) for model in self.models]

    def uncertain(self, z: Array, known: Sequence[Mechanics]) -> UncertainPlant:
        """The plant at z."""
        return uncertain_plant(self.problem, tuple(self.theta(z).tolist()), known)

    def plants(self, z: Array, known: Sequence[Mechanics]) -> list[ScaledPlant]:
        """Those of the set there, in the units of its first one in the middle."""
        share = self.width[:, None, None]
        return [
            in_units_of(replace(one, dA=share * one.dA, dB=share * one.dB, dC=share * one.dC),
                        self.first)
            for one in self.uncertain(z, known).plants(self.scenarios)
        ]  # fmt: skip

    def loops(self, z: Array) -> LoopProblem:
        """Those with these plants."""
        structured = structured_of(self.problem)
        return problem_for(
            self.plants(z, self.known(z)), structure_of(self.problem), bounds_of(self.problem),
            structured.sampling, structured.frequencies,
        )  # fmt: skip

    def _loops_beside(self, here: Iterate[tuple[LoopProblem, Assessment]]) -> list[LoopProblem]:
        z, sampling = self.parts(here.x)[0], structured_of(self.problem).sampling
        known, found = self.known(z), []
        for step in HessianOptions.parameter_step * np.eye(len(z)):
            moved = (
                self.known(z + step)
                if self.bent
                else [to_first_order(one, self.width * step) for one in known]
            )
            found.append(on_plants(here.data[0], self.plants(z + step, moved), sampling))
        return found

    def at(self, x: Array) -> Iterate[tuple[LoopProblem, Assessment]] | None:
        """With every loop stable, and masses that are positive to first order."""
        x = np.clip(x, self.low, self.high)
        z, kappa, tau = self.parts(x)
        try:
            problem = self.loops(z)
        except np.linalg.LinAlgError:  # placed masses move so far that M + ∂M Δθ is indefinite
            return None
        found = assess(problem, kappa, tau)
        if not found.stable:
            return None
        own, worth = hardware_at(self.problem, self.theta(z)), float(np.exp(tau - self.tau))
        cost = self.problem.w1 * hardware_cost(plant_of(self.problem), self.theta(z))
        slope = np.concatenate([own.cost_gradient / self.unit, np.zeros(len(kappa)), [-worth]])
        unmet = (own.constraints + INSIDE) * self.weight
        violation = max(found.violation, float(unmet.max(initial=0.0)))
        return Iterate(x, cost / self.unit - worth, slope, violation, (problem, found))

    def ended(self, here: Iterate[tuple[LoopProblem, Assessment]], there: Iterate[Any]) -> bool:
        """Where the last trials gain little of what all have."""
        self.merits.append(here.value + PENALTY * here.violation)
        gained = self.merits[0] - self.merits[-1]
        late = self.merits[-LAST:][0] - self.merits[-1]
        return len(self.merits) > LAST and gained > self.enough and late < FADED * gained

    def rows(self, here: Iterate[tuple[LoopProblem, Assessment]], radius: float) -> Rows:
        """Peaks, the grid near them, and λ."""
        z, kappa, tau = self.parts(here.x)
        problem, assessment = here.data
        assert assessment.peaks is not None
        found, count, peaks = self.all_rows(here), len(z), len(assessment.peaks.v)
        steep = np.abs(found.to_kappa).sum(1) + np.abs(found.to_tau)
        kept = np.flatnonzero(found.value + FAR * radius * np.maximum(steep, 1.0) > 0.0)
        found = found.only(kept)
        slopes = np.column_stack([to_theta(problem, kappa, found), found.to_kappa, found.to_tau])
        own = hardware_at(self.problem, self.theta(z))
        unmet = (own.constraints + INSIDE) * self.weight
        of_z = np.pad(self.weight[:, None] * own.slopes, ((0, 0), (0, len(here.x) - count)))

        def second(index: np.ndarray) -> Array:
            chosen = found.only(index)
            try:
                beside = self.loops_beside(here)
            except np.linalg.LinAlgError:  # as in `at`: no curvature is known at the edge
                return np.zeros((len(chosen.value), len(here.x), len(here.x)))
            return hessians(problem, kappa, tau, chosen, beside)

        return Rows(
            np.concatenate([found.value, unmet]), np.vstack([slopes, of_z]),
            hessians=second, curved=int((kept < peaks).sum()),
        )  # fmt: skip


MANY = 12  # plants up to which all stay
NEAR = 0.1  # ln: below its bound, where a row counts, and between frequencies of one peak
EQUAL = 1e-6  # ln: rows that differ by rounding, as of rigid bodies alike


@dataclass(frozen=True)
class WorkingSet:
    """The sampler of the problem with the plants that count, those that are aside, and those that
    came back from there: they stay."""

    sampler: Sampler
    aside: tuple[Scenario, ...] = ()
    back: frozenset[Scenario] = frozenset()

    @property
    def whole(self) -> "WorkingSet":
        """With those aside too: at an end plants that bind in turns would bring each other back."""
        return WorkingSet(with_scenarios(self.sampler, self.aside)) if self.aside else self

    def reduced(self, models: Sequence[Evaluate], at: JointPoint) -> "WorkingSet":
        """Without the plants that do not hold the controller there."""
        problem = self.sampler.problem
        scenarios = structured_of(problem).scenarios
        if len(scenarios) <= MANY:
            return self
        model = JointModel(problem, models, at, 0.0)
        here = model.at(model.start)
        if here is None:
            return self
        loops, peaks = here.data[0], here.data[1].peaks
        assert peaks is not None
        near = np.flatnonzero(peaks.value > -NEAR)
        rows = peaks.only(near[np.argsort(-peaks.value[near], kind="stable")])
        gains = np.column_stack([rows.curve, loops.gains_of(rows)]).tolist()
        kept = holding(loops.plants_of(rows), list(map(tuple, gains)), np.log(rows.v), rows.value)
        kept |= {number for number, one in enumerate(scenarios) if one in self.back}
        counted = tuple(one for number, one in enumerate(scenarios) if number in kept)
        aside = (one for number, one in enumerate(scenarios) if number not in kept)
        changed = with_structured(problem, scenarios=counted)
        return WorkingSet(self.sampler.of(changed), (*self.aside, *aside), self.back)

    def on_worse_plants(
        self,
        models: Sequence[Evaluate],
        best: JointPoint,
        looks: Sequence[int],
        within: float,
        tell: Callable[[str], None] | None,
        count: int = WorstPlantOptions.lattice,
    ) -> tuple["WorkingSet", JointPoint, float]:
        """With the plants on which the controller exceeds a bound, the controller adapted to them,
        and J there; `looks`: the searches for worse plants, one after the other, each elsewhere in
        the box, from a lattice of `count`."""
        sampler, aside, back, J = self.sampler, self.aside, self.back, np.inf
        for look in looks:
            problem, known = sampler.problem, [model(best.theta) for model in models]
            uncertain, kappa = uncertain_plant(problem, best.theta, known), np.array(best.kappa)
            scenarios = violations(
                problem, uncertain, kappa, best.bandwidth, look, tell, within, aside, count
            )[1]
            if scenarios:
                sampler = with_scenarios(sampler, scenarios)
                back |= set(aside) & set(scenarios)
                aside = tuple(one for one in aside if one not in scenarios)
            best, J = JointModel(sampler.problem, models, best, 0.0).adapted()
            if not np.isfinite(J):
                break
        working = self if sampler is self.sampler else WorkingSet(sampler, aside, back)
        return working, best, J


def with_scenarios(sampler: Sampler, scenarios: Sequence[Scenario]) -> Sampler:
    """The sampler of the problem with more plants: on these what was found before is worth
    nothing."""
    trace = sampler.trace
    trace[:] = [replace(item, bandwidth=np.nan, objective=np.nan) for item in trace]
    known = structured_of(sampler.problem).scenarios
    return sampler.of(with_structured(sampler.problem, scenarios=(*known, *scenarios)))


def holding(
    plants: np.ndarray, gains: Sequence[tuple[int, ...]], log_v: Array, value: Array
) -> set[int]:
    """Plants of rows, the largest first, without those whose every row lies below one of a plant
    before it: of one gain, within `NEAR` in ln of frequency."""
    kept, seen = set[int](), defaultdict[tuple[int, ...], list[int]](list)
    of = [np.flatnonzero(plants == plant) for plant in range(plants.max(initial=-1) + 1)]
    for row, (plant, gain) in enumerate(zip(plants.tolist(), gains, strict=True)):
        above = [i for i in seen[gain] if value[i] >= value[row] - EQUAL]
        if plant in kept or (np.abs(log_v[above] - log_v[row]) < NEAR).any():
            continue
        kept.add(plant)
        for i in of[plant].tolist():
            seen[gains[i]].append(i)
    return kept
