"""The worst plants of a box, searched; the run adds them to its set until none exceeds a bound.

    max over p in the box of  max_j c_j(κ, τ; p)

by compass searches from many points at once. Of more than four parameters every peak of the loops
is climbed on its own, from the plant where it is highest: its c_j, made linear in p, points to a
corner of the box, and steps towards it are tried. Else a bound that all plants reach alike would
hide the rest. An unstable loop is worst of all. For what lies between there is `box_proof`.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import assess, to_theta
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopProblem
from ccd_casadi.fixed_structure.sections_design import in_problem_units
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array

WITHIN = 1e-4  # ln: by how much a plant of the box may pass a bound and count as within
UNSTABLE = 10.0  # ln: what an unstable loop counts as
LATTICE = 200  # plants, evenly over the box
UNDAMPED = 60  # of more than four parameters, which are not looked through evenly anyway
EVENLY = 4  # of so many plants one keeps its damping, the others have the least: peaks are sharp
ALONG = 61  # plants along each theta that varies, at every corner of the rest
SEARCHES = 6
ROUNDS = 7  # of a compass search, its step halved each time
FEW = 4  # parameters up to which every one is moved on its own
STEPS = (1.0, 0.3, 0.1, 0.03)  # towards the corner that a peak points to: ridges are narrow
PEAK = 0.1  # ln of the frequency: rows of one bound nearer than that are one peak
PEAKS, EACH = 40, 2  # that are climbed, the highest, each from its highest plants
BELOW = 0.1  # ln: how far below its bound such a peak may start
CLIMBS = 4  # rounds of them


@dataclass(frozen=True)
class Excess:
    """The largest c of one plant: (option, point), and its value in logarithms of its bound."""

    option: int
    point: Array
    value: float


@dataclass(frozen=True)
class Peak:
    """A peak of one plant's loop: its curve, ln of its frequency in rad/s, its c; and the largest
    c of that plant."""

    option: int
    point: Array
    curve: int
    log_omega: float
    own: float
    value: float


@dataclass(frozen=True)
class Rows:
    """The rows of many plants' loops: of which plant each is, its curve, ln ω and c."""

    plant: np.ndarray
    curve: np.ndarray
    log_omega: Array
    value: Array

    def nearest(self, plant: int, peak: Peak) -> int | None:
        """The row of a plant that is that peak now: the highest near by."""
        near = np.abs(self.log_omega - peak.log_omega) < PEAK
        rows = np.flatnonzero(near & (self.plant == plant) & (self.curve == peak.curve))
        return int(rows[np.argmax(self.value[rows])]) if len(rows) else None


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
        return self._looked_at(self.uncertain.plants(points))[0]

    def _looked_at(
        self, plants: Sequence[ScaledPlant]
    ) -> tuple[Array, LoopProblem, Constraints | None]:
        """The largest c of every plant's loop; the problem, and the constraints it is one of."""
        problem = problem_for(plants, self.structure, self.bounds, self.sampling)
        scaled = in_problem_units(problem, self.kappa)
        tau = float(np.log(self.bandwidth / problem.plants.omega_0))
        found = assess(problem, scaled, tau, each=True)
        out = np.full(len(plants), -np.inf)
        if found.peaks is not None:
            np.maximum.at(out, problem.plants_of(found.peaks), found.peaks.value - problem.margin)
        grown = (found.poles.real / np.abs(found.poles)).max(axis=1)  # of no unit
        value = np.where(grown < 0.0, out, UNSTABLE + np.maximum(grown, 0.0))
        return value, problem, found.peaks

    def worst_plants(self, seed: int = 0, count: int = LATTICE) -> tuple[list[Excess], int]:
        """The worst plants found, the worst first, and how many were looked at."""
        uncertain, n = self.uncertain, len(self.uncertain.names)
        if n > FEW:
            return self._climbed(min(count, UNDAMPED), seed)
        points = lattice(uncertain, count, seed)
        value = self.excesses(points)
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
            self._tried(heads, moves)
            looked, step = looked + len(moves), 0.5 * step
        return sorted(heads, key=lambda head: -head.value), looked

    def _tried(self, heads: list[Excess], steps: Sequence[tuple[int, Array]]) -> bool:
        """Moves heads by steps (a head's number, a point) that raise them; whether one by
        `WITHIN`."""
        before = [head.value for head in heads]
        ends = self.excesses([(heads[row].option, point) for row, point in steps]).tolist()
        for (row, point), end in zip(steps, ends, strict=True):
            if end > heads[row].value:
                heads[row] = Excess(heads[row].option, point, end)
        return any(head.value > value + WITHIN for head, value in zip(heads, before, strict=True))

    def _climbed(self, count: int, seed: int) -> tuple[list[Excess], int]:
        """`worst_plants` of many parameters: ascents of distinct peaks."""
        uncertain = self.uncertain
        own = np.array([name == "damping" for name in uncertain.names])
        points = [
            (option, np.where(own & (i % EVENLY > 0), uncertain.box[0], point))
            for i, (option, point) in enumerate(lattice(uncertain, count, seed))
        ]
        value, problem, peaks = self._looked_at(uncertain.plants(points))
        lost = np.flatnonzero(value >= UNSTABLE)
        ends = {points[i][0]: Excess(*points[i], float(value[i])) for i in lost[np.argsort(value[lost])]}
        heads, looked = _distinct(points, value, _rows(problem, peaks)), len(points)
        climbing = list(range(len(heads)))
        for _ in range(CLIMBS):
            steps = self._towards_corners([heads[i] for i in climbing])
            if not steps:
                break
            looked += len(steps)
            moved = self._highest([heads[i] for i in climbing], steps)
            before = [heads[i].own for i in climbing]
            for i, head in zip(climbing, moved, strict=True):
                heads[i] = head
            climbing = [
                i for i, own in zip(climbing, before, strict=True)
                if own + 0.1 * WITHIN < heads[i].own < UNSTABLE
            ]  # fmt: skip
        found = [*ends.values(), *(Excess(one.option, one.point, one.value) for one in heads)]
        return sorted(found, key=lambda head: -head.value), looked

    def _towards_corners(self, heads: Sequence[Peak]) -> list[tuple[int, Array]]:
        """Steps from every one: the head's number and the point."""
        if not heads:
            return []
        box = self.uncertain.box
        plants = [self.uncertain.sloped(head.point, head.option) for head in heads]
        _, problem, peaks = self._looked_at(plants)
        rows = _rows(problem, peaks)
        found = [(i, rows.nearest(i, head)) for i, head in enumerate(heads)]
        known = [(i, row) for i, row in found if row is not None]
        if peaks is None or not known:
            return []
        chosen = peaks.only(np.array([row for _, row in known]))
        slopes = to_theta(problem, in_problem_units(problem, self.kappa), chosen)
        steps: list[tuple[int, Array]] = []
        for (i, _), slope in zip(known, slopes, strict=True):
            point = heads[i].point
            corner = np.where(slope > 0.0, box[1], np.where(slope < 0.0, box[0], point))
            ahead = [point + step * (corner - point) for step in STEPS]
            steps += [(i, other) for other in ahead if (other != point).any()]
        return steps

    def _highest(self, heads: Sequence[Peak], steps: Sequence[tuple[int, Array]]) -> list[Peak]:
        """Every peak where it is highest: where it was, or after one of the steps from there."""
        plants = self.uncertain.plants([(heads[i].option, point) for i, point in steps])
        value, problem, peaks = self._looked_at(plants)
        rows, out = _rows(problem, peaks), list(heads)
        for number, (i, point) in enumerate(steps):
            largest, row = float(value[number]), rows.nearest(number, heads[i])
            own = largest if largest >= UNSTABLE else -np.inf if row is None else rows.value[row]
            if own > out[i].own:
                at = out[i].log_omega if row is None else float(rows.log_omega[row])
                out[i] = replace(out[i], point=point, log_omega=at, own=float(own), value=largest)
        return out


def _rows(problem: LoopProblem, peaks: Constraints | None) -> Rows:
    if peaks is None:
        return Rows(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))
    plants = problem.plants
    log_omega = np.log(plants.frequency(peaks.v) * plants.omega_0)
    return Rows(problem.plants_of(peaks), peaks.curve, log_omega, peaks.value - problem.margin)


def _distinct(points: Sequence[tuple[int, Array]], value: Array, rows: Rows) -> list[Peak]:
    """The peaks of all plants, each on that of every option where it is highest."""
    found, many = list[Peak](), Counter[tuple[int, ...]]()
    for row in np.argsort(-rows.value, kind="stable").tolist():
        own, of = float(rows.value[row]), int(rows.plant[row])
        if own < -BELOW or len(found) == PEAKS:
            break
        option, point = points[of]
        curve, log_omega = int(rows.curve[row]), float(rows.log_omega[row])
        key = option, curve, round(log_omega / PEAK)
        many[key] += 1
        if many[key] <= EACH:
            found.append(Peak(option, point, curve, log_omega, own, float(value[of])))
    return found
