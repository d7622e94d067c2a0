"""Technical drawing of rib stages as SVG: plan and cut with dimension lines, at one scale."""

from collections.abc import Mapping, Sequence

import numpy as np

from ccd_casadi.case_studies.rib_stage.geometry import NAMES, Geometry, axis_lengths, bays, mass
from ccd_casadi.drawing.content import Figure, Picture, Table
from ccd_casadi.drawing.page import escape
from ccd_casadi.drawing.svg import BLACK, LONGEST_LABEL
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number

WIDTH = 960.0  # of the drawing; a page column shows a unit as about a pixel
TALLER = 3.0  # heights in the cut against lengths
INK = f"var(--ink, {BLACK})"  # of the page's theme, where it has one
RIB, PLATE, CUT, EDGE = "#86a5b8", "#eff3f6", "#4d7189", "#3c4a54"
TEXT = 12.5
LEFT, RIGHT, ABOVE = 24.0, 120.0, 84.0  # room around a plan
GAP = 46.0  # between plan and cut: x_i stands there
BELOW = 50.0  # under the cut: the side stands there
ARROW, TAIL = 6.0, 14.0
DIGITS = 4  # of a dimension; the table has more
MEANINGS = (
    "plate thickness",
    "outer rib, width",
    "inner ribs, width",
    "centre rib, width",
    "rib height above the plate",
    "inner ribs, from the centre",
)


def drawing(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> Figure:
    """Stages by name at equal scale with their dimensions in mm; θ in m."""
    head = ("length", "what it is", "unit", *thetas)
    table = Table(head, _rows(geometry, thetas))
    return Figure(Picture(draw_stages(geometry, thetas)), _caption(geometry, thetas), (table,))


def draw_stages(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> str:
    """The stages by name, two in a row, as one <svg> element; θ in m, dimensions in mm."""
    column = WIDTH / 2.0
    scale = (column - LEFT - RIGHT) / (1e3 * geometry.side)  # units per mm
    tall = max(float(theta[0]) + float(theta[4]) for theta in thetas.values())
    height = ABOVE + 1e3 * geometry.side * scale + GAP + 1e3 * tall * TALLER * scale + BELOW
    parts = []
    for place, (name, theta) in enumerate(thetas.items()):
        row, col = divmod(place, 2)
        drawing = _Drawing(geometry, [float(v) for v in theta], scale, 1e3 * tall)
        parts.append(
            f'<g transform="translate({col * column:g} {row * height:.6g})">'
            f"{drawing.title(name)}{drawing.plan()}{drawing.cut()}</g>"
        )
    rows = (len(thetas) + 1) // 2
    words = "Dimensions of " + " and ".join(thetas)
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {rows * height:.6g}" role="img" '
        f'aria-label="{escape(words)}" font-size="{TEXT:g}">' + "".join(parts) + "</svg>"
    )


class _Drawing:
    """One stage; lengths in mm, coordinates in units of the drawing."""

    def __init__(
        self, geometry: Geometry, theta: Sequence[float], scale: float, tall: float
    ) -> None:
        self.geometry, self.theta, self.scale = geometry, theta, scale
        self.side = 1e3 * geometry.side
        self.mm = {name: 1e3 * value for name, value in zip(NAMES, theta, strict=True)}
        offset, slope = axis_lengths(geometry)
        half = 1e3 * np.cumsum(offset + slope @ np.array(theta, float))  # c, b_2, i, b_1, o
        inner, outer = (half[0], half[1]), (half[2], half[3])
        self.bays = [(-outer[1], -outer[0]), (-inner[1], -inner[0]), inner, outer]
        self.top = ABOVE
        self.ground = ABOVE + self.side * scale + GAP + tall * TALLER * scale

    def x(self, mm: float) -> float:
        """Across, 0 the stage's centre."""
        return LEFT + (mm + 0.5 * self.side) * self.scale

    def y(self, mm: float) -> float:
        """Down the plan, 0 the stage's centre."""
        return self.top + (0.5 * self.side - mm) * self.scale

    def z(self, mm: float) -> float:
        """Height in the cut, 0 the lower face."""
        return self.ground - mm * TALLER * self.scale

    def title(self, name: str) -> str:
        short = name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 1] + "…"
        weight = number(float(mass(self.geometry, self.theta)), 4)
        return (
            f'<text x="{LEFT:g}" y="16" font-size="15" font-weight="600">{escape(short)}'
            f'<tspan font-weight="400">, {weight} kg</tspan></text>'
        )

    def plan(self) -> str:
        """The ribbed side from above, with the widths of the ribs and where the inner ones are."""
        a, t_o, t_i, t_c, x_i = 0.5 * self.side, *(self.mm[n] for n in ("t_o", "t_i", "t_c", "x_i"))
        parts = [self._box(self.x(-a), self.y(a), self.x(a), self.y(-a), RIB)]
        for left, right in self.bays:
            for low, high in self.bays:
                corner = (self.x(left), self.y(high), self.x(right), self.y(low))
                parts.append(self._box(*corner, PLATE))
        for point in self.geometry.point_masses:
            where = f'cx="{self.x(1e3 * point.x):.2f}" cy="{self.y(1e3 * point.y):.2f}"'
            parts.append(
                f'<circle {where} r="6" fill="none" stroke="{INK}" stroke-dasharray="3 2"/>'
            )
        # in two rows, t_i in the lower: neither words nor lines of neighbours meet in the box of θ
        parts.append(self._width("t_o", -a, -a + t_o, self.top - 34.0, "start"))
        parts.append(self._width("t_i", -x_i - 0.5 * t_i, -x_i + 0.5 * t_i, self.top - 12.0))
        parts.append(self._width("t_c", -0.5 * t_c, 0.5 * t_c, self.top - 34.0))
        line = self.y(-a) + 24.0
        centres = "".join(
            self._line(self.x(at), self.y(-a) - 10.0, self.x(at), line + 5.0, dashed=True)
            for at in (0.0, x_i)
        )
        # beside the dimension line: between the centre lines there is no room for the words
        words = self._text(self.x(x_i) + 9.0, line + 4.0, "x_i", x_i, "start")
        parts.append(centres + self._between(0.0, x_i, line) + words)
        return "".join(parts)

    def cut(self) -> str:
        """A cut along x through the bays: plate and cross ribs; the ribs behind lighter."""
        a, h, H = 0.5 * self.side, self.mm["h"], self.mm["H"]
        low, bed, top = self.z(0.0), self.z(h), self.z(h + H)
        parts = [self._box(self.x(-a), top, self.x(a), bed, PLATE)]
        edges = [-a, *(v for bay in self.bays for v in bay), a]
        # one outline of all that is cut: the ribs stand on the plate without a joint
        way = [(self.x(-a), low)]
        for left, right in zip(edges[::2], edges[1::2], strict=True):
            way += [(self.x(left), bed), (self.x(left), top)]
            way += [(self.x(right), top), (self.x(right), bed)]
        way.append((self.x(a), low))
        d = "M" + "L".join(f"{px:.2f} {py:.2f}" for px, py in way) + "Z"
        parts.append(f'<path d="{d}" fill="{CUT}" stroke="{EDGE}" stroke-width=".6"/>')
        parts.append(self._heights(low, bed, top))
        line = low + 26.0
        parts += [self._line(self.x(s), low + 3.0, self.x(s), line + 5.0) for s in (-a, a)]
        words = self._text(self.x(0.0), line - 5.0, "side", self.side, "middle")
        parts.append(self._between(-a, a, line) + words)
        return "".join(parts)

    def _heights(self, low: float, bed: float, top: float) -> str:
        """H and h beside the cut; the arrows of h come from outside, it may be a hairline."""
        start, line = self.x(0.5 * self.side) + 3.0, self.x(0.5 * self.side) + 16.0
        ends = "".join(self._line(start, y, line + 5.0, y) for y in (low, bed, top))
        rib = self._line(line, bed, line, top) + self._arrow(line, top, 0.0, -1.0)
        # one arrow each way at the plate's upper face: H ends and h begins there
        rib += self._line(line, low, line, low + TAIL + 4.0) + self._arrow(line, low, 0.0, -1.0)
        rib += self._arrow(line, bed, 0.0, 1.0)
        words = self._text(line + 9.0, 0.5 * (bed + top) + 4.0, "H", self.mm["H"], "start")
        return ends + rib + words + self._text(line + 9.0, low + 12.0, "h", self.mm["h"], "start")

    def _width(self, name: str, left: float, right: float, y: float, anchor: str = "middle") -> str:
        """A small width above the plan: extension lines, arrows from outside, words above."""
        x0, x1 = self.x(left), self.x(right)
        out = "".join(self._line(x, self.top - 2.0, x, y - 4.0) for x in (x0, x1))
        out += self._line(x0 - TAIL, y, x0, y) + self._arrow(x0, y, 1.0, 0.0)
        out += self._line(x1, y, x1 + TAIL, y) + self._arrow(x1, y, -1.0, 0.0)
        at = 0.5 * (x0 + x1) if anchor == "middle" else x0 - TAIL
        return out + self._text(at, y - 8.0, name, self.mm[name], anchor)

    def _between(self, left: float, right: float, y: float) -> str:
        """A dimension line under the drawing, arrows from inside."""
        x0, x1 = self.x(left), self.x(right)
        ends = self._arrow(x0, y, -1.0, 0.0) + self._arrow(x1, y, 1.0, 0.0)
        return self._line(x0, y, x1, y) + ends

    def _text(self, x: float, y: float, name: str, mm: float, anchor: str) -> str:
        words = escape(f"{name} = {number(mm, DIGITS)} mm")
        return f'<text x="{x:.2f}" y="{y:.2f}" text-anchor="{anchor}">{words}</text>'

    def _box(self, x0: float, y0: float, x1: float, y1: float, fill: str) -> str:
        size = f'width="{x1 - x0:.2f}" height="{y1 - y0:.2f}"'
        look = f'fill="{fill}" stroke="{EDGE}" stroke-width=".6"'
        return f'<rect x="{x0:.2f}" y="{y0:.2f}" {size} {look}/>'

    def _line(self, x0: float, y0: float, x1: float, y1: float, dashed: bool = False) -> str:
        dashes = ' stroke-dasharray="7 3 2 3"' if dashed else ""
        return (
            f'<path d="M{x0:.2f} {y0:.2f}L{x1:.2f} {y1:.2f}" stroke="{INK}" '
            f'stroke-width=".7" fill="none"{dashes}/>'
        )

    def _arrow(self, x: float, y: float, dx: float, dy: float) -> str:
        """A head whose tip is at (x, y), pointing along (dx, dy)."""
        bx, by, wide = x - ARROW * dx, y - ARROW * dy, 0.32 * ARROW
        return (
            f'<path d="M{x:.2f} {y:.2f}L{bx - wide * dy:.2f} {by + wide * dx:.2f}'
            f'L{bx + wide * dy:.2f} {by - wide * dx:.2f}Z" fill="{INK}"/>'
        )


def _caption(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> str:
    """How the mass changes from the first stage to the last, and which parameters with it."""
    names, values = list(thetas), list(thetas.values())
    words = "All at one scale: " if len(names) > 1 else ""
    words += (
        "the ribbed side above (ribs dark), below it a cut through the bays (cut faces dark), "
        f"heights drawn {TALLER:g} times as large as lengths. "
    )
    if geometry.point_masses:
        words += "Dashed circles: masses fixed to the lower face. "
    masses = [float(mass(geometry, theta)) for theta in values]
    if len(names) == 1:
        return words + f"{names[0]} weighs {number(masses[0])} kg."
    words += f"From {names[0]} to {names[-1]} the mass goes from {number(masses[0])} to "
    words += f"{number(masses[-1])} kg ({_percent(masses[-1] / masses[0])}). "
    changes = _changes(np.array(values[0]), np.array(values[-1]))
    return words + (f"Changed: {changes}." if changes else "No parameter changes.")


def _changes(first: Array, last: Array) -> str:
    """`t_c (-49 %), x_i (+11 %)`, the largest change first."""
    ratio = last / first
    order = np.argsort(-np.abs(np.log(ratio)), kind="stable")
    return ", ".join(
        f"{NAMES[i]} ({_percent(ratio[i])})" for i in order if abs(np.log(ratio[i])) > 5e-4
    )


def _percent(ratio: float) -> str:
    return f"{100.0 * (ratio - 1.0):+.3g} %".replace("-", "−")


def _rows(
    geometry: Geometry, thetas: Mapping[str, Sequence[float]]
) -> tuple[tuple[object, ...], ...]:
    """The six parameters and both bays in mm, and the mass in kg, a column a stage."""
    values = [tuple(float(v) for v in theta) for theta in thetas.values()]
    rows: list[tuple[object, ...]] = [
        (name, meaning, "mm", *(1e3 * theta[i] for theta in values))
        for i, (name, meaning) in enumerate(zip(NAMES, MEANINGS, strict=True))
    ]
    for i, (name, meaning) in enumerate((("b_1", "outer bay"), ("b_2", "inner bay"))):
        rows.append((name, meaning, "mm", *(1e3 * bays(geometry, theta)[i] for theta in values)))
    rows.append(("mass", "", "kg", *(float(mass(geometry, theta)) for theta in values)))
    return tuple(rows)
