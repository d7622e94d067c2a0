"""Where searches start when there are more actuators than sensors.

Channels that share a sensor cannot be designed one by one: each alone would take the whole
bandwidth. A start is a random controller for each, with a crossover |G_i K_i| = 1 of its own, of
which those are kept that together hold every plant stable. Where a channel's plant is on its
stiffness line at the crossover (a piezo) its lead is turned around into a lag.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.decoupling import channel_plant
from ccd_casadi.fixed_structure.loop import closed_loops, plant_set, stable
from ccd_casadi.fixed_structure.loop_problem import LoopProblem, Problem
from ccd_casadi.fixed_structure.starts import at_random, with_crossover
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

CROSSOVERS = (0.01, 1.0)  # over ω₀
DRAWS = 40  # for each start that is asked for
STIFFNESS_LINE = -1.0  # d ln|G|/d ln ω above which the stiffness holds what is moved


def actuator_starts(
    problem: LoopProblem,
    structure: ChannelStructure,
    plants: Sequence[ScaledPlant],
    sampling: Sampling | None,
    count: int,
    rng: np.random.Generator,
) -> list[Array]:
    """Up to `count` controllers κ of the whole that are stable on all plants, in their units."""
    draws = DRAWS * count
    parts = []
    for i, own in enumerate(structure.structures):
        family = plant_set([channel_plant(plants[0], structure.decoupling, i)], sampling)
        single = Problem(family, own, problem.bounds, problem.box[:, structure.slices[i]])
        crossovers = np.exp(rng.uniform(np.log(CROSSOVERS[0]), np.log(CROSSOVERS[1]), draws))
        kappa = at_random(single, crossovers, rng)
        v = family.variable(crossovers)
        G, slope = family.responses(np.zeros(draws, int), v)
        lag = (slope / G)[:, 0, 0].real > STIFFNESS_LINE
        for j in range(1, own.lead + 1):
            pair = [own.names.index(f"lead {j} {root}") for root in ("zero", "pole")]
            kappa[np.ix_(lag, pair)] = kappa[np.ix_(lag, pair[::-1])]
        parts.append(with_crossover(single, kappa, crossovers))
    first = plant_set(plants[:1], sampling, structure.decoupling)
    every = plant_set(plants, sampling, structure.decoupling)
    found: list[Array] = []
    for kappa in np.hstack(parts):
        for family in (first, every):
            if not stable(closed_loops(family, structure, kappa)).all():
                break
        else:
            found.append(kappa)
        if len(found) == count:
            break
    return found
