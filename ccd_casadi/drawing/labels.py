"""Words in a figure that do not meet: each label takes the first free place of several."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.drawing.content import Level, Mark, Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = 9.0  # pt
LETTER, LINE = 0.62 * SIZE, 1.25 * SIZE  # pt; DejaVu Sans, the widest that a page may take
HANDLE = 3.6 * SIZE  # pt beside the words of a legend
POINT = 3.0  # pt; half a marker
# places beside a point, in pt, after the one that was asked for
AROUND = ((0, 7), (8, 3), (-8, 3), (0, -7), (8, -5), (-8, -5), (0, 20), (12, 16), (-12, 16),
          (0, -20), (12, -18), (-12, -18))  # fmt: skip
FAR = 16.0  # pt from a point to its words, from where on a line leads to it
SHARES = (0.0, 0.2, 0.45, 0.75, 0.1, 0.3, 0.6, 0.9)  # of a line's length where words may begin
APART = 2.0  # pt between the points that a curve is looked at by

Box = tuple[float, float, float, float]  # left, bottom, right, top in pt


@dataclass(frozen=True)
class Put:
    """Words at an offset in pt from a point of the data.

    `held`: whether they belong to its x and to its y; `upright`: turned by 90°.
    """

    text: str
    x: float
    y: float
    dx: float
    dy: float
    colour: str
    held: tuple[bool, bool] = (True, True)
    upright: bool = False

    @property
    def across(self) -> str:
        """The side of the words that is at the offset."""
        return "center" if self.dx == 0 else "left" if self.dx > 0 else "right"

    @property
    def up(self) -> str:
        """The end of the words that is at the offset."""
        return "bottom" if self.dy >= 0 else "top"

    @property
    def far(self) -> bool:
        """Whether a line leads from the words to their point."""
        return all(self.held) and abs(self.dy) >= FAR


def inside(axes: "Axes") -> Box:
    """The axes themselves in pt, from the lower left corner of the figure."""
    box, scale = axes.get_window_extent(), 72.0 / axes.figure.dpi
    return scale * box.x0, scale * box.y0, scale * box.x1, scale * box.y1


def legend_height(names: Sequence[str]) -> float:
    """Return the height of a legend of these names, in pt."""
    return LINE * (len(names) + 0.8)


def scales_of(axes: "Axes", log_x: bool = False, log_y: bool = False) -> list[list[float]]:
    """Return the scales of both axes for the page's scripts: their ends, whether logarithmic, and
    where these are in pt from the top left."""
    box, tall = inside(axes), 72.0 * axes.figure.bbox.height / axes.figure.dpi
    ends = (
        (axes.get_xlim(), log_x, box[0], box[2]),
        (axes.get_ylim(), log_y, tall - box[1], tall - box[3]),
    )
    return [[*map(float, limits), int(log), round(a, 3), round(b, 3)] for limits, log, a, b in ends]


def in_points(axes: "Axes", x: Any, y: Any) -> np.ndarray:
    """Points (k, 2) of the data in pt, from the lower left corner of the figure."""
    return axes.transData.transform(np.column_stack([x, y])) * 72.0 / axes.figure.dpi


class Labels:
    """The places of the words of one panel.

    A label takes a place off the curves where there is one. Without a place that hides no other
    label it is left out: the data of every figure are in the table below it. Widths are those of
    DejaVu Sans by a rule of thumb, as the browser chooses the font.

    Parameters
    ----------
    panel : Panel
    box : tuple of float
        Of its axes, pt.
    points : callable
        (x, y) of the data -> places (k, 2), pt.
    ranges : sequence of (low, high)
        Of both axes.
    """

    def __init__(
        self, panel: Panel, box: Box, points: Callable[[Any, Any], np.ndarray],
        ranges: Sequence[tuple[float, float]],
    ) -> None:  # fmt: skip
        self._panel, self._inside, self._points, self._ranges = panel, box, points, ranges
        self._taken: list[Box] = []
        self._curves = np.empty((0, 2))
        for curve in panel.curves:
            self._avoid(curve.x, curve.y, joined=bool(curve.line))
        for level in panel.levels:
            one, ends = [level.value] * 2, ranges[level.vertical]
            x, y = (one, ends) if level.vertical else (ranges[0], one)
            self._avoid(x, y, apart=4.0 * APART)
        for mark in panel.marks:
            a, b = self._at(mark.x, mark.y)
            self._taken.append((a - POINT, b - POINT, a + POINT, b + POINT))

    def corner(self, names: Sequence[str]) -> tuple[str, float]:
        """The place of a legend of these names that covers least, and how much it covers; nothing
        lies over it then."""
        boxes = self._corners(names)
        covered = self._count_covered(list(boxes.values()))
        costs = {where: float(n) + sum(_meet(box, one) for one in self._taken)
                 for (where, box), n in zip(boxes.items(), covered, strict=True)}  # fmt: skip
        where = min(costs, key=lambda each: costs[each])
        self._taken.append(boxes[where])
        return where, costs[where]

    def words(self) -> list[Put]:
        """Place the words of the marks and then of the levels, as far as there is a place for
        them."""
        found = [self._beside(mark) for mark in self._panel.marks if mark.text]
        found += [self._along(level) for level in self._panel.levels if level.text]
        return [put for put in found if put is not None]

    def _corners(self, names: Sequence[str]) -> dict[str, Box]:
        left, bottom, right, top = self._inside
        wide, tall = LETTER * max(map(len, names)), legend_height(names)
        wide += HANDLE if len(names) > 1 else LETTER
        middle = 0.5 * (left + right - wide)
        across = {"right": right - wide, "left": left, "center": middle}
        up = {"upper": top - tall, "lower": bottom, "center": 0.5 * (bottom + top - tall)}
        return {f"{v} {h}": (x, y, x + wide, y + tall) for v, y in up.items()
                for h, x in across.items() if v != h}  # fmt: skip

    def _avoid(self, x: Any, y: Any, joined: bool = True, apart: float = APART) -> None:
        """Labels keep off this curve, or its points alone; less off one with points far `apart`."""
        points = self._points(x, y)
        left, bottom, right, top = self._inside
        shown = np.isfinite(points).all(axis=1)
        points = np.clip(points[shown], (left - 99.0, bottom - 99.0), (right + 99.0, top + 99.0))
        if joined and len(points) > 1:  # as many points as are this far apart, along its length
            along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
            at = np.arange(0.0, along[-1], apart)
            points = np.column_stack([np.interp(at, along, points[:, k]) for k in range(2)])
        self._curves = np.vstack([self._curves, points])

    def _beside(self, mark: Mark) -> Put | None:
        """Place words beside a point, at its own offset in pt if that is free."""
        a, b = self._at(mark.x, mark.y)
        wide = LETTER * len(mark.text)
        places = []
        for dx, dy in (mark.offset, *AROUND):
            left = a + dx - (0.5 * wide if dx == 0 else wide if dx < 0 else 0.0)
            bottom = b + dy - (LINE if dy < 0 else 0.0)
            put = Put(mark.text, mark.x, mark.y, dx, dy, mark.colour)
            places.append(((left, bottom, left + wide, bottom + LINE), put))
        return self._best(places)

    def _along(self, level: Level) -> Put | None:
        """Place words at a line across the axes; upright beside a vertical one, or level with a
        place on it where that alone keeps off the curves."""
        (left, bottom, right, top), vertical = self._inside, level.vertical
        corner = [low for low, _ in self._ranges]
        corner[not vertical] = level.value
        line = self._at(*corner)[not vertical]
        start, end = (bottom + 4.0, top) if vertical else (left + 3.0, right)
        wide = LETTER * len(level.text)
        places = []
        for long, across in ((wide, LINE), (LINE, wide))[: 1 + vertical]:
            for share in SHARES:
                for side in (2.0, -2.0):
                    a, b = start + share * (end - start), line + side - across * (side < 0)
                    box = (a, b, a + long, b + across)
                    off = a - (bottom if vertical else left), side
                    if vertical:
                        box, off = (b, a, b + across, a + long), off[::-1]
                    held, upright = (vertical, not vertical), vertical and long == wide
                    x, y, (dx, dy) = *corner, off
                    put = Put(level.text, x, y, dx, dy, level.colour, held, upright)
                    places.append((box, put))
        return self._best(places)

    def _at(self, x: float, y: float) -> tuple[float, float]:
        a, b = self._points(x, y)[0]
        return float(a), float(b)

    def _best(self, places: Sequence[tuple[Box, Put]]) -> Put | None:
        """Choose a place: inside the axes, free of labels, and the least over curves."""
        left, bottom, right, top = self._inside
        free = [(box, put) for box, put in places
                if left <= box[0] and box[2] <= right and bottom <= box[1] and box[3] <= top + LINE
                and not any(_meet(box, one) for one in self._taken)]  # fmt: skip
        if not free:
            return None
        box, put = free[int(np.argmin(self._count_covered([box for box, _ in free])))]
        self._taken.append(box)
        return put

    def _count_covered(self, boxes: Sequence[Box]) -> np.ndarray:
        """Count the points of curves in each box."""
        low_x, low_y, high_x, high_y = np.array(boxes).T[:, :, None]
        x, y = self._curves.T
        within = (low_x < x) & (x < high_x) & (low_y < y) & (y < high_y)
        return np.asarray(within.sum(axis=1))


def _meet(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
