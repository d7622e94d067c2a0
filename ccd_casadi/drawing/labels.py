"""Words in a figure that do not meet: each label takes the first free place of several."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = 9.0  # pt
LETTER, LINE = 0.62 * SIZE, 1.25 * SIZE  # pt; DejaVu Sans, the widest that a page may take
POINT = 3.0  # pt; half a marker
# places beside a point, in pt, after the one that was asked for
AROUND = ((0, 7), (8, 3), (-8, 3), (0, -7), (8, -5), (-8, -5), (0, 20), (12, 16), (-12, 16),
          (0, -20), (12, -18), (-12, -18))  # fmt: skip
SHARES = (0.0, 0.45, 0.75)  # of a line's length where its words may begin
BEHIND = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}

Box = tuple[float, float, float, float]  # left, bottom, right, top in pt


def inside(axes: "Axes") -> Box:
    """The axes themselves in pt, from the lower left corner of the figure."""
    box, scale = axes.get_window_extent(), 72.0 / axes.figure.dpi
    return scale * box.x0, scale * box.y0, scale * box.x1, scale * box.y1


class Labels:
    """The labels of one pair of axes, whose ranges are final.

    A label without a free place is left out: it would hide another one, and the data of every
    figure stand in the table below it. Widths are those of DejaVu Sans by a rule of thumb, as the
    browser sets a font of its own.
    """

    def __init__(self, axes: "Axes") -> None:
        self._axes = axes
        axes.get_xlim(), axes.get_ylim()  # where they follow the data: settle them now
        self._scale = 72.0 / axes.figure.dpi
        self._inside = inside(axes)
        self._taken: list[Box] = []

    def avoid(self, x: float, y: float) -> None:
        """Nothing is to lie over this point."""
        a, b = self._at(x, y)
        self._taken.append((a - POINT, b - POINT, a + POINT, b + POINT))

    def beside(self, x: float, y: float, text: str, wish: tuple[float, float]) -> None:
        """A label beside a point, at the offset `wish` in pt if that is free."""
        a, b = self._at(x, y)
        wide = LETTER * len(text)
        for dx, dy in (wish, *AROUND):
            left = a + dx - (0.5 * wide if dx == 0 else wide if dx < 0 else 0.0)
            bottom = b + dy - (LINE if dy < 0 else 0.0)
            if self._take((left, bottom, left + wide, bottom + LINE)):
                side = "center" if dx == 0 else "left" if dx > 0 else "right"
                self._write(text, (dx, dy), (x, y), "data", ha=side, va=_above(dy), bbox=BEHIND)
                return

    def along(self, value: float, text: str, vertical: bool) -> None:
        """A label at a line across the axes, upright beside a vertical one."""
        left, bottom, right, top = self._inside
        wide = LETTER * len(text)
        for share in SHARES:
            for side in (2.0, -2.0):
                low = side - (LINE if side < 0 else 0.0)
                if vertical:
                    x, y = self._at(value, self._axes.get_ylim()[0])[0], bottom + 4.0
                    y += share * (top - bottom)
                    box = (x + low, y, x + low + LINE, y + wide)
                    place = (value, (y - bottom) / (top - bottom))
                    look = {"rotation": 90, "va": "bottom", "ha": "left" if side > 0 else "right"}
                    offset, coordinates = (side, 0.0), self._axes.get_xaxis_transform()
                else:
                    x, y = left + 3.0, self._at(self._axes.get_xlim()[0], value)[1]
                    x += share * (right - left)
                    box = (x, y + low, x + wide, y + low + LINE)
                    place = ((x - left) / (right - left), value)
                    look = {"ha": "left", "va": _above(side)}
                    offset, coordinates = (0.0, side), self._axes.get_yaxis_transform()
                if self._take(box):
                    self._write(text, offset, place, coordinates, **look)
                    return

    def _at(self, x: float, y: float) -> tuple[float, float]:
        a, b = self._axes.transData.transform((x, y)) * self._scale
        return float(a), float(b)

    def _take(self, box: Box) -> bool:
        """Whether the place is free and inside the axes; it is taken then."""
        left, bottom, right, top = self._inside
        inside = left <= box[0] and box[2] <= right and bottom <= box[1] and box[3] <= top + LINE
        free = all(
            box[2] <= a or c <= box[0] or box[3] <= b or d <= box[1] for a, b, c, d in self._taken
        )
        if inside and free:
            self._taken.append(box)
        return inside and free

    def _write(
        self, text: str, offset: tuple[float, float], place: tuple[float, float],
        coordinates: Any, **look: Any,
    ) -> None:  # fmt: skip
        self._axes.annotate(
            text, place, xycoords=coordinates, xytext=offset, textcoords="offset points",
            fontsize=SIZE, annotation_clip=False, zorder=6, **look,
        )  # fmt: skip


def _above(dy: float) -> str:
    return "bottom" if dy >= 0 else "top"
