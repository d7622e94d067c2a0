"""The worst plants of a box, searched; the run adds them to its set until none exceeds a bound.

    max over p in the box of  max_j c_j(κ, τ; p)

by compass searches from many points at once, of more than four parameters by ascent: each of the
largest c_j of a plant, made linear in p, points to a corner of the box, and steps towards these
corners are tried. An unstable loop is worst of all. For what lies between there is `box_proof`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

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
UNDAMPED = 120  # of more than four parameters, which are not looked through evenly anyway
EVENLY = 4  # of so many plants one keeps its damping, the others have the least: peaks are sharp
ALONG = 61  # plants along each theta that varies, at every corner of the rest
SEARCHES = 6
ROUNDS = 7  # of a compass search, its step halved each time
FEW = 4  # parameters up to which every one is moved on its own
LARGEST = 2  # constraints of a plant that are followed
STEPS = (1.0, 0.3, 0.1, 0.03)  # towards the corner that a constraint points to: ridges are narrow
PEAK = 0.1  # ln of the frequency: rows of one bound nearer than that are one peak
CLIMBS = 4  # rounds of them


@dataclass(frozen=True)
class Excess:
    """The largest c of one plant: (option, point), and its value in logarithms of its bound."""

    option: int
    point: Array
    value: float


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
        """`worst_plants` of many parameters: ascents from the worst plants of distinct peaks."""
        uncertain = self.uncertain
        own = np.array([name == "damping" for name in uncertain.names])
        points = [
            (option, np.where(own & (i % EVENLY > 0), uncertain.box[0], point))
            for i, (option, point) in enumerate(lattice(uncertain, count, seed))
        ]
        value, problem, peaks = self._looked_at(uncertain.plants(points))
        found = dict[tuple[int, ...], Excess]()
        for i in np.argsort(-value).tolist():
            option, point = points[i]
            key: tuple[int, ...] = (option, -i)
            if peaks is not None and -np.inf < value[i] < UNSTABLE:
                rows = np.flatnonzero(problem.plants_of(peaks) == i)
                row = rows[np.argmax(peaks.value[rows])]
                key = (option, int(peaks.curve[row]), round(float(np.log(peaks.v[row])) / PEAK))
            found.setdefault(key, Excess(option, point, float(value[i])))
        heads, looked = list(found.values())[:SEARCHES], len(points)
        for _ in range(CLIMBS):
            steps = self._towards_corners(heads)
            if not steps:
                break
            looked += len(steps)
            if not self._tried(heads, steps):
                break
        return sorted(heads, key=lambda head: -head.value), looked

    def _towards_corners(self, heads: Sequence[Excess]) -> list[tuple[int, Array]]:
        """Steps from every head that is stable: the head's number and the point."""
        box = self.uncertain.box
        plants = [self.uncertain.sloped(head.point, head.option) for head in heads]
        _, problem, peaks = self._looked_at(plants)
        if peaks is None:
            return []
        of = problem.plants_of(peaks)
        chosen = [
            own[np.argsort(-peaks.value[own])[:LARGEST]]
            for own in (np.flatnonzero(of == row) for row in range(len(heads)))
        ]
        rows = np.concatenate(chosen)
        slopes = to_theta(problem, in_problem_units(problem, self.kappa), peaks.only(rows))
        found: list[tuple[int, Array]] = []
        for row, slope in zip(of[rows].tolist(), slopes, strict=True):
            head = heads[row]
            corner = np.where(slope > 0.0, box[1], np.where(slope < 0.0, box[0], head.point))
            for step in STEPS:
                point = head.point + step * (corner - head.point)
                if np.abs(point - head.point).max() > 0.0:
                    found.append((row, point))
        return found
