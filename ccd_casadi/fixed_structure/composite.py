"""The problem of a controller with several channels, made of parts.

Plants that fall apart in the channels' coordinates are one SISO problem for each channel, whose
bounds are the whole's, or its own where they are tighter: the singular values of S, KS, T and GS
are the channels' moduli. Plants whose channels are coupled are bounded as a whole. All parts share
ω_b, a channel's own bandwidth is in proportion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    channel_plant,
    in_units_of,
    is_decoupled,
    sensor_levels,
)
from ccd_casadi.fixed_structure.figures import assess, constraints, hessians, to_theta
from ccd_casadi.fixed_structure.loop_problem import (
    Assessment,
    Constraints,
    LoopProblem,
    Problem,
    RowPlaces,
)
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import side_by_side

T = TypeVar("T")
R = TypeVar("R")
Rows = TypeVar("Rows", bound=RowPlaces)


@dataclass(frozen=True)
class Part:
    """A problem on some of the parameters (`place` of κ) and some of the plants (`members`).

    Parameters that channels share stand in `place` as often as the problem has them. `channel`: the
    number of the one that it is of, None of all; `lead`: ln of that one's bandwidth over ω_b.
    """

    problem: LoopProblem
    place: np.ndarray
    members: np.ndarray
    channel: int | None = None
    lead: float = 0.0

    def spread(self, count: int) -> Array:
        """(k, count): the problem's parameters from all."""
        return np.asarray(np.arange(count) == self.place[:, None], float)


@dataclass(frozen=True)
class CompositeProblem(LoopProblem):
    """All parts; `plants` are those of the first, for the units. `count` plants in all.

    The rows of part j are numbered after those of the parts before it.
    """

    structure: ChannelStructure
    parts: tuple[Part, ...] = ()
    count: int = 0

    @property
    def separable(self) -> bool:
        """Whether every plant falls apart, so that each channel can be designed on its own."""
        return all(part.channel is not None for part in self.parts)

    def rows_of(self, number: int) -> tuple[int, int]:
        """The range of numbers of rows of a part."""
        each = len(self.structure.structures) + len(self.bounds.channels)
        sizes = [len(part.members) * each for part in self.parts]
        start = int(np.sum(sizes[:number], dtype=int))
        return start, start + sizes[number]

    def split(self, rows: Rows) -> list[tuple[Part, np.ndarray, Rows]]:
        """Split rows among the parts: each part with the indices of its rows, and these as it
        numbers them."""
        found = []
        for number, part in enumerate(self.parts):
            start, end = self.rows_of(number)
            at = np.flatnonzero((rows.plant >= start) & (rows.plant < end))
            found.append((part, at, replace(rows.only(at), plant=rows.plant[at] - start)))
        return found

    def kinds_of(self, constraints: Constraints) -> list[str]:
        """Name the kinds of rows as `LoopProblem` does, those of channels with bounds of their own
        by channel."""
        names = super().kinds_of(constraints)
        if not self.bounds.channels:
            return names
        for part, at, inside in self.split(constraints):
            for j, row in zip(at.tolist(), inside.plant.tolist(), strict=True):
                channel = part.channel
                if channel is None:
                    past = row // part.problem.plants.count - part.problem.first
                    if past < 0:
                        continue
                    channel = past
                own = self.bounds.channels[channel]
                if {"S_MAX": own.S_max, "KS": own.M_K}.get(names[j]) is not None:
                    names[j] += f" of {own.name}"
        return names

    def gains_of(self, constraints: Constraints) -> np.ndarray:
        out = np.zeros((len(constraints.v), 2), int)
        for number, (part, at, own) in enumerate(self.split(constraints)):
            # Coupled plants are in several parts for speed alone: theirs are one.
            one = len(self.parts) if part.channel is None else number
            out[at] = part.problem.gains_of(own) + np.array([one, 0])
        return out

    def inverse_square(self, at: RowPlaces, tau: float) -> Array:
        out = np.zeros(len(at.v))
        for part, which, own in self.split(at):
            out[which] = part.problem.inverse_square(own, tau + part.lead)
        return out

    def plants_of(self, constraints: RowPlaces) -> np.ndarray:
        out = np.zeros(len(constraints.v), int)
        for part, at, own in self.split(constraints):
            out[at] = part.members[part.problem.plants_of(own)]
        return out


def composite_problem(
    plants: Sequence[ScaledPlant],
    structure: ChannelStructure,
    bounds: Bounds,
    sampling: Sampling | None = None,
    frequencies: tuple[float, float] | None = None,
    margin: float = 0.0,
    *,
    most_coupled: int = 6,
) -> CompositeProblem:
    """The problem in the units of the first plant; `frequencies` (rad/s) bound those of K's roots.

    Coupled plants are in parts of `most_coupled` at most, which are computed side by side.
    Raises PlantError as `plant_set` does.
    """
    alike = in_search_units(plants, bounds)
    first = alike[0]
    apart = np.array([is_decoupled(plant, structure.decoupling) for plant in alike])
    together = np.flatnonzero(~apart)
    poles = np.concatenate([np.linalg.eigvals(plant.A) for plant in alike])
    box, parts = box_of(structure, poles, first.omega_0, sampling, frequencies), []
    if bounds.error is not None:
        levels = sensor_levels(first, structure.decoupling)
        for at, level in zip(structure.slices, levels, strict=True):
            box[:, at] -= level * structure.gains[at]
    if apart.any():
        members = np.flatnonzero(apart)
        singles: list[list[ScaledPlant]] = []
        for i, own in enumerate(structure.structures):
            place = np.arange(len(box[0]))[structure.slices[i]]
            singles.append([channel_plant(alike[j], structure.decoupling, i) for j in members])
            limits, lead, owner = bounds.of_channel(i), bounds.lead(i), structure.owner(i)
            alike_bounds = limits == bounds.of_channel(owner) and lead == bounds.lead(owner)
            if owner != i and alike_bounds and answer_alike(singles[owner], singles[i]):
                continue
            problem = Problem(plant_set(singles[i], sampling), own, limits, box[:, place], margin)
            parts.append(Part(problem, place, members, i, lead))
    count = -(-len(together) // most_coupled)
    for members in np.array_split(together, count) if count else ():
        matrices = plant_set([alike[j] for j in members], sampling, structure.decoupling)
        place = structure.places
        whole = LoopProblem(matrices, structure.apart, bounds, box[:, place], margin)
        parts.append(Part(whole, place, members))
    plant_units = parts[0].problem.plants
    return CompositeProblem(plant_units, structure, bounds, box, margin, tuple(parts), len(plants))


def in_search_units(plants: Sequence[ScaledPlant], bounds: Bounds) -> list[ScaledPlant]:
    """The plants in one unit of time and force.

    Those of the first; of several sensors on one actuator, each with a unit of its own, that ω₀
    says nothing (it is of all readings together): there it is a decade above the least bandwidth
    that the bounds ask for.
    """
    first = plants[0]
    if bounds.error is not None:
        first = replace(first, omega_0=10.0 * bounds.omega_low / bounds.S_low)
        first = in_units_of(plants[0], first)
    return [in_units_of(plant, first) for plant in plants]


def on_plants(
    problem: LoopProblem, plants: Sequence[ScaledPlant], sampling: Sampling | None
) -> LoopProblem:
    """Put other plants into a problem, as many, in its units, close to its own.

    Parameters
    ----------
    problem : LoopProblem
        Its structure, bounds, box and division into parts stay.
    plants : sequence of ScaledPlant
        Decoupled and alike where the problem's own are; this is not checked.
    sampling : Sampling, optional
        None: a continuous loop.

    Returns
    -------
    LoopProblem
        Of the same type.
    """
    if not isinstance(problem, CompositeProblem):
        return replace(problem, plants=plant_set(plants, sampling, alike=True))
    decoupling, parts = problem.structure.decoupling, []
    units = replace(plants[0], omega_0=problem.plants.omega_0, force=problem.plants.force)
    plants = [in_units_of(plant, units) for plant in plants]
    for part in problem.parts:
        members, channel = [plants[i] for i in part.members], part.channel
        if channel is None:
            moved = plant_set(members, sampling, decoupling, alike=True)
        else:
            moved = plant_set(
                [channel_plant(one, decoupling, channel) for one in members], sampling, alike=True
            )
        parts.append(replace(part, problem=replace(part.problem, plants=moved)))
    return replace(problem, plants=parts[0].problem.plants, parts=tuple(parts))


def box_of(
    structure: Structure | ChannelStructure,
    poles: np.ndarray,
    omega_0: float,
    sampling: Sampling | None,
    frequencies: tuple[float, float] | None,
) -> Array:
    """Bounds (2, n) of κ in units of ω₀, as `problem_for` has them; `poles` of all plants there."""
    fastest = 30.0 * max(1.0, float(np.abs(poles).max()))
    if sampling is not None:
        fastest = min(fastest, 2.0 / (sampling.period * omega_0))
    span = (min(1e-3, 0.01 * fastest), fastest)
    if frequencies is not None:
        span = (frequencies[0] / omega_0, frequencies[1] / omega_0)
    return structure.bounds(span, (1e-6, 1e6), omega_0)


def _by_parts(function: Callable[[T], R], parts: Sequence[T]) -> list[R]:
    """[function(part), ...], side by side; that of the coupled plants, the last, takes longest."""
    return side_by_side(function, parts[::-1])[::-1]


@assess.register
def _(
    problem: CompositeProblem, kappa: Array, tau: float, *, each: bool = False, **rest: Any
) -> Assessment:
    def assessed(part: Part) -> Assessment:
        return assess(part.problem, kappa[part.place], tau + part.lead, each=each, **rest)

    found = _by_parts(assessed, problem.parts)
    widest = sum(one.poles.shape[1] for one in found)
    poles = np.full((problem.count, widest), -1.0, complex)  # stable where a plant has no pole
    at = 0
    for part, one in zip(problem.parts, found, strict=True):
        poles[part.members, at : at + one.poles.shape[1]] = one.poles
        at += one.poles.shape[1]
    seen = [one.stable for one in found]
    if not (any(seen) if each else all(seen)):
        return Assessment(False, poles, None, None)
    peaks, near = [], []
    for number, (part, one) in enumerate(zip(problem.parts, found, strict=True)):
        own, start = one.peaks, problem.rows_of(number)[0]
        if own is not None and one.near is not None:
            wide = own.to_kappa @ part.spread(len(kappa))
            peaks.append((own.curve, own.plant + start, own.v, own.value, wide, own.to_tau))
            near.append((one.near.curve, one.near.plant + start, one.near.v))
    columns = (map(np.concatenate, zip(*rows, strict=True)) for rows in (peaks, near))
    return Assessment(True, poles, Constraints(*next(columns)), RowPlaces(*next(columns)))


@constraints.register
def _(problem: CompositeProblem, kappa: Array, tau: float, at: RowPlaces) -> Constraints:
    (value, to_tau), to_kappa = np.zeros((2, len(at.v))), np.zeros((len(at.v), len(kappa)))
    for part, which, own in problem.split(at):
        inside = constraints(part.problem, kappa[part.place], tau + part.lead, own)
        value[which], to_tau[which] = inside.value, inside.to_tau
        to_kappa[which] = inside.to_kappa @ part.spread(len(kappa))
    return Constraints(at.curve, at.plant, at.v, value, to_kappa, to_tau)


@to_theta.register
def _(problem: CompositeProblem, kappa: Array, constraints: Constraints) -> Array:
    def sloped(split: tuple[Part, np.ndarray, Constraints]) -> Array:
        part, _, own = split
        return to_theta(part.problem, kappa[part.place], own)

    out = np.zeros((len(constraints.v), problem.plants.plants[0].dA.shape[0]))
    splits = problem.split(constraints)
    for (_, at, _), found in zip(splits, _by_parts(sloped, splits), strict=True):
        out[at] = found
    return out


@hessians.register
def _(
    problem: CompositeProblem,
    kappa: Array,
    tau: float,
    rows: Constraints,
    beside: Sequence[CompositeProblem] = (),
    **rest: Any,
) -> Array:
    k, n = len(beside), len(kappa)

    def bending(numbered: tuple[int, tuple[Part, np.ndarray, Constraints]]) -> Array:
        number, (part, _, own) = numbered
        place = np.concatenate([np.arange(k), k + part.place, [k + n]])
        spread = np.asarray(np.arange(k + n + 1) == place[:, None], float)
        near = [other.parts[number].problem for other in beside]
        inner = hessians(part.problem, kappa[part.place], tau + part.lead, own, near, **rest)
        return np.asarray(spread.T @ inner @ spread)

    out, splits = np.zeros((len(rows.v), k + n + 1, k + n + 1)), problem.split(rows)
    found = _by_parts(bending, list(enumerate(splits)))
    for (_, at, _), own in zip(splits, found, strict=True):
        out[at] = own
    return out


def answer_alike(
    a: Sequence[ScaledPlant], b: Sequence[ScaledPlant], *, tolerance: float = 1e-9
) -> bool:
    """Whether two channels' plants answer alike, to `tolerance` (relative), at enough frequencies
    to distinguish rational functions of their order."""
    first, second = plant_set(a), plant_set(b)
    if first.poles.shape != second.poles.shape:
        return False
    v = np.geomspace(1e-2, 1e2, 4 * first.poles.shape[1] + 1)
    which = np.repeat(np.arange(len(a)), len(v))
    v = np.tile(v, len(a))
    one, other = first.responses(which, v)[0], second.responses(which, v)[0]
    return bool((np.abs(one - other) <= tolerance * np.abs(one)).all())
