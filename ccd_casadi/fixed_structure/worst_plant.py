"""The worst plants of a box, searched from lattices, peaks and modes that meet."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.figures import assess, to_theta
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopProblem
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results


@dataclass(frozen=True)
class WorstPlantOptions:
    """Numbers of the search for the worst plants; levels are ln of a figure over its bound.

    Attributes
    ----------
    within : float
        By how much a plant of the box may exceed a bound and count as within.
    along, along_first : int
        Points along each parameter of the model that varies, and of a first look: only where that
        finds no plant beyond its bounds all of them are assessed.
    on_lines : int
        Of these points in all, at most: with many such parameters lines run through the models and
        evenly chosen corners of the rest.
    batch : int
        Plants that are assessed together: few, as a compass search moves to less than fifty, which
        all workers share.
    few : int
        Parameters up to which every one is moved separately: a compass search.
    lattice, searches, rounds : int
        Its plants over the box, starts from the worst of them, halvings of its step.
    lattice_of_many, damped_every : int
        With more parameters: plants; of so many one keeps its damping, the others have the least.
    steps : tuple of float
        Shares of the way to the corner that a peak points to: ridges are narrow.
    near : float
        ln of the frequency: closer rows of one curve are one peak.
    peaks, plants_of_peak, climbs : int
        That climb, the highest; from how many plants each; rounds.
    depth, least_gain : float
        How far below its bound a peak may start; a peak that gains less is at its end.
    """

    within: float = 1e-4
    along: int = 61
    along_first: int = 16
    on_lines: int = 4000
    batch: int = 8
    few: int = 4
    lattice: int = 200
    searches: int = 6
    rounds: int = 7
    lattice_of_many: int = 30
    damped_every: int = 4
    steps: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03)
    near: float = 0.1
    peaks: int = 40
    plants_of_peak: int = 2
    climbs: int = 4
    depth: float = 0.1
    least_gain: float = 1e-5


@dataclass(frozen=True)
class Excess:
    """The largest constraint of one plant.

    Attributes
    ----------
    option, point : int, array (n_p,)
        The plant.
    value : float
        ln of the largest figure over its bound.
    """

    option: int
    point: Array
    value: float


@dataclass(frozen=True)
class Loops:
    """The loops with some plants: the largest c of each; of every row of all of them the number of
    its plant, its curve, ln of its frequency in rad/s and its c."""

    problem: LoopProblem
    kappa: Array
    largest: Array
    rows: Constraints | None
    plant: np.ndarray
    curve: np.ndarray
    log_omega: Array
    value: Array

    def slopes(self, rows: np.ndarray) -> Array:
        """∂c/∂p (rows, parameters) of these rows, where the plants have slopes."""
        assert self.rows is not None
        return to_theta(self.problem, self.kappa, self.rows.only(rows))


@dataclass(frozen=True)
class LoopOnBox:
    """A controller on a box of plants, with the bounds that its loops have to keep.

    Attributes
    ----------
    uncertain, structure, kappa : UncertainPlant, Structure or ChannelStructure, array (n,)
        κ in SI.
    bandwidth : float
        ω_b, rad/s.
    bounds, sampling : Bounds, Sampling or None
    unstable : float
        ln: the excess that an unstable loop counts as, at least.
    """

    unstable: ClassVar[float] = 10.0

    uncertain: UncertainPlant
    structure: Structure | ChannelStructure
    kappa: Array
    bandwidth: float
    bounds: Bounds
    sampling: Sampling | None = None

    def excesses(self, points: Sequence[tuple[int, Array]], workers: Pool | None = None) -> Array:
        """The largest c of the loop with every plant, some of them at a time."""
        size = WorstPlantOptions.batch
        parts = {i: (self, points[i : i + size]) for i in range(0, len(points), size)}
        found = dict(results(workers, _largest, parts))
        return np.concatenate([found[i] for i in parts])

    def assess(self, plants: Sequence[ScaledPlant]) -> Loops:
        """The loops with these plants."""
        problem = problem_for(plants, self.structure, self.bounds, self.sampling)
        kappa, units = in_problem_units(problem, self.kappa), problem.plants
        found = assess(problem, kappa, float(np.log(self.bandwidth / units.omega_0)), each=True)
        largest, rows = np.full(len(plants), -np.inf), found.peaks
        plant, curve, log_omega, value = (np.zeros(0, kind) for kind in (int, int, float, float))
        if rows is not None:
            plant, curve, value = problem.plants_of(rows), rows.curve, rows.value - problem.margin
            log_omega = np.log(units.frequency(rows.v) * units.omega_0)
            np.maximum.at(largest, plant, value)
        grown = (found.poles.real / np.abs(found.poles)).max(axis=1)  # of no unit
        largest = np.where(grown < 0.0, largest, self.unstable + np.maximum(grown, 0.0))
        return Loops(problem, kappa, largest, rows, plant, curve, log_omega, value)


def _largest(loop: LoopOnBox, points: Sequence[tuple[int, Array]]) -> Array:
    return loop.assess(loop.uncertain.plants(points)).largest


def meetings(
    uncertain: UncertainPlant, *, shares: tuple[float, ...] = (0.02, 0.5, 0.98),
    least_cosine: float = 0.3, same: float = 1e-9,
) -> list[tuple[int, Array]]:  # fmt: skip
    """Points (option, p) where two modes meet, all others as the model's, with the least
    damping.

    They meet at `shares` of the frequencies that both may have. Modes of shapes less alike than
    `least_cosine` are left out, and double ones (to `same`, relative), which meet without a shift.
    """
    shift, names = uncertain.mode_shift, list(uncertain.names)
    if not shift:
        return []
    first, middle = names.index("mode_shift 1"), uncertain.nominal
    middle[[name == "damping" for name in names]] = uncertain.damping[0]
    found: list[tuple[int, Array]] = []
    for option in range(len(uncertain.options)):
        modal = uncertain.modal(option)
        numbers = modal.numbered
        omega = np.sqrt(np.diag(modal.K)[numbers])
        alike = _cosines(modal.B[numbers]) * _cosines(modal.C[:, numbers].T)
        for i, j in combinations(range(len(omega)), 2):
            own = omega[[i, j]]
            low, high = (1.0 - shift) * own.max(), (1.0 + shift) * own.min()
            if low >= high or alike[i, j] <= least_cosine or np.ptp(own) <= same * high:
                continue
            for share in shares:
                point = middle.copy()
                point[[first + i, first + j]] = (low + share * (high - low)) / own - 1.0
                found.append((option, point))
    return found


def _cosines(rows: Array) -> Array:
    """|cos| of the angle between every two rows."""
    unit = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    return np.abs(unit @ unit.T)


@dataclass(frozen=True)
class Peak:
    """A peak of one plant's loop: its curve, ln of its frequency in rad/s, its c."""

    option: int
    point: Array
    curve: int
    log_omega: float
    value: float

    def row_of(self, loops: Loops, plant: int, within: float) -> int | None:
        """The row of a plant that is this peak there: the highest `within` it in ln ω."""
        near = np.abs(loops.log_omega - self.log_omega) < within
        rows = np.flatnonzero(near & (loops.plant == plant) & (loops.curve == self.curve))
        return int(rows[np.argmax(loops.value[rows])]) if len(rows) else None


def climb(
    loop: LoopOnBox, points: Sequence[tuple[int, Array]],
    options: WorstPlantOptions = WorstPlantOptions(),
) -> tuple[list[Excess], int]:  # fmt: skip
    """The worst plants found from these points (option, point) on, the worst first, and how many
    were assessed; of those within every bound the worst alone."""
    loops = loop.assess(loop.uncertain.plants(points))
    peaks, examined = _distinct(points, loops, options), len(points)
    ends: list[Peak] = []
    for _ in range(options.climbs):
        steps = _towards_corners(loop, peaks, options)
        if not steps:
            break
        examined += len(steps)
        moved = _move_peaks(loop, peaks, steps, options.near)
        rising = [after.value > before.value + options.least_gain
                  and after.value < loop.unstable
                  for before, after in zip(peaks, moved, strict=True)]  # fmt: skip
        ends += [peak for peak, on in zip(moved, rising, strict=True) if not on]
        peaks = [peak for peak, on in zip(moved, rising, strict=True) if on]
    ends += peaks
    ends.sort(key=lambda end: -end.value)
    lost = [Excess(*points[i], float(loops.largest[i])) for i in _unstable(loops)]
    over = [end for end in ends if end.value > 0.0] or ends[:1]
    found = [*lost, *_apart(loop, over, options)]
    return sorted(found, key=lambda end: -end.value), examined


def _apart(loop: LoopOnBox, peaks: Sequence[Peak], options: WorstPlantOptions) -> list[Excess]:
    """The plants of these peaks, the highest first, without those whose peak is as high on one
    before it."""
    if not peaks:
        return []
    loops = loop.assess(loop.uncertain.plants([(peak.option, peak.point) for peak in peaks]))
    found: list[int] = []
    for i, peak in enumerate(peaks):
        alike = [j for j in found if peaks[j].option == peak.option]
        rows = [peak.row_of(loops, j, options.near) for j in alike]
        if all(row is None or loops.value[row] < peak.value - options.within for row in rows):
            found.append(i)
    return [Excess(peaks[i].option, peaks[i].point, float(loops.largest[i])) for i in found]


def _unstable(loops: Loops) -> list[int]:
    return np.flatnonzero(loops.largest >= LoopOnBox.unstable).tolist()


def _distinct(
    points: Sequence[tuple[int, Array]], loops: Loops, options: WorstPlantOptions
) -> list[Peak]:
    """The highest peaks, those of every option apart, each on the plants where it is highest."""
    found, many = list[Peak](), Counter[tuple[int, int, int]]()
    for row in np.argsort(-loops.value, kind="stable").tolist():
        value, plant = float(loops.value[row]), int(loops.plant[row])
        if found and (value < -options.depth or len(found) == options.peaks):
            break
        option, point = points[plant]
        curve, log_omega = int(loops.curve[row]), float(loops.log_omega[row])
        key = option, curve, round(log_omega / options.near)
        many[key] += 1
        if many[key] <= options.plants_of_peak:
            found.append(Peak(option, point, curve, log_omega, value))
    return found


def _towards_corners(
    loop: LoopOnBox, peaks: Sequence[Peak], options: WorstPlantOptions
) -> list[tuple[int, Array]]:
    """Steps from every peak: its number and the point."""
    if not peaks:
        return []
    box = loop.uncertain.box
    loops = loop.assess([loop.uncertain.with_slopes(peak.point, peak.option) for peak in peaks])
    found = (peak.row_of(loops, i, options.near) for i, peak in enumerate(peaks))
    rows = {i: row for i, row in enumerate(found) if row is not None}
    if not rows:
        return []
    steps: list[tuple[int, Array]] = []
    for i, slope in zip(rows, loops.slopes(np.array(list(rows.values()))), strict=True):
        point = peaks[i].point
        corner = np.where(slope > 0.0, box[1], np.where(slope < 0.0, box[0], point))
        ahead = [point + step * (corner - point) for step in options.steps]
        steps += [(i, other) for other in ahead if (other != point).any()]
    return steps


def _move_peaks(
    loop: LoopOnBox, peaks: Sequence[Peak], steps: Sequence[tuple[int, Array]], near: float
) -> list[Peak]:
    """Every peak where it is highest: where it was, or after one of the steps from there."""
    loops = loop.assess(loop.uncertain.plants([(peaks[i].option, point) for i, point in steps]))
    out = list(peaks)
    for number, (i, point) in enumerate(steps):
        largest, row = float(loops.largest[number]), peaks[i].row_of(loops, number, near)
        if largest >= loop.unstable:
            value, at = largest, out[i].log_omega
        elif row is not None:
            value, at = float(loops.value[row]), float(loops.log_omega[row])
        else:
            continue
        if value > out[i].value:
            out[i] = replace(out[i], point=point, log_omega=at, value=value)
    return out


def lattice(
    uncertain: UncertainPlant,
    count: int,
    seed: int,
    *,
    along: int = WorstPlantOptions.along,
    on_lines: int = WorstPlantOptions.on_lines,
) -> list[tuple[int, Array]]:
    """Spread plants over the box: corners, lines along ranges, and a Latin hypercube.

    Parameters
    ----------
    uncertain : UncertainPlant
    count, seed : int
        Points of the hypercube, the options in turn; evenly on one parameter.
    along : int
        Points along each parameter of the model that varies, at every corner of the others.
    on_lines : int
        Of these in all, at most: else at fewer corners.

    Returns
    -------
    list of (option, point)
        The corners of every option first.
    """
    box, n = uncertain.box, len(uncertain.names)
    found = uncertain.corners()
    models, others = found[: len(uncertain.options)], found[len(uncertain.options) :]
    lines = on_lines // max(1, along * len(uncertain.ranges)) - len(models)
    through = [*models, *others[:: -(-len(others) // max(1, lines)) or 1]]
    for row in range(n - len(uncertain.ranges), n):  # along a stroke what is worst comes and goes
        found += [
            (option, np.where(np.arange(n) == row, value, corner))
            for option, corner in through
            for value in np.linspace(box[0, row], box[1, row], along)
        ]
    if n == 0:
        return found
    if n == 1:
        unit = np.linspace(0.0, 1.0, count)[:, None]
    else:  # a Latin hypercube
        rng = np.random.default_rng(seed)
        cells = rng.permuted(np.tile(np.arange(count), (n, 1)), axis=1).T
        unit = (cells + rng.random((count, n))) / count
    points = box[0] + unit * (box[1] - box[0])
    share = max(1, len(uncertain.options))
    return found + [(i % share, point) for i, point in enumerate(points)]


def worst_plants(
    loop: LoopOnBox, seed: int = 0, count: int = WorstPlantOptions.lattice,
    options: WorstPlantOptions = WorstPlantOptions(), workers: Pool | None = None,
    along: int = WorstPlantOptions.along,
) -> tuple[list[Excess], int]:  # fmt: skip
    """Search the worst plants of a box.

    Of few parameters by compass searches from a lattice; of many by climbs of the highest peaks,
    along their slopes to the corners, from a lattice and from modes that meet.

    Parameters
    ----------
    loop, seed : LoopOnBox, int
    count : int
        Plants of the lattice, of many parameters `options.lattice_of_many` at most.
    options, workers : WorstPlantOptions, Pool
    along : int
        As of `lattice`.

    Returns
    -------
    found : list of Excess
        The worst first.
    assessed : int
        How many plants were assessed.
    """
    uncertain, n = loop.uncertain, len(loop.uncertain.names)
    if n > options.few:
        points = lattice(uncertain, min(count, options.lattice_of_many), seed, along=along)
        points = _sharp(uncertain, points, options.damped_every)
        return climb(loop, [*points, *meetings(uncertain)], options)
    points = lattice(uncertain, count, seed, along=along)
    value = loop.excesses(points, workers)
    examined, first = len(points), np.argsort(-value)[: options.searches]
    heads = [Excess(points[i][0], points[i][1], float(value[i])) for i in first]
    if n == 0:
        return heads, examined
    box = uncertain.box
    step = 0.25 * (box[1] - box[0]) if n > 1 else (box[1] - box[0]) / count
    for _ in range(options.rounds):
        moves = [
            (row, np.clip(head.point + sign * step * unit, *box))
            for row, head in enumerate(heads)
            for unit in np.eye(n)
            for sign in (1.0, -1.0)
        ]
        # At an end of the box half of them lead nowhere.
        moves = [(row, point) for row, point in moves if (point != heads[row].point).any()]
        places = [(heads[row].option, point) for row, point in moves]
        ends = loop.excesses(places, workers).tolist()
        for (row, point), end in zip(moves, ends, strict=True):
            if end > heads[row].value:
                heads[row] = Excess(heads[row].option, point, end)
        examined, step = examined + len(moves), 0.5 * step
    return sorted(heads, key=lambda head: -head.value), examined


def _sharp(
    uncertain: UncertainPlant, points: Sequence[tuple[int, Array]], every: int
) -> list[tuple[int, Array]]:
    """These points, one in `every` as it is, the others with the least damping: peaks are sharp."""
    own = np.array([name == "damping" for name in uncertain.names])
    return [
        (option, np.where(own & (i % every > 0), uncertain.box[0], point))
        for i, (option, point) in enumerate(points)
    ]
