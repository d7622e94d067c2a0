"""Where local searches start: loop-shaping rules and random controllers.

A start has its crossover |L(jω_c)| = 1 at a chosen frequency, integrator and lead placed around it
by the rules of thumb (ω_i = ω_c/6, lead from ω_c/3 to 3ω_c, roll-off at 8ω_c), and its biquads as
notches at the plants' resonances (`by_rules`) or anywhere (`at_random`). `stabilising` keeps those
with which every closed loop of the set is stable, by eigenvalues, for hundreds at once.

Channels that share a sensor cannot be designed one by one: each alone would take the whole
bandwidth. There a start is a random controller for each, with its own crossover |G_i K_i| = 1, of
which those are kept that together hold every plant stable (`actuator_starts`). Where a channel's
plant is on its stiffness line at the crossover (a piezo) its lead is turned around into a lag.
"""

from collections.abc import Sequence
from contextlib import suppress
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

Biquad = tuple[float, float, float, float]  # ω and ζ of its zeros, then ω and ζ of its poles


def by_rules(problem: Problem, crossovers: Array) -> Array:
    """Make controllers by rules: PID with roll-off at each crossover, notches at resonances.

    The n biquads of one crossover ω_c are, in turn,

        notches at the resonances, the strongest first, of two widths, and below and above them
        n > 1, no shape beyond ω_b      wide notches, the last one lifts |L| just below ω_c
        n > 1, another shape            skewed notches, a lag and a lead, at the first resonance:
                                        they turn its circle away from -1
        n > 0                           narrow notches, the last one is a lead of second order, or
                                        lifts |L| at the first anti-resonance

    |L| is lifted where its dip lets |S| rise to its bound.

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
    below_crossover = problem.bounds.shape is None or (
        problem.bounds.shape_ends is ShapeEnd.CROSSING
    )

    def notches(crossover: float, width: float, shift: float) -> list[Biquad]:
        found = []
        for i in range(count):
            top = tops[i % len(tops)] if len(tops) else 4.0 * crossover
            again = i // max(len(tops), 1)  # how often this resonance has a notch already
            found.append((top * shift ** (1 + again), 0.1, top * shift, width))
        return found

    found, at = [], []
    for crossover in crossovers.tolist():
        narrow, wide, below, above = (
            notches(crossover, *each) for each in ((0.5, 1.0), (1.0, 1.0), (0.5, 0.8), (0.5, 1.25))
        )
        sets = [narrow, wide, below, above]
        if count > 1 and below_crossover:
            lifts = [ratio * crossover for ratio in (0.7, 1.0)]
            sets += [[*wide[:-1], (1.02 * lift, 0.1, lift, 0.07)] for lift in lifts]
        elif count > 1 and len(tops):
            lag, lead = (0.93, 0.07, 0.8, 0.1), (0.95, 0.07, 1.1, 0.2)
            skewed = [(zeros * tops[0], thin, poles * tops[0], broad)
                      for zeros, thin, poles, broad in (lag, lead)]  # fmt: skip
            sets.append([*skewed, *narrow[2:]])
        if count:
            sets.append([*narrow[:-1], (crossover, 1.0, 8.0 * crossover, 0.7)])
            sets += [[*narrow[:-1], (dip, 0.5, dip, 0.1)] for dip in problem.antiresonances[:1]]
        found += [_kappa(problem, _pid(problem, crossover), biquads) for biquads in sets]
        at += [crossover] * len(sets)
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
    places = [(top, True) for top in problem.resonances]
    places += [(dip, False) for dip in problem.antiresonances]
    found = []
    for crossover in crossovers.tolist():
        values, biquads = _pid(problem, crossover, rng), []
        for _ in range(problem.structure.biquads):
            if places and rng.random() < 0.6:
                place, zeros_there = places[int(rng.integers(len(places)))]
            else:
                place, zeros_there = crossover * np.exp(rng.uniform(-0.5, 2.5)), True
            there = place * np.exp(rng.normal(0.0, 0.25)), np.exp(rng.uniform(np.log(0.02), 0.0))
            beside = place * np.exp(rng.normal(0.1, 0.4)), np.exp(rng.uniform(np.log(0.05), 0.0))
            biquads.append((*there, *beside) if zeros_there else (*beside, *there))
        found.append(_kappa(problem, values, biquads))
    kappa = np.reshape(found, (-1, len(problem.structure.names)))  # also where there are none
    return with_crossover(problem, kappa, crossovers)


def redraw_section(
    problem: Problem, ends: Sequence[Array], count: int, rng: np.random.Generator
) -> Array:
    """Make controllers (N, n) like those at which searches ended, with one section drawn anew.

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
    """Select the κ (N, n) with which every closed loop is stable."""
    parts = [kappa[i : i + chunk] for i in range(0, len(kappa), chunk)]
    good = [
        all_stable(closed_loops(problem.plants, problem.structure, part)).all(1) for part in parts
    ]
    return kappa[np.concatenate(good)] if len(kappa) else kappa


def _pid(
    problem: Problem, crossover: float, rng: np.random.Generator | None = None
) -> dict[str, float]:
    """PID and roll-off by the rules of thumb; with `rng` each frequency is scattered around."""

    def near(factor: float) -> float:
        scatter = 1.0 if rng is None else float(np.exp(rng.normal(0.0, 0.5)))
        return crossover * factor * scatter

    values = {"gain": 1.0, "integrator": near(1.0 / 6.0)}
    for i in range(1, problem.structure.lead + 1):
        values[f"lead {i} zero"], values[f"lead {i} pole"] = near(1.0 / 3.0), near(3.0 * i)
    for i in range(1, problem.structure.roll_off // 2 + 1):
        values[f"roll-off {i}"], values[f"roll-off {i} damping"] = near(8.0), 0.7
    values["roll-off real"] = near(8.0)
    return values


def _kappa(problem: Problem, pid: dict[str, float], biquads: Sequence[Biquad]) -> Array:
    values, parts = dict(pid), ("zeros", "zeros damping", "poles", "poles damping")
    for i, biquad in enumerate(biquads, 1):
        values |= {f"biquad {i} {part}": v for part, v in zip(parts, biquad, strict=True)}
    return np.log(np.array([values[name] for name in problem.structure.names]))


def with_crossover(problem: Problem, kappa: Array, crossovers: Array) -> Array:
    """Set the gains of κ (N, n) so that |L| = 1 at its crossover on the first plant, in the box."""
    kappa = np.clip(kappa, *problem.box)
    kinds = np.array([kind is ParameterKind.GAIN for kind in problem.structure.kinds])
    v = problem.plants.variable(np.asarray(crossovers, float))
    kappa[:, kinds] = 0.0  # a gain of 1
    K = problem.structure.response(kappa.T, 1j * v)
    kappa[:, kinds] = -np.log(np.abs(problem.first_response(v) * K))[:, None]
    return np.clip(kappa, *problem.box)


def _channel_family(
    structure: ChannelStructure, plant: ScaledPlant, number: int, sampling: Sampling | None
) -> PlantSet:
    """The plant of a channel, or of the first that can hold all motions where this one cannot, as
    the difference of two sensors cannot hold a free body; in the unit of the channel's sensor."""
    levels = sensor_levels(plant, structure.decoupling)

    def of_channel(i: int) -> ScaledPlant:
        own = channel_plant(plant, structure.decoupling, i)
        return replace(own, C=own.C * np.exp(levels[number] - levels[i]))

    others = [i for i in range(len(structure.structures)) if i != number]
    *earlier, last = [number, *others]
    for i in earlier:
        own = of_channel(i)
        with suppress(PlantError):
            return plant_set([own], sampling)
    return plant_set([of_channel(last)], sampling)


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
    """Find up to `count` controllers κ of the whole that are stable on all plants, in their units.

    Crossovers are drawn over ω₀, `draws_for_each` of those required; where d ln|G|/d ln ω is above
    `stiffness_line` the stiffness holds what is moved.
    """
    draws, (low, high) = draws_for_each * count, crossovers_of
    parts = []
    for i in structure.free:
        own = structure.structures[i]
        family = _channel_family(structure, plants[0], i, sampling)
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
        loops = (closed_loops(family, structure, kappa) for family in (first, every))
        if all(all_stable(each).all() for each in loops):  # the first plant alone refuses most
            found.append(kappa)
        if len(found) == count:
            break
    return found
