"""Where local searches start: loop-shaping rules and random controllers, all of them stable loops.

A start has its crossover |L(jω_c)| = 1 at a chosen frequency, integrator and lead placed around it
by the rules of thumb (ω_i = ω_c/6, lead from ω_c/3 to 3ω_c, roll-off at 8ω_c), and its biquads as
notches at the plants' resonances (`by_rules`) or anywhere (`at_random`). Only those that every
closed loop of the set is stable with are kept, as eigenvalues say, for hundreds at once.

Channels that share a sensor cannot be designed one by one: each alone would take the whole
bandwidth. There a start is a random controller for each, with a crossover |G_i K_i| = 1 of its own,
of which those are kept that together hold every plant stable (`actuator_starts`). Where a channel's
plant is on its stiffness line at the crossover (a piezo) its lead is turned around into a lag.
"""

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np

from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    channel_plant,
    sensor_levels,
)
from ccd_casadi.fixed_structure.loop_problem import LoopProblem, Problem
from ccd_casadi.fixed_structure.plant_set import PlantSet, all_stable, closed_loops, plant_set
from ccd_casadi.fixed_structure.structure import ParameterKind
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

# Two biquads at a resonance: (root, over its frequency, damping), first a lag, then a lead.
SKEWED = (
    (("zeros", 0.93, 0.07), ("poles", 0.8, 0.1)),
    (("zeros", 0.95, 0.07), ("poles", 1.1, 0.2)),
)


def by_rules(problem: Problem, crossovers: Array) -> Array:
    """Make controllers by rules: PID with roll-off at each crossover, notches at resonances.

    Notches come narrow and wide, and shifted to either side; in two more shapes the last biquad is
    a lead, or lifts |L| at the first anti-resonance, whose dip bounds |S|. Of several biquads two
    are skewed notches at the first resonance too, which turn its circle away from -1; where the
    shape ends at ω_b the last one is a filter at the crossover instead.

    Parameters
    ----------
    problem : Problem
    crossovers : array (k,)
        In the problem's units.

    Returns
    -------
    array (N, n)
        κ of each.
    """
    tops, count = problem.resonances, problem.structure.biquads
    plain = [(0.5, 1.0), (1.0, 1.0), (0.5, 0.8), (0.5, 1.25)]
    narrow = problem.bounds.shape is None or problem.bounds.shape_ends is ShapeEnd.CROSSING
    skewed = count > 1 and not narrow and len(tops) > 0
    found, at = [], []
    for crossover in crossovers:
        shapes: list[tuple[float, float, tuple[float, ...]]] = [(*one, ()) for one in plain]
        if count > 1 and narrow:  # |L| just below the crossover, where S rises
            shapes += [(1.0, 1.0, (ratio * crossover, 1.02, 0.1, 0.07)) for ratio in (0.7, 1.0)]
        elif skewed:
            shapes.append((0.5, 1.0, ()))  # the notches beyond the skewed ones
        if count:  # a lead of second order; the dip of |L| at an anti-resonance, where S rises too
            shapes.append((0.5, 1.0, (8.0 * crossover, 0.125, 1.0, 0.7)))
            shapes += [(0.5, 1.0, (dip, 1.0, 0.5, 0.1)) for dip in problem.antiresonances[:1]]
        for turn, (width, below, lift) in enumerate(shapes):
            values = _around(problem, float(crossover), np.random.default_rng(0), 0.0)
            for i in range(count):
                notch = tops[i % len(tops)] if len(tops) else 4.0 * crossover
                values[f"biquad {i + 1} zeros"] = notch * below ** (1 + i // max(len(tops), 1))
                values[f"biquad {i + 1} zeros damping"] = 0.1
                values[f"biquad {i + 1} poles"] = notch * below
                values[f"biquad {i + 1} poles damping"] = width
            if turn == len(plain) and skewed:
                for i, roots in enumerate(SKEWED, 1):
                    for root, ratio, damping in roots:
                        values[f"biquad {i} {root}"] = ratio * tops[0]
                        values[f"biquad {i} {root} damping"] = damping
            if lift:
                poles, ratio, wide, light = lift
                values[f"biquad {count} zeros"] = ratio * poles
                values[f"biquad {count} zeros damping"] = wide
                values[f"biquad {count} poles"] = poles
                values[f"biquad {count} poles damping"] = light
            found.append(_kappa(problem, values))
            at.append(crossover)
    return with_crossover(problem, np.array(found), np.array(at))


def at_random(problem: Problem, crossovers: Array, rng: np.random.Generator) -> Array:
    """Draw controllers with given crossovers.

    A biquad has its zeros at a resonance, or its poles at an anti-resonance, or is anywhere.

    Parameters
    ----------
    problem : Problem
    crossovers : array (N,)
        In the problem's units.
    rng : Generator

    Returns
    -------
    array (N, n)
        κ of each.
    """
    tops = problem.resonances
    known = np.concatenate([tops, problem.antiresonances])
    found = []
    for crossover in crossovers:
        values = _around(problem, float(crossover), rng, 1.0)
        for i in range(problem.structure.biquads):
            place = int(rng.integers(len(known))) if len(known) and rng.random() < 0.6 else -1
            middle = crossover * np.exp(rng.uniform(-0.5, 2.5)) if place < 0 else known[place]
            near, far = ("zeros", "poles") if place < len(tops) else ("poles", "zeros")
            values[f"biquad {i + 1} {near}"] = middle * np.exp(rng.normal(0.0, 0.25))
            values[f"biquad {i + 1} {near} damping"] = np.exp(rng.uniform(np.log(0.02), 0.0))
            values[f"biquad {i + 1} {far}"] = middle * np.exp(rng.normal(0.1, 0.4))
            values[f"biquad {i + 1} {far} damping"] = np.exp(rng.uniform(np.log(0.05), 0.0))
        found.append(_kappa(problem, values))
    kappa = np.reshape(found, (-1, len(problem.structure.names)))  # of no crossover too
    return with_crossover(problem, kappa, crossovers)


def redrawn(problem: Problem, ends: Sequence[Array], count: int, rng: np.random.Generator) -> Array:
    """(N, n) controllers like those at which searches ended, with one section drawn anew.

    A section is a biquad, or leads and roll-off together.
    """
    names = problem.structure.names
    sections = [
        [name.startswith(f"biquad {i}") for name in names]
        for i in range(1, problem.structure.biquads + 1)
    ]
    sections.append([name.startswith(("lead", "roll-off")) for name in names])
    sections = [section for section in sections if any(section)]
    if not sections or not count:
        return np.zeros((0, len(names)))
    crossovers = np.exp(rng.uniform(np.log(0.05), 0.0, count))
    drawn = at_random(problem, crossovers, rng)
    chosen = np.array(sections)[rng.integers(len(sections), size=count)]
    like = np.array(ends)[np.arange(count) % len(ends)]
    return np.where(chosen, drawn, like)


def stabilising(problem: Problem, kappa: Array, chunk: int = 256) -> Array:
    """Those (N, n) with which every closed loop is stable."""
    parts = [kappa[i : i + chunk] for i in range(0, len(kappa), chunk)]
    good = [
        all_stable(closed_loops(problem.plants, problem.structure, part)).all(1) for part in parts
    ]
    return kappa[np.concatenate(good)] if len(kappa) else kappa


def _around(
    problem: Problem, crossover: float, rng: np.random.Generator, spread: float
) -> dict[str, float]:
    def near(factor: float) -> float:
        return crossover * factor * float(np.exp(spread * rng.normal(0.0, 0.5)))

    values = {"gain": 1.0, "integrator": near(1.0 / 6.0)}
    for i in range(1, problem.structure.lead + 1):
        values[f"lead {i} zero"], values[f"lead {i} pole"] = near(1.0 / 3.0), near(3.0 * i)
    for i in range(1, problem.structure.roll_off // 2 + 1):
        values[f"roll-off {i}"], values[f"roll-off {i} damping"] = near(8.0), 0.7
    values["roll-off real"] = near(8.0)
    return values


def _kappa(problem: Problem, values: dict[str, float]) -> Array:
    return np.log(np.array([values[name] for name in problem.structure.names]))


def with_crossover(problem: Problem, kappa: Array, crossovers: Array) -> Array:
    """κ with the gain that gives |L| = 1 at the crossover of the first plant, boxed."""
    kappa = np.clip(kappa, *problem.box)
    kinds = np.array([kind is ParameterKind.GAIN for kind in problem.structure.kinds])
    v = problem.plants.variable(np.asarray(crossovers, float))
    kappa[:, kinds] = 0.0
    K = problem.structure.response(kappa.T, 1j * v)
    kappa[:, kinds] = -np.log(np.abs(problem.first_response(v) * K))[:, None]
    return np.clip(kappa, *problem.box)


def _seen_by(
    structure: ChannelStructure, plant: ScaledPlant, number: int, sampling: Sampling | None
) -> PlantSet:
    """The plant of a channel, or of the first that can hold all motions where this one cannot, as
    the difference of two sensors cannot hold a free body; in the unit of the channel's sensor."""
    levels = sensor_levels(plant, structure.decoupling)
    order = [number, *(i for i in range(len(structure.structures)) if i != number)]
    for i in order:
        own = channel_plant(plant, structure.decoupling, i)
        if i != number:
            own = replace(own, C=own.C * np.exp(levels[number] - levels[i]))
        with suppress(PlantError) if i != order[-1] else nullcontext():
            return plant_set([own], sampling)
    raise AssertionError


def actuator_starts(
    problem: LoopProblem,
    structure: ChannelStructure,
    plants: Sequence[ScaledPlant],
    sampling: Sampling | None,
    count: int,
    rng: np.random.Generator,
    *,
    crossovers_of: tuple[float, float] = (0.01, 1.0),
    draws_for_each: int = 40,
    stiffness_line: float = -1.0,
) -> list[Array]:
    """Up to `count` controllers κ of the whole that are stable on all plants, in their units.

    Crossovers are drawn over ω₀, `draws_for_each` of those required; where d ln|G|/d ln ω is above
    `stiffness_line` the stiffness holds what is moved.
    """
    draws, (low, high) = draws_for_each * count, crossovers_of
    parts = []
    for i in structure.free:
        own = structure.structures[i]
        family = _seen_by(structure, plants[0], i, sampling)
        single = Problem(family, own, problem.bounds, problem.box[:, structure.slices[i]])
        crossovers = np.exp(rng.uniform(np.log(low), np.log(high), draws))
        kappa = at_random(single, crossovers, rng)
        v = family.variable(crossovers)
        G, slope = family.responses(np.zeros(draws, int), v)
        lag = (slope / G)[:, 0, 0].real > stiffness_line
        for j in range(1, own.lead + 1):
            pair = [own.names.index(f"lead {j} {root}") for root in ("zero", "pole")]
            kappa[np.ix_(lag, pair)] = kappa[np.ix_(lag, pair[::-1])]
        parts.append(with_crossover(single, kappa, crossovers))
    first = plant_set(plants[:1], sampling, structure.decoupling)
    every = plant_set(plants, sampling, structure.decoupling)
    found: list[Array] = []
    for kappa in np.hstack(parts):
        for family in (first, every):
            if not all_stable(closed_loops(family, structure, kappa)).all():
                break
        else:
            found.append(kappa)
        if len(found) == count:
            break
    return found
