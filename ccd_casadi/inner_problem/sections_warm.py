"""Anchors of a fixed structure as starts at another θ."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure import Bounds, ChannelStructure, Structure
from ccd_casadi.fixed_structure.decoupling import channel_plant
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.race import started
from ccd_casadi.fixed_structure.sections_design import in_problem_units
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

ALMOST = 0.99  # of the lowest flexible frequency of all: below it the suspension is


def warm_starts(
    problem: CoDesignProblem,
    structure: Structure | ChannelStructure,
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
) -> list[Array]:
    """Each anchor as it is or moved with the plant from the start θ, whichever is nearer; κ in SI.

    Moved: frequencies with the first flexible mode, the gain as 1/|G| at the frequency that the
    crossover moves with; a notch stays on its resonance. Of several channels each is moved on its
    own, with the first mode that it sees.
    """
    sections = sections_of_problem(problem)
    if not sections.anchors:
        return []
    first = scaled_plant(problem, problem.start)
    anchors = [np.array(kappa) for kappa in sections.anchors]

    def nearer(
        own: Structure, before: ScaledPlant, set_of: list[ScaledPlant], kappa: Array, bounds: Bounds
    ) -> Array:
        found = problem_for(set_of, own, bounds, sections.sampling, sections.frequencies)
        both = [kappa, moved(own, before, set_of[0], kappa)]
        merits = [
            started(found, np.clip(in_problem_units(found, one), *found.box)).merit()
            for one in both
        ]
        return both[int(np.argmax(merits))]

    if isinstance(structure, Structure):
        return [nearer(structure, first, list(plants), kappa, bounds) for kappa in anchors]
    warm = [kappa.copy() for kappa in anchors]
    for i in structure.free:
        own, place = structure.structures[i], structure.slices[i]
        before = channel_plant(first, structure.decoupling, i)
        set_of = [channel_plant(plant, structure.decoupling, i) for plant in plants]
        for kappa in warm:
            kappa[place] = nearer(own, before, set_of, kappa[place], bounds.of_channel(i))
    return warm


def moved(structure: Structure, first: ScaledPlant, here: ScaledPlant, kappa: Array) -> Array:
    """κ in SI of a SISO plant for another one like it."""
    frequency = _first_mode(here) / _first_mode(first)
    crossover = 0.1 * first.omega_0
    gain = _size(first, crossover) / _size(here, frequency * crossover)
    return structure.in_units(kappa, frequency, gain)


def _first_mode(plant: ScaledPlant) -> float:
    """The lowest flexible frequency that the plant's states have, in rad/s; ω₀ if there is none."""
    flexible = plant.natural[plant.natural > 0.0]
    own = np.abs(np.linalg.eigvals(plant.A)) * plant.omega_0
    light = own[own > ALMOST * flexible.min()] if len(flexible) else flexible
    return float(light.min()) if len(light) else plant.omega_0


def _size(plant: ScaledPlant, omega: float) -> float:
    """‖G(jω)‖ in m/N."""
    return float(np.linalg.norm(plant.plant_si().response(np.array([omega]))[0], 2))
