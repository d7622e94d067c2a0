"""The best θ and controller in one search, where it is the plants that cost: finite elements, say.

At the best θ so far the matrices of every plant of the set are known with their slopes. On the
plants

    M + ∂M Δθ,  D + ∂D Δθ,  ... ,      |Δz| <= reach,  z in shares of the box,

one search makes J small over θ, κ and ω_b (`joint_search`). At its end the plants are made anew,
the controller climbs on these, and the true J tells how far the first order may reach. Where no
more is promised the conditions of optimality hold for the true plants too, as values and slopes
are exact at the middle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.decoupling import in_units_of
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.joint_search import Goal, JointModel
from ccd_casadi.fixed_structure.loop_problem import LoopProblem
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
from ccd_casadi.optim.trust_region import Radius, minimise
from ccd_casadi.plants.plant import hardware_cost, to_first_order
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

REACH, LARGEST, LEAST = 0.1, 0.3, 1e-4  # of the box of θ, in which the first order counts
GOOD, POOR = 0.7, 0.3  # of the promised gain: the reach grows, or shrinks
CYCLES = 20  # sets of plants at most
STEPS = 60  # of a search
FIRST, LARGEST_STEP = 0.05, 0.5  # radii of κ and z
LEAST_RADIUS, LEAST_GAIN = 1e-7, 1e-6
PENALTY = 20.0  # as in `local_search`
SETTLED = 1e-5  # of J: less is not worth another set of plants


@dataclass(frozen=True)
class Proposal:
    """θ, κ (SI) and by how much J falls there, on the plants to first order."""

    theta: tuple[float, ...]
    kappa: tuple[float, ...]
    gain: float


def together(sampler: Sampler, theta: Array) -> tuple[Sampler, BandwidthSample]:
    """From θ to where the joint search promises no more: the sampler of the problem whose anchor
    is the controller there, and its true sample."""
    best = sampler.bandwidths(theta, "polishing")[0]
    J, reach = objective_of(sampler.problem, best), REACH
    for _ in range(CYCLES):
        if not np.isfinite(J) or reach < LEAST:
            break
        found = sampler.kept(
            "together", (*best.theta, reach), Proposal,
            lambda: proposed(sampler.problem, best, reach),  # noqa: B023
        )  # fmt: skip
        if found.gain <= SETTLED * abs(J):
            break
        other = sampler.of(with_sections(sampler.problem, anchors=(found.kappa,)))
        sample = other.bandwidths(np.array(found.theta), "polishing")[0]
        gained = J - objective_of(other.problem, sample)
        if gained > 0.0:
            sampler, best, J = other, sample, J - gained
        if gained > GOOD * found.gain:
            reach = min(2.0 * reach, LARGEST)
        elif gained < POOR * found.gain:
            reach *= 0.3
    return sampler, best


def proposed(problem: CoDesignProblem, sample: BandwidthSample, reach: float) -> Proposal:
    """The end of one search around a sample of the problem."""
    lower, upper = box(problem)
    width = upper - lower
    middle = (np.array(sample.theta) - lower) / width
    low, high = np.maximum(middle - reach, 0.0), np.minimum(middle + reach, 1.0)
    family = family_of(problem, sample.theta)
    loops = family(middle)
    kappa = np.clip(in_problem_units(loops, np.array(sample.kappa)), *loops.box)
    tau = float(np.log(sample.bandwidth / loops.plants.omega_0))

    def cost(z: Array) -> tuple[float, Array]:
        theta = lower + width * z
        slope = hardware_at(problem, theta).cost_gradient
        return problem.w1 * hardware_cost(plant_of(problem), theta), slope

    def constraints(z: Array) -> tuple[Array, Array]:
        found = hardware_at(problem, lower + width * z)
        return found.constraints, found.slopes

    worth = -problem.w2 * sample.bandwidth
    model = JointModel(family, Goal(cost, constraints, worth, tau), low, high)
    start = model.at(np.concatenate([middle, kappa, [tau]]))
    if start is None:
        return Proposal(sample.theta, sample.kappa, 0.0)
    n = len(start.x)
    end = minimise(
        model, start, np.zeros((n, n)), Radius(min(FIRST, reach), LEAST_RADIUS, LARGEST_STEP),
        steps=STEPS, penalty=PENALTY, least_gain=LEAST_GAIN,
    ).best  # fmt: skip
    P = loops.plants
    found = loops.structure.in_units(end.x[len(middle) : -1], P.omega_0, P.force)
    theta = np.clip(lower + width * end.x[: len(middle)], lower, upper)
    gain = worth * (start.value - end.value - PENALTY * end.violation)
    return Proposal(tuple(map(float, theta)), tuple(map(float, found)), float(gain))


def family_of(problem: CoDesignProblem, theta: Sequence[float]) -> Callable[[Array], LoopProblem]:
    """The loops of the problem's plant set at z, in the units of the first plant at θ."""
    lower, upper = box(problem)
    width, middle = upper - lower, np.array(theta)
    sections, structure, bounds = (
        sections_of_problem(problem),
        structure_of(problem),
        bounds_of(problem),
    )
    uncertain = uncertain_plant(problem, theta)
    members = [(option, np.array(point)) for option, point in sections.members]
    members = members or uncertain.corners()
    first = uncertain.plant(members[0][1], members[0][0])
    share = width[:, None, None]

    def family(z: Array) -> LoopProblem:
        step = lower + width * z - middle
        moved = tuple(to_first_order(option, step) for option in uncertain.options)
        plants = [
            replace(plant, dA=share * plant.dA, dB=share * plant.dB, dC=share * plant.dC)
            for plant in replace(uncertain, options=moved).plants(members)
        ]
        return problem_for([in_units_of(plant, first) for plant in plants], structure, bounds,
                           sections.sampling, sections.frequencies)  # fmt: skip

    return family
