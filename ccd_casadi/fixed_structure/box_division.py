"""Branch and bound over frequency and uncertain parameters: the worst boxes are divided first.

A box is closed where every figure stays below 1 + `slack` times its bound. Parts keep what is
proven of their whole. What a given number of boxes does not close is still bounded.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.support.arrays import Array

AT_ONCE = 2_000  # boxes that are divided at a time, at most
BATCHES = 250  # of a share: a small one is spent on the worst boxes alone
STUCK = 0.25  # of its boxes still open: it would take many times as many to close them
DECADES = 6.0  # of frequency cells at the start, downwards; below is one cell to 0


@dataclass(frozen=True)
class Division:
    """What so many `boxes` prove: figures over bounds at most, by kind of bound.

    `passed`: a bound, by which factor it is passed at least on some box, and that one's middle.
    """

    levels: dict[str, float]
    boxes: int
    passed: tuple[str, float, tuple[float, ...]] | None = None


@dataclass(frozen=True)
class _Enclosed(Boxes):
    """With their figures over bounds at most (M, N), and what moves the loop there."""

    highest: Array
    spread: Array

    @property
    def worst(self) -> Array:
        return np.asarray(self.highest.max(axis=0))

    def levels(self, names: Sequence[str]) -> dict[str, float]:
        return dict(zip(names, self.highest.max(axis=1, initial=0.0).tolist(), strict=True))


def divided(family: LoopFamily, box: Array, slack: float, share: int, enough: int) -> Division:
    """Up to `share` boxes of the whole one (2, n); `enough` where too many of them stay open."""
    part, known, spent = _first(family, box), np.array(np.inf), 0
    levels: dict[str, float] = {}
    waiting: _Enclosed | None = None
    while True:
        with np.errstate(all="ignore"):  # of boxes that enclose nothing
            found = family.enclose(part)
        spent += len(part.chart)
        k, j = np.unravel_index(np.argmax(found.lowest), found.lowest.shape)
        if found.lowest[k, j] > 1.0 + slack:
            middle = tuple((0.5 * (part.low + part.high)[1:, j]).tolist())
            return Division({}, spent, (found.names[k], float(found.lowest[k, j]), middle))
        highest = np.minimum(found.highest, known)
        here = _Enclosed(part.chart, part.low, part.high, highest, found.spread)
        wide = here.worst > 1.0 + slack
        levels = raised(levels, here.only(~wide).levels(found.names))
        here = here.only(wide)
        waiting = here if waiting is None else waiting.beside(here)
        count = len(waiting.worst)
        if not count or spent >= share or (spent >= enough and count > STUCK * spent):
            return Division(raised(levels, waiting.levels(found.names)), spent)
        order = np.argsort(-waiting.worst, kind="stable")
        first = min(AT_ONCE, max(share // BATCHES, count // 4, 1))
        worst, waiting = waiting.only(order[:first]), waiting.only(order[first:])
        part, known = _halved(worst), np.tile(worst.highest, 2)


def raised(levels: Mapping[str, float], others: Mapping[str, float]) -> dict[str, float]:
    """The larger one of each."""
    names = dict.fromkeys([*levels, *others])
    return {name: max(levels.get(name, 0.0), others.get(name, 0.0)) for name in names}


def _first(family: LoopFamily, box: Array) -> Boxes:
    """Cells of frequency from 0 to infinity, or to half the sampling rate, over the whole box."""
    low, band = family.bounds.omega_low / family.unit, family.bandwidth / family.unit
    scale, top = 1.0, 1.0
    if family.period is not None:
        scale, top = family.period, np.pi
    edges = np.geomspace(10.0**-DECADES, 1.0, int(2 * DECADES) + 1) * top
    corner = min(family.corner / family.unit, 1.0)
    edges = np.unique(np.concatenate([[0.0], edges, np.array([low, band, corner]) * scale]))
    edges = edges[edges <= top]
    cells = [(Chart.LOW if family.period is None else Chart.SAMPLED, a, b)
             for a, b in itertools.pairwise(edges)]  # fmt: skip
    if family.period is None:
        steps = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 9)])
        cells += [(Chart.HIGH, a, b) for a, b in itertools.pairwise(steps)]
    cells.append((Chart.POINT, low * scale, low * scale))
    pieces = [np.array([[low], [high]]).T for low, high in box.T]
    for i, (low, high) in enumerate(box.T.tolist()):
        if 0.0 < 2.0 * low < high:  # a factor: its lowest values are found in pieces only
            ends = np.geomspace(low, high, int(np.ceil(np.log2(high / low))) + 1)
            pieces[i] = np.stack([ends[:-1], ends[1:]], axis=1)
    every = [*itertools.product(cells, *pieces)]
    chart = np.array([one[0][0] for one in every])
    ends = np.array([[one[0][1:], *one[1:]] for one in every], float)
    return Boxes(chart, ends[..., 0].T, ends[..., 1].T)


def _halved(boxes: _Enclosed) -> Boxes:
    """Each box halved along the coordinate that moves its loop most."""
    width = boxes.high - boxes.low
    size = np.maximum(np.abs(boxes.low), np.abs(boxes.high))
    fine = width > 1e-13 * np.maximum(size, 1e-300)
    score = np.where(fine, np.where(np.isfinite(boxes.spread), boxes.spread, width), -1.0)
    along = np.argmax(score, axis=0)
    rows = np.arange(len(along))
    a, b = boxes.low[along, rows], boxes.high[along, rows]
    middle = 0.5 * (a + b)
    wide = ((along == 0) | (a > 0.0)) & (b > 4.0 * a)
    with np.errstate(invalid="ignore"):
        middle = np.where(wide, np.where(a > 0.0, np.sqrt(a * b), 0.1 * b), middle)
    left, right = boxes.high.copy(), boxes.low.copy()
    left[along, rows] = right[along, rows] = middle
    return Boxes(
        np.concatenate([boxes.chart, boxes.chart]),
        np.concatenate([boxes.low, right], axis=1),
        np.concatenate([left, boxes.high], axis=1),
    )
