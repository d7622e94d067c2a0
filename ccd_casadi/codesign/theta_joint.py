"""The best θ and controller in one search, where it is the plants that cost: finite elements, say.

At the best θ so far the matrices of every plant of the set are known with their slopes. On plants
of first order, M + ∂M Δθ and so forth, within a reach of |Δz| (z is θ in shares of its box),

    min w1 f(z) + w2 e^τ ω₀,   c(κ, τ; z) <= 0,  λ(z) <= 0      over z, κ and τ = ln ω_b/ω₀

is one search by `optim.trust_region`: the rows are those of `local_search`, with slopes to z. At
its end the plants are made anew, the controller climbs on these, and the true J tells how far the
first order may reach. Where no more is promised the conditions of optimality hold for the true
plants too, as values and slopes are exact in the middle.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ccd_casadi.fixed_structure.decoupling import in_units_of
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import BESIDE, assess, hessians, to_theta
from ccd_casadi.fixed_structure.local_search import PENALTY, all_rows
from ccd_casadi.fixed_structure.loop_problem import Assessment, LoopProblem
from ccd_casadi.fixed_structure.sections_design import in_problem_units
from ccd_casadi.inner_problem.objective import hardware_at, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.sections_plant_set import (
    bounds_of,
    sections_of_problem,
    structure_of,
    uncertain_plant,
    with_sections,
)
from ccd_casadi.optim.trust_region import Iterate, Model, Radius, Rows, minimise
from ccd_casadi.plants.plant import hardware_cost, to_first_order
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

REACH, LARGEST, LEAST = 0.1, 0.3, 1e-4  # of the box of θ, in which the first order counts
GOOD, POOR = 0.7, 0.3  # of the promised gain: the reach grows, or shrinks
CYCLES = 6  # times at most that the plants are made anew before worse ones are looked for
STEPS = 40  # of a search
FIRST, WIDEST, NARROWEST = 0.05, 0.5, 1e-7  # radii of κ and z
LEAST_GAIN = 1e-6  # of w2 ω_b
SETTLED = 1e-5  # of J: less is not worth another set of plants
INSIDE = 1e-8  # of λ's size: what rounding leaves of an elastic row must not break it
FAR = 3.0  # radii of κ and τ by which a row may lie below its bound and still be looked at


@dataclass(frozen=True)
class Proposal:
    """θ, κ (SI) and by how much J falls there, on the plants to first order."""

    theta: tuple[float, ...]
    kappa: tuple[float, ...]
    gain: float


def together(sampler: Sampler, theta: Array) -> tuple[Sampler, BandwidthSample, bool]:
    """From θ towards where the joint search promises no more: the sampler of the problem whose
    anchor is the controller there, its true sample, and whether no more is promised."""
    best = sampler.bandwidths(theta, "polishing")[0]
    J, reach = objective_of(sampler.problem, best), REACH
    for _ in range(CYCLES):
        if not np.isfinite(J) or reach < LEAST:
            return sampler, best, True
        make = partial(proposed, sampler.problem, best, reach)
        found = sampler.kept("together", (*best.theta, reach), Proposal, make)
        if found.gain <= SETTLED * abs(J):
            return sampler, best, True
        other = sampler.of(with_sections(sampler.problem, anchors=(found.kappa,)))
        sample = other.bandwidths(np.array(found.theta), "polishing")[0]
        gained = J - objective_of(other.problem, sample)
        if gained > 0.0:
            sampler, best, J = other, sample, J - gained
        if gained > GOOD * found.gain:
            reach = min(2.0 * reach, LARGEST)
        elif gained < POOR * found.gain:
            reach *= 0.3
    return sampler, best, False


def proposed(problem: CoDesignProblem, sample: BandwidthSample, reach: float) -> Proposal:
    """The end of one search around a sample of the problem."""
    model = JointModel(problem, sample, reach)
    start = model.at(model.start)
    if start is None:
        return Proposal(sample.theta, sample.kappa, 0.0)
    n, radius = len(start.x), Radius(min(FIRST, reach), NARROWEST, WIDEST)
    end = minimise(
        model, start, np.zeros((n, n)), radius, steps=STEPS, penalty=PENALTY, least_gain=LEAST_GAIN
    ).best
    gain = model.unit * (start.value - end.value - PENALTY * end.violation)
    z, kappa, _ = model.parts(end.x)
    loops = end.data[0]
    found = loops.structure.in_units(kappa, loops.plants.omega_0, loops.plants.force)
    theta = np.clip(model.theta(z), *box(problem))
    return Proposal(tuple(map(float, theta)), tuple(map(float, found)), float(gain))


class JointModel(Model[tuple[LoopProblem, Assessment]]):
    """J over its `unit`, w2 ω_b in the middle, on the plants to first order around a sample; over
    x = (z, κ, τ), with the loops at x."""

    corrected = True

    def __init__(self, problem: CoDesignProblem, sample: BandwidthSample, reach: float) -> None:
        self.problem, self.middle = problem, np.array(sample.theta)
        sections = sections_of_problem(problem)
        self.uncertain = uncertain_plant(problem, sample.theta)
        known = [(option, np.array(point)) for option, point in sections.members]
        self.members = known or self.uncertain.corners()
        self.first = self.uncertain.plants(self.members[:1])[0]
        lower, upper = box(problem)
        self.lower, self.width = lower, upper - lower
        self.unit = -problem.w2 * sample.bandwidth
        middle = (self.middle - lower) / self.width
        loops = self.loops(middle)
        self.tau = float(np.log(sample.bandwidth / loops.plants.omega_0))
        kappa = np.clip(in_problem_units(loops, np.array(sample.kappa)), *loops.box)
        self.start = np.concatenate([middle, kappa, [self.tau]])
        low, high = np.maximum(middle - reach, 0.0), np.minimum(middle + reach, 1.0)
        self.low = np.concatenate([low, loops.box[0], [-np.inf]])
        self.high = np.concatenate([high, loops.box[1], [np.inf]])

    def theta(self, z: Array) -> Array:
        """θ of its shares."""
        return np.asarray(self.lower + self.width * z)

    def parts(self, x: Array) -> tuple[Array, Array, float]:
        """z, κ and τ."""
        count = len(self.middle)
        return x[:count], x[count:-1], float(x[-1])

    def loops(self, z: Array) -> LoopProblem:
        """Those of the set at z, in the units of its first plant in the middle."""
        step, share = self.theta(z) - self.middle, self.width[:, None, None]
        options = tuple(to_first_order(option, step) for option in self.uncertain.options)
        plants = [
            replace(plant, dA=share * plant.dA, dB=share * plant.dB, dC=share * plant.dC)
            for plant in replace(self.uncertain, options=options).plants(self.members)
        ]
        sections = sections_of_problem(self.problem)
        return problem_for(
            [in_units_of(plant, self.first) for plant in plants], structure_of(self.problem),
            bounds_of(self.problem), sections.sampling, sections.frequencies,
        )  # fmt: skip

    def at(self, x: Array) -> Iterate[tuple[LoopProblem, Assessment]] | None:
        """With every loop stable."""
        x = np.clip(x, self.low, self.high)
        z, kappa, tau = self.parts(x)
        problem = self.loops(z)
        found = assess(problem, kappa, tau)
        if not found.stable:
            return None
        own, worth = hardware_at(self.problem, self.theta(z)), float(np.exp(tau - self.tau))
        cost = self.problem.w1 * hardware_cost(plant_of(self.problem), self.theta(z))
        slope = np.concatenate([own.cost_gradient / self.unit, np.zeros(len(kappa)), [-worth]])
        violation = max(found.violation, float((own.constraints + INSIDE).max(initial=0.0)))
        return Iterate(x, cost / self.unit - worth, slope, violation, (problem, found))

    def rows(self, here: Iterate[tuple[LoopProblem, Assessment]], radius: float) -> Rows:
        """Peaks, the grid near them, and λ."""
        z, kappa, tau = self.parts(here.x)
        problem, assessment = here.data
        assert assessment.peaks is not None
        found, count, peaks = all_rows(assessment), len(z), len(assessment.peaks.v)
        steep = np.abs(found.to_kappa).sum(1) + np.abs(found.to_tau)
        kept = np.flatnonzero(found.value + FAR * radius * np.maximum(steep, 1.0) > 0.0)
        found = found.only(kept)
        slopes = np.column_stack([to_theta(problem, kappa, found), found.to_kappa, found.to_tau])
        own = hardware_at(self.problem, self.theta(z))
        of_z = np.pad(own.slopes, ((0, 0), (0, len(here.x) - count)))

        def second(index: np.ndarray) -> Array:
            beside = [self.loops(z + BESIDE * unit) for unit in np.eye(count)]
            return hessians(problem, kappa, tau, found.only(index), beside)

        return Rows(
            np.concatenate([found.value, own.constraints + INSIDE]), np.vstack([slopes, of_z]),
            hessians=second, curved=int((kept < peaks).sum()),
        )  # fmt: skip
