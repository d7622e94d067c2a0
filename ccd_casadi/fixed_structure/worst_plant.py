"""The worst plants of a box, searched; the run adds them to its set until none exceeds a bound.

    max over p in the box of  max_j c_j(κ, τ; p)

by compass searches from many points at once; of more than four parameters every peak of the loops
climbs on its own (`peak_climbs`), from a lattice and where modes meet. For what lies between there
is `box_proof`.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure.loop_on_box import Excess, LoopOnBox
from ccd_casadi.fixed_structure.meeting_modes import meetings
from ccd_casadi.fixed_structure.peak_climbs import climbed
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.support.arrays import Array

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
