"""Anchors of a fixed structure as starts at another θ."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure import Bounds, ChannelStructure, Structure
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.race import started
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array


def warm_starts(
    problem: CoDesignProblem,
    structure: Structure | ChannelStructure,
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
) -> list[Array]:
    """Each anchor as it is or moved with the plant from the start θ, whichever is nearer; κ in SI.

    Moved: frequencies with the first flexible mode, the gain as 1/|G| at the frequency that the
    crossover moves with; a notch stays on its resonance.
    """
    sections = problem.sections
    if sections is None or not sections.anchors:
        return []
    first = scaled_plant(problem, problem.start)
    here = plants[0]
    frequency = _first_mode(here) / _first_mode(first)
    found = problem_for(plants, structure, bounds, sections.sampling, sections.frequencies)
    warm = []
    for kappa in map(np.array, sections.anchors):
        crossover = 0.1 * first.omega_0
        gain = _size(first, crossover) / _size(here, frequency * crossover)
        moved = structure.in_units(kappa, frequency, gain)
        both = [kappa, moved]
        merits = [
            started(found, np.clip(in_problem_units(found, one), *found.box)).merit()
            for one in both
        ]
        warm.append(both[int(np.argmax(merits))])
    return warm


def _first_mode(plant: ScaledPlant) -> float:
    """The lowest flexible frequency in rad/s; ω₀ where there is none."""
    light = plant.natural[plant.natural > 0.0]
    return float(light.min()) if len(light) else plant.omega_0


def _size(plant: ScaledPlant, omega: float) -> float:
    """‖G(jω)‖ in m/N."""
    si = plant.plant_si()
    solved = np.linalg.solve(1j * omega * np.eye(len(si.A)) - si.A, si.B + 0j)
    return float(np.linalg.norm(si.C @ solved, 2))
