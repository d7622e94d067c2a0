"""The worst plants of a box of many parameters: every peak of the loops climbs on its own.

From the plants where it is highest: its c_j, made linear in p, points to a corner of the box, and
steps towards it are tried. Were only the largest c of a plant to climb, a bound that all plants
reach alike, at a frequency below all modes, would hide the peaks of the modes.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.loop_on_box import UNSTABLE, WITHIN, Excess, LoopOnBox, Loops
from ccd_casadi.support.arrays import Array

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
