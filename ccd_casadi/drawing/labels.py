"""Words in a figure that do not meet: each label takes the first free place of several."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

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
LEADER = {"arrowstyle": "-", "color": "#444444", "linewidth": 0.6, "shrinkA": 0.0, "shrinkB": POINT}
SHARES = (0.0, 0.2, 0.45, 0.75, 0.1, 0.3, 0.6, 0.9)  # of a line's length where words may begin
APART = 2.0  # pt between the points that a curve is looked at by
BEHIND = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}

Box = tuple[float, float, float, float]  # left, bottom, right, top in pt


def inside(axes: "Axes") -> Box:
    """The axes themselves in pt, from the lower left corner of the figure."""
    box, scale = axes.get_window_extent(), 72.0 / axes.figure.dpi
    return scale * box.x0, scale * box.y0, scale * box.x1, scale * box.y1


def legend_height(names: Sequence[str]) -> float:
    """Of a legend of these names, in pt."""
    return LINE * (len(names) + 0.8)


def scales_of(axes: "Axes", log_x: bool = False, log_y: bool = False) -> list[list[float]]:
    """Of both axes: their ends, whether logarithmic, and where these are in pt from the top left,
    for the page's scripts."""
    box, tall = inside(axes), 72.0 * axes.figure.bbox.height / axes.figure.dpi
    ends = (
        (axes.get_xlim(), log_x, box[0], box[2]),
        (axes.get_ylim(), log_y, tall - box[1], tall - box[3]),
    )
    return [[*map(float, limits), int(log), round(a, 3), round(b, 3)]
            for limits, log, a, b in ends]  # fmt: skip


def in_points(axes: "Axes", x: Any, y: Any) -> np.ndarray:
    """Points (k, 2) of the data in pt, from the lower left corner of the figure."""
    return axes.transData.transform(np.column_stack([x, y])) * 72.0 / axes.figure.dpi


class Labels:
    """The labels of one pair of axes, whose ranges are final.

    A label takes a place off the curves where there is one. Without a place that hides no other
    label it is left out: the data of every figure stand in the table below it. Widths are those of
    DejaVu Sans by a rule of thumb, as the browser sets a font of its own.
    """

    def __init__(self, axes: "Axes") -> None:
        self._axes = axes
        axes.get_xlim(), axes.get_ylim()  # where they follow the data: settle them now
        self._inside = inside(axes)
        self._taken: list[Box] = []
        self._curves = np.empty((0, 2))

    def corner(self, names: Sequence[str]) -> tuple[str, float]:
        """The place of a legend of these names that covers least, and how much it covers; nothing
        lies over it then."""
        boxes = self._corners(names)
        costs = {where: self._covered(box) + sum(_meet(box, one) for one in self._taken)
                 for where, box in boxes.items()}  # fmt: skip
        where = min(costs, key=lambda each: costs[each])
        self._taken.append(boxes[where])
        return where, costs[where]

    def _corners(self, names: Sequence[str]) -> dict[str, Box]:
        left, bottom, right, top = self._inside
        wide, tall = LETTER * max(map(len, names)) + HANDLE, legend_height(names)
        middle = 0.5 * (left + right - wide)
        across = {"right": right - wide, "left": left, "center": middle}
        up = {"upper": top - tall, "lower": bottom, "center": 0.5 * (bottom + top - tall)}
        return {f"{v} {h}": (x, y, x + wide, y + tall) for v, y in up.items()
                for h, x in across.items() if v != h}  # fmt: skip

    def avoid(self, x: float, y: float) -> None:
        """Nothing is to lie over this point."""
        a, b = self._at(x, y)
        self._taken.append((a - POINT, b - POINT, a + POINT, b + POINT))

    def avoid_curve(self, x: Any, y: Any, joined: bool = True, apart: float = APART) -> None:
        """Labels keep off this curve, or its points alone; less off one with points far `apart`."""
        points = in_points(self._axes, x, y)
        left, bottom, right, top = self._inside
        shown = np.isfinite(points).all(axis=1)
        points = np.clip(points[shown], (left - 99.0, bottom - 99.0), (right + 99.0, top + 99.0))
        if joined and len(points) > 1:  # as many points as are this far apart, along its length
            along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
            at = np.arange(0.0, along[-1], apart)
            points = np.column_stack([np.interp(at, along, points[:, k]) for k in range(2)])
        self._curves = np.vstack([self._curves, points])

    def beside(self, x: float, y: float, text: str, wish: tuple[float, float]) -> None:
        """A label beside a point, at the offset `wish` in pt if that is free."""
        a, b = self._at(x, y)
        wide = LETTER * len(text)
        places = []
        for dx, dy in (wish, *AROUND):
            left = a + dx - (0.5 * wide if dx == 0 else wide if dx < 0 else 0.0)
            bottom = b + dy - (LINE if dy < 0 else 0.0)
            places.append(((left, bottom, left + wide, bottom + LINE), (dx, dy)))
        found = self._best([box for box, _ in places])
        if found is not None:
            dx, dy = places[found][1]
            side = "center" if dx == 0 else "left" if dx > 0 else "right"
            held, look = self._held(x, y), {"arrowprops": LEADER} if abs(dy) >= FAR else {}
            made = self._write(text, (dx, dy), (x, y), "data", held, ha=side, va=_above(dy),
                               bbox=BEHIND, **look)  # fmt: skip
            if look:
                made.arrow_patch.set_gid(f"leader-{held}")

    def along(self, value: float, text: str, vertical: bool) -> None:
        """A label at a line across the axes; upright beside a vertical one, or level with a place
        on it where that alone keeps off the curves."""
        left, bottom, right, top = self._inside
        corner = self._axes.get_xlim()[0], self._axes.get_ylim()[0]
        line = self._at(value, corner[1])[0] if vertical else self._at(corner[0], value)[1]
        start, end = (bottom + 4.0, top) if vertical else (left + 3.0, right)
        wide = LETTER * len(text)
        places = []
        for long, across in ((wide, LINE), (LINE, wide))[: 1 + vertical]:
            for share in SHARES:
                for side in (2.0, -2.0):
                    a, b = start + share * (end - start), line + side - across * (side < 0)
                    box = (a, b, a + long, b + across)
                    box = (b, a, b + across, a + long) if vertical else box
                    places.append((box, a - (bottom if vertical else left), side, long == wide))
        found = self._best([box for box, *_ in places])
        if found is None:
            return
        _, at, side, upright = places[found]
        if vertical:
            self._write(
                text, (side, 0.0), (value, at / (top - bottom)), self._axes.get_xaxis_transform(),
                self._held(value, None), rotation=90 * upright, va="bottom",
                ha="left" if side > 0 else "right",
            )  # fmt: skip
        else:
            self._write(
                text, (0.0, side), (at / (right - left), value), self._axes.get_yaxis_transform(),
                self._held(None, value), ha="left", va=_above(side),
            )  # fmt: skip

    def _at(self, x: float, y: float) -> tuple[float, float]:
        a, b = in_points(self._axes, x, y)[0]
        return float(a), float(b)

    def _held(self, x: float | None, y: float | None) -> str:
        """The point, or the line, that words belong to in pt of the picture, for its script."""
        a, b = self._at(self._axes.get_xlim()[0] if x is None else x,
                        self._axes.get_ylim()[0] if y is None else y)  # fmt: skip
        tall = 72.0 * self._axes.figure.bbox.height / self._axes.figure.dpi
        return f"at:{'' if x is None else f'{a:.1f}'},{'' if y is None else f'{tall - b:.1f}'}"

    def _best(self, boxes: Sequence[Box]) -> int | None:
        """Which place to take: inside the axes, free of labels, and the least over curves."""
        left, bottom, right, top = self._inside
        costs = [
            self._covered(box)
            if left <= box[0] and box[2] <= right and bottom <= box[1] and box[3] <= top + LINE
            and not any(_meet(box, one) for one in self._taken)
            else np.inf
            for box in boxes
        ]  # fmt: skip
        found = int(np.argmin(costs))
        if not np.isfinite(costs[found]):
            return None
        self._taken.append(boxes[found])
        return found

    def _covered(self, box: Box) -> float:
        """How many points of curves lie in a box."""
        x, y = self._curves.T
        return float(((box[0] < x) & (x < box[2]) & (box[1] < y) & (y < box[3])).sum())

    def _write(
        self, text: str, offset: tuple[float, float], place: tuple[float, float],
        coordinates: Any, held: str, **look: Any,
    ) -> Any:  # fmt: skip
        return self._axes.annotate(
            text, place, xycoords=coordinates, xytext=offset, textcoords="offset points",
            fontsize=SIZE, annotation_clip=False, zorder=6, gid=held, **look,
        )  # fmt: skip


def _meet(one: Box, other: Box) -> bool:
    return not (
        one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
    )


def _above(dy: float) -> str:
    return "bottom" if dy >= 0 else "top"
