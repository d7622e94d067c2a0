"""The worst plants of a box, searched from lattices, peaks and modes that meet."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

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

WITHIN = 1e-4  # ln: by how much a plant of the box may pass a bound and count as within
UNSTABLE = 10.0  # ln: what an unstable loop counts as


@dataclass(frozen=True)
class Excess:
    """The largest c of one plant: (option, point), and its value in logarithms of its bound."""

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
    """A controller κ in SI with its ω_b (rad/s) on a box of plants, and the bounds that its loops
    have to keep."""

    uncertain: UncertainPlant
    structure: Structure | ChannelStructure
    kappa: Array
    bandwidth: float
    bounds: Bounds
    sampling: Sampling | None = None

    def excesses(self, points: Sequence[tuple[int, Array]]) -> Array:
        """The largest c of the loop with every plant."""
        return self.assessed(self.uncertain.plants(points)).largest

    def assessed(self, plants: Sequence[ScaledPlant]) -> Loops:
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
        largest = np.where(grown < 0.0, largest, UNSTABLE + np.maximum(grown, 0.0))
        return Loops(problem, kappa, largest, rows, plant, curve, log_omega, value)


ALIKE = 0.3
ALIGNED = (0.02, 0.5, 0.98)  # where they meet, in shares of the frequencies that both may have
SAME = 1e-9  # relative: frequencies of one double mode, which meet without a shift


def meetings(uncertain: UncertainPlant) -> list[tuple[int, Array]]:
    """Points (option, p) where two modes meet, all others as the model's, with the least
    damping."""
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
            if low >= high or alike[i, j] <= ALIKE or np.ptp(own) <= SAME * high:
                continue
            for share in ALIGNED:
                point = middle.copy()
                point[[first + i, first + j]] = (low + share * (high - low)) / own - 1.0
                found.append((option, point))
    return found


def _cosines(rows: Array) -> Array:
    """|cos| of the angle between every two rows."""
    unit = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    return np.abs(unit @ unit.T)


STEPS = (1.0, 0.3, 0.1, 0.03)  # towards the corner that a peak points to: ridges are narrow
NEAR = 0.1  # ln of the frequency: rows of one curve nearer than that are one peak
PEAKS, EACH = 40, 2  # that climb, the highest, and from how many plants each
BELOW = 0.1  # ln: how far below its bound a peak may start
CLIMBS = 4  # rounds of them
LEAST = 0.1 * WITHIN  # ln: a peak that gains less has arrived


@dataclass(frozen=True)
class Peak:
    """A peak of one plant's loop: its curve, ln of its frequency in rad/s, its c; and the largest c
    of that plant."""

    option: int
    point: Array
    curve: int
    log_omega: float
    value: float
    largest: float

    def row_of(self, loops: Loops, plant: int) -> int | None:
        """The row of a plant that is this peak there: the highest near it."""
        near = np.abs(loops.log_omega - self.log_omega) < NEAR
        rows = np.flatnonzero(near & (loops.plant == plant) & (loops.curve == self.curve))
        return int(rows[np.argmax(loops.value[rows])]) if len(rows) else None


def climbed(loop: LoopOnBox, points: Sequence[tuple[int, Array]]) -> tuple[list[Excess], int]:
    """The worst plants found from these points (option, point) on, the worst first, and how many
    were looked at; of those within every bound the worst alone."""
    loops = loop.assessed(loop.uncertain.plants(points))
    peaks, looked = _distinct(points, loops), len(points)
    ends: list[Peak] = []
    for _ in range(CLIMBS):
        steps = _towards_corners(loop, peaks)
        if not steps:
            break
        looked += len(steps)
        moved = _moved(loop, peaks, steps)
        rising = [after.value > before.value + LEAST and after.value < UNSTABLE
                  for before, after in zip(peaks, moved, strict=True)]  # fmt: skip
        ends += [peak for peak, on in zip(moved, rising, strict=True) if not on]
        peaks = [peak for peak, on in zip(moved, rising, strict=True) if on]
    ends += peaks
    ends.sort(key=lambda end: -end.value)
    lost = [Excess(*points[i], float(loops.largest[i])) for i in _unstable(loops)]
    found = [*lost, *_apart(loop, [end for end in ends if end.value > 0.0] or ends[:1])]
    return sorted(found, key=lambda end: -end.value), looked


def _apart(loop: LoopOnBox, peaks: Sequence[Peak]) -> list[Excess]:
    """The plants of these peaks, the highest first, without those whose peak is as high on one
    before it."""
    if not peaks:
        return []
    loops = loop.assessed(loop.uncertain.plants([(peak.option, peak.point) for peak in peaks]))
    found: list[int] = []
    for i, peak in enumerate(peaks):
        rows = [peak.row_of(loops, j) for j in found if peaks[j].option == peak.option]
        if all(row is None or loops.value[row] < peak.value - WITHIN for row in rows):
            found.append(i)
    return [Excess(peaks[i].option, peaks[i].point, float(loops.largest[i])) for i in found]


def _unstable(loops: Loops) -> list[int]:
    return np.flatnonzero(loops.largest >= UNSTABLE).tolist()


def _distinct(points: Sequence[tuple[int, Array]], loops: Loops) -> list[Peak]:
    """The highest peaks, those of every option apart, each on the plants where it is highest."""
    found, many = list[Peak](), Counter[tuple[int, int, int]]()
    for row in np.argsort(-loops.value, kind="stable").tolist():
        value, plant = float(loops.value[row]), int(loops.plant[row])
        if found and (value < -BELOW or len(found) == PEAKS):
            break
        option, point = points[plant]
        curve, log_omega = int(loops.curve[row]), float(loops.log_omega[row])
        key = option, curve, round(log_omega / NEAR)
        many[key] += 1
        if many[key] <= EACH:
            largest = float(loops.largest[plant])
            found.append(Peak(option, point, curve, log_omega, value, largest))
    return found


def _towards_corners(loop: LoopOnBox, peaks: Sequence[Peak]) -> list[tuple[int, Array]]:
    """Steps from every peak: its number and the point."""
    if not peaks:
        return []
    box = loop.uncertain.box
    loops = loop.assessed([loop.uncertain.sloped(peak.point, peak.option) for peak in peaks])
    rows = {i: row for i, peak in enumerate(peaks) if (row := peak.row_of(loops, i)) is not None}
    if not rows:
        return []
    steps: list[tuple[int, Array]] = []
    for i, slope in zip(rows, loops.slopes(np.array(list(rows.values()))), strict=True):
        point = peaks[i].point
        corner = np.where(slope > 0.0, box[1], np.where(slope < 0.0, box[0], point))
        ahead = [point + step * (corner - point) for step in STEPS]
        steps += [(i, other) for other in ahead if (other != point).any()]
    return steps


def _moved(
    loop: LoopOnBox, peaks: Sequence[Peak], steps: Sequence[tuple[int, Array]]
) -> list[Peak]:
    """Every peak where it is highest: where it was, or after one of the steps from there."""
    loops = loop.assessed(loop.uncertain.plants([(peaks[i].option, point) for i, point in steps]))
    out = list(peaks)
    for number, (i, point) in enumerate(steps):
        largest, row = float(loops.largest[number]), peaks[i].row_of(loops, number)
        if largest >= UNSTABLE:
            value, at = largest, out[i].log_omega
        elif row is not None:
            value, at = float(loops.value[row]), float(loops.log_omega[row])
        else:
            continue
        if value > out[i].value:
            out[i] = replace(out[i], point=point, log_omega=at, value=value, largest=largest)
    return out


LATTICE = 200  # plants, evenly over the box
UNDAMPED = 30  # of more than four parameters, which are not looked through evenly anyway
EVENLY = 4  # of so many plants one keeps its damping, the others have the least: peaks are sharp
ALONG = 61  # plants along each theta that varies, at every corner of the rest
SEARCHES = 6
ROUNDS = 7  # of a compass search, its step halved each time
FEW = 4  # parameters up to which every one is moved on its own


def lattice(uncertain: UncertainPlant, count: int, seed: int) -> list[tuple[int, Array]]:
    """About `count` points over the box of every option, its corners among them."""
    box, n = uncertain.box, len(uncertain.names)
    found = uncertain.corners()
    for row in range(n - len(uncertain.ranges), n):  # along a stroke what is worst comes and goes
        found += [
            (option, np.where(np.arange(n) == row, value, corner))
            for option, corner in uncertain.corners()
            for value in np.linspace(box[0, row], box[1, row], ALONG)
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


def worst_plants(loop: LoopOnBox, seed: int = 0, count: int = LATTICE) -> tuple[list[Excess], int]:
    """The worst plants found, the worst first, and how many were looked at."""
    uncertain, n = loop.uncertain, len(loop.uncertain.names)
    if n > FEW:
        points = _sharp(uncertain, lattice(uncertain, min(count, UNDAMPED), seed))
        return climbed(loop, [*points, *meetings(uncertain)])
    points = lattice(uncertain, count, seed)
    value = loop.excesses(points)
    looked, first = len(points), np.argsort(-value)[:SEARCHES]
    heads = [Excess(points[i][0], points[i][1], float(value[i])) for i in first]
    if n == 0:
        return heads, looked
    box = uncertain.box
    step = 0.25 * (box[1] - box[0]) if n > 1 else (box[1] - box[0]) / count
    for _ in range(ROUNDS):
        moves = [
            (row, np.clip(head.point + sign * step * unit, *box))
            for row, head in enumerate(heads)
            for unit in np.eye(n)
            for sign in (1.0, -1.0)
        ]
        # At an end of the box half of them lead nowhere.
        moves = [(row, point) for row, point in moves if (point != heads[row].point).any()]
        ends = loop.excesses([(heads[row].option, point) for row, point in moves]).tolist()
        for (row, point), end in zip(moves, ends, strict=True):
            if end > heads[row].value:
                heads[row] = Excess(heads[row].option, point, end)
        looked, step = looked + len(moves), 0.5 * step
    return sorted(heads, key=lambda head: -head.value), looked


def _sharp(
    uncertain: UncertainPlant, points: Sequence[tuple[int, Array]]
) -> list[tuple[int, Array]]:
    """These points, most of them with the least damping."""
    own = np.array([name == "damping" for name in uncertain.names])
    return [
        (option, np.where(own & (i % EVENLY > 0), uncertain.box[0], point))
        for i, (option, point) in enumerate(points)
    ]
