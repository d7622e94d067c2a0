"""The largest bandwidth of a controller with a fixed structure for each of its channels.

Where every plant falls apart in the channels' coordinates each channel is designed on its own, and
ω_b is the least of theirs, each over its `bandwidth_ratio`. Where channels are coupled the same
designs, on the diagonal of every plant, are where the search on the whole loop starts, with ever
tighter bounds on the channels until together they hold every plant stable. Where actuators share
sensors (fewer outputs than channels) it starts from random controllers that are stable together
(`actuator_starts`).
"""

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    channel_plant,
    in_units_of,
    sensor_levels,
)
from ccd_casadi.fixed_structure.composite import CompositeProblem, answer_alike, in_search_units
from ccd_casadi.fixed_structure.design import (
    DesignOptions,
    DesignSearch,
    SectionsDesign,
    in_problem_units,
    of_one_channel,
    problem_for,
    span_of,
)
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.multi_start import BandwidthOptimum, search_from_starts, start_at
from ccd_casadi.fixed_structure.starts import actuator_starts
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import leading_term
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent, with_title
from ccd_casadi.support.worker_process import one_blas_thread


@one_blas_thread
def synthesise_sections(
    plants: Any,
    structure: Structure | ChannelStructure,
    bounds: Bounds,
    *,
    sampling: Sampling | None = None,
    M_K: float | None = None,
    starts: int = 12,
    most_starts: int = 0,
    seed: int = 0,
    initial: Sequence[Array] = (),
    only_initial: bool = False,
    frequencies: tuple[float, float] | None = None,
    progress: Log | None = None,
    workers: Pool | None = None,
    options: DesignOptions | None = None,
) -> SectionsDesign:
    """max ω_b over the parameters of a structure, with every bound on every plant of a set.

        max ω_b   s.t.  on each plant: stable, |S| <= S_max, |S(jω_low)| <= S_low,
                        |S(jω)| <= (ω/ω_b)/√2 for ω <= ω_b, and within the shape above (`Bounds`),
                        |W_KS KS|, |W_T T| <= weighted_level, |GS| <= compliance_max

    Parameters
    ----------
    plants : control.StateSpace, control.TransferFunction or ScaledPlant, or a list of them
        Force (N) to displacement (m); stable or not. Give a free mass the slow suspension that it
        has, if only of its cables.
    structure, bounds : Structure or ChannelStructure, Bounds
        Sections of K, and what holds on every plant.
    sampling : Sampling, optional
        Rate and delay, exact; left out, the loop is continuous.
    M_K : float, optional
        Scale of control systems, N/m; left out, that of `bounds.weights`, or that of
        ω₀ = 10 ω_low/S_low.
    starts, seed : int
        Of the multi-start search: how many controllers by rules and at random, and which.
    most_starts : int
        Of one channel: up to this many in all, until the best was found from two of them.
    initial, only_initial : sequence of array, bool
        Parameters κ in SI of earlier designs, of several channels stacked, which start beside the
        others, or alone.
    frequencies : tuple of two floats, optional
        As in `problem_for`, rad/s: give them where designs at several θ are compared.
    progress, workers : callable, Pool, optional
        Is given a line at a time; the searches are spread over them, which changes nothing else.
    options : DesignOptions, optional
        Numbers of the searches.

    Returns
    -------
    SectionsDesign
        `outcome` says how it ended; `controller` is K(s) in SI, e = r - y to force.

    Raises
    ------
    UserError
        A system is not continuous.
    PlantError
        A system cannot be a plant, or the plants cannot be in a set.

    Examples
    --------
    >>> import control
    >>> import ccd_casadi as ccd
    >>> plant = control.tf([1.0], [2.0, 12.0, 800.0])  # 2 kg on 800 N/m
    >>> bounds = ccd.Bounds(S_max=1.8, S_low=0.1, omega_low=5.0, shape=1.1, compliance_max=1e-4)
    >>> structure = ccd.Structure(lead=1, biquads=0, roll_off=1)
    >>> light = control.tf([1.0], [1.8, 12.0, 800.0])
    >>> sampling = ccd.Sampling(rate_hz=2000.0, delay_us=250.0)
    >>> design = ccd.synthesise_sections([plant, light], structure, bounds, sampling=sampling,
    ...                                  starts=4)
    >>> design.certified, design.certificate.words
    (True, 'stable and within every bound on 2 plants')
    """
    scaled, options = _scale(plants, bounds, M_K), options or DesignOptions()
    problem = problem_for(scaled, structure, bounds, sampling, frequencies, margin=options.margin)
    search = DesignSearch(problem, scaled, sampling, starts, most_starts, seed, initial,
                          only_initial, progress or silent, workers, options=options)  # fmt: skip
    if isinstance(problem, CompositeProblem):
        return _of_several(search, problem)
    return of_one_channel(search)


def _scale(plants: Any, bounds: Bounds, M_K: float | None) -> list[ScaledPlant]:
    """The plants, control systems in units of M_K: without one, of the weights or by the bounds,
    ω₀ of the first a decade above the least bandwidth that they ask for."""
    scale = M_K if bounds.weights is None else bounds.weights.M_K
    if M_K is not None and scale != M_K:
        raise UserError(f"M_K is {M_K:g}, that of the weights {scale:g}; give one")
    scaled = list(plants) if isinstance(plants, list | tuple) else [plants]
    for i, system in enumerate(scaled):
        if isinstance(system, ScaledPlant):
            continue
        from ccd_casadi.synthesis.interchange import from_control, plant_from_control

        if scale is None:
            space = from_control(system)
            order, term = leading_term(space.A, space.B, space.C)
            least = bounds.omega_low / bounds.S_low  # rad/s: the bandwidth of an S of slope one
            gain = float(np.linalg.norm(term, 2))
            scale = (10.0 * least) ** order / gain if order else 1.0
        scaled[i] = plant_from_control(system, scale)
    return scaled


def _of_several(search: DesignSearch, problem: CompositeProblem) -> SectionsDesign:
    """Search each channel alone, and then, where they are coupled, the whole loop."""
    structure, only_initial = problem.structure, search.only_initial
    alike = in_search_units(search.plants, problem.bounds)
    if problem.separable:
        made = _of_channels(search, problem, alike)
        short = [(name, one) for name, one in zip(structure.decoupling.names, made, strict=True)
                 if not one.certified]  # fmt: skip
        if short:
            name, one = short[0]
            return search.make_failure(one.outcome, f"channel {name}: {one.words}")
        return _join(search, problem, made)
    field = _stable(problem, search.inside(search.initial))
    evaluations, known = len(search.initial), len(field)
    shared = min(len(M) for M in structure.directions) < len(structure.structures)
    rng = np.random.default_rng(search.seed)
    if shared and not only_initial:
        if problem.bounds.error is not None:
            field += _stable(problem, search.inside(_of_sensors(search, problem, alike)))
        field += actuator_starts(problem, structure, alike, search.sampling, search.starts, rng)
        evaluations += len(field)
    elif problem.bounds.error is None and (not field or not only_initial):
        before: list[SectionsDesign] = []
        for share in search.options.peak_shares:
            before = _of_channels(search, problem, alike, share, before)
            stack = _stack(structure, before)
            evaluations += 1
            fresh = _stable(problem, search.inside([stack])) if np.isfinite(stack).all() else []
            field += fresh
            if fresh:
                break
        if not field:  # one channel alone would hold all unstable motions, the whole needs it not
            field += actuator_starts(problem, structure, alike, search.sampling, search.starts, rng)
            evaluations += len(field)
    if not field:
        return search.make_failure()
    log = with_title(search.log, "whole loop")
    runners = search_from_starts(problem, np.array(field), log, search.workers, known=known,
                       options=search.options.multi_start)  # fmt: skip
    return search.conclude(runners, len(field), evaluations)


def _of_sensors(
    search: DesignSearch, problem: CompositeProblem, alike: Sequence[ScaledPlant]
) -> list[Array]:
    """Controllers κ in SI of one sensor alone, the others' gains as small as they may be."""
    bounds, structure = replace(problem.bounds, channels=(), error=None), problem.structure
    least = np.where(structure.gains, problem.box[0], problem.box.mean(axis=0))
    levels = sensor_levels(alike[0], structure.decoupling)
    idle = structure.in_units(least, problem.plants.omega_0, problem.plants.force)
    found = list[Array]()
    for i, own in enumerate(structure.structures):
        unit = replace(alike[0], force=alike[0].force * np.exp(-levels[i]))
        plants = [in_units_of(channel_plant(plant, structure.decoupling, i), unit)
                  for plant in alike]  # fmt: skip
        try:
            alone = problem_for(plants, own, bounds, search.sampling, span_of(problem),
                                margin=problem.margin)  # fmt: skip
        except PlantError:  # as of a difference of sensors, which sees no free body
            continue
        name = structure.decoupling.names[i]
        made = of_one_channel(replace(
            search, problem=alone, plants=plants, initial=[], began=perf_counter(),
            log=with_title(search.log, f"sensor {name} alone"),
        ))  # fmt: skip
        if np.isfinite(made.kappa).all():
            kappa = idle.copy()
            kappa[structure.slices[i]] = made.kappa
            found.append(kappa)
    return found


def _of_channels(
    search: DesignSearch,
    problem: CompositeProblem,
    alike: Sequence[ScaledPlant],
    share: float | None = None,
    before: Sequence[SectionsDesign] = (),
) -> list[SectionsDesign]:
    """A design for each channel, on its entry of every plant; one for all that are alike.

    One for those that share their parameters too, on the entries of all of them. With a share of
    the room that its S_max leaves above 1. Climbs from `before`, the same with wider limits, if it
    is given. `alike`: the plants in the units of the first.
    """
    structure, found = problem.structure, list[SectionsDesign]()
    own_plants: list[list[ScaledPlant]] = []
    own_limits = [problem.bounds.of_channel(i) for i in range(len(structure.structures))]
    if share is not None:
        own_limits = [replace(one, S_max=1.0 + share * (one.S_max - 1.0)) for one in own_limits]
    for i, own in enumerate(structure.structures):
        members = [channel_plant(plant, structure.decoupling, i) for plant in alike]
        if structure.owner(i) != i:
            own_plants.append(members)
            found.append(found[structure.owner(i)])
            continue
        for j in range(i + 1, len(structure.structures)):
            if structure.owner(j) == i:
                others = [channel_plant(plant, structure.decoupling, j) for plant in alike]
                members += [other for other, one in zip(others, members, strict=False)
                            if not answer_alike([one], [other])]  # fmt: skip
        begins = [np.asarray(kappa, float)[structure.slices[i]] for kappa in search.initial]
        again = bool(before) and bool(np.isfinite(before[i].kappa).all())
        if again:
            begins = [before[i].kappa]
        own_plants.append(members)
        same = [j for j in range(i)
                if structure.structures[j] == own and own_limits[j] == own_limits[i]
                and answer_alike(members, own_plants[j])]  # fmt: skip
        if same and (not begins or again):
            found.append(found[same[0]])
            continue
        alone = problem_for(members, own, own_limits[i], search.sampling, span_of(problem),
                            margin=problem.margin)  # fmt: skip
        title = f"channel {structure.decoupling.names[i]}"
        found.append(of_one_channel(replace(
            search, problem=alone, plants=members, initial=begins, began=perf_counter(),
            only_initial=search.only_initial or again, log=with_title(search.log, title),
        )))  # fmt: skip
    return found


def _join(
    search: DesignSearch, problem: CompositeProblem, designs: Sequence[SectionsDesign]
) -> SectionsDesign:
    """The channels' designs as one, with the bandwidth of the slowest."""
    kappa = _stack(problem.structure, designs)
    inside = in_problem_units(problem, kappa)
    leads = (problem.bounds.lead(i) for i in range(len(designs)))
    slowest = min(one.bandwidth / np.exp(lead) for one, lead in zip(designs, leads, strict=True))
    tau = float(np.log(slowest / problem.plants.omega_0))
    point = Point(inside, tau, assess(problem, inside, tau))
    optima = (BandwidthOptimum(slowest, 1, tuple(map(float, kappa))),)
    starts = sum(one.starts for one in designs)
    return search.make_design(point, optima, starts, sum(one.evaluations for one in designs))


def _stack(structure: ChannelStructure, designs: Sequence[SectionsDesign]) -> Array:
    """The channels' parameters in SI as one κ."""
    return np.concatenate([designs[i].kappa for i in structure.free])


def _stable(problem: CompositeProblem, pool: Sequence[Array]) -> list[Array]:
    return [kappa for kappa in pool if start_at(problem, kappa).assessment.stable]
