"""Plan and cut of rib stages at one scale, and their dimensions in a table."""

from collections.abc import Mapping, Sequence

import numpy as np

from ccd_casadi.case_studies.rib_stage.geometry import NAMES, Geometry, axis_lengths, bays, mass
from ccd_casadi.drawing.content import Area, Curve, Figure, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLACK, BLUE, ORANGE, short_label
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number

HEIGHTS = (4.7, 1.7)  # inches: the plan fills half a page's width
ROOM = 1.04  # of the axes over what is drawn
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
    tall = max(float(theta[0]) + float(theta[4]) for theta in thetas.values())
    plans = [_plan(geometry, name, theta) for name, theta in thetas.items()]
    cuts = [_cut(geometry, theta, 1e3 * tall) for theta in thetas.values()]
    rows = tuple((*row, *[None] * (2 - len(row))) for row in (plans, cuts))
    lines = Lines(rows, "Dimensions of " + " and ".join(thetas), HEIGHTS)
    return Figure(lines, _caption(geometry, thetas), (table,))


def _bays(geometry: Geometry, theta: Sequence[float]) -> list[tuple[float, float]]:
    """Where the four bays along an axis begin and end, mm from the centre."""
    offset, slope = axis_lengths(geometry)
    half = 1e3 * np.cumsum(offset + slope @ np.array(theta, float))  # c, b_2, i, b_1, o
    inner, outer = (half[0], half[1]), (half[2], half[3])
    return [(-outer[1], -outer[0]), (-inner[1], -inner[0]), inner, outer]


def _plan(geometry: Geometry, name: str, theta: Sequence[float]) -> Panel:
    """The ribbed side from above, the ribs shaded."""
    a, along = 500.0 * geometry.side, _bays(geometry, theta)
    outline = np.array([(-a, -a), (a, -a), (a, a), (-a, a), (-a, -a)])
    holes = [
        np.array([(left, low), (left, high), (right, high), (right, low), (left, low)])
        for left, right in along
        for low, high in along
    ]
    # one way around the outline and, from its corner, the other way around every bay
    ribs = np.vstack([outline, *(part for hole in holes for part in (hole, outline[:1]))])
    gap = np.full((1, 2), np.nan)
    edges = np.vstack([outline, *(part for hole in holes for part in (gap, hole))])
    curves = [Curve(edges[:, 0], edges[:, 1], "", BLACK, width=0.7)]
    points = 1e3 * np.array([(p.x, p.y) for p in geometry.point_masses]).reshape(-1, 2)
    if len(points):
        curves.append(Curve(points[:, 0], points[:, 1], "", ORANGE, "", "o"))
    title = f"{short_label(name)}, {number(float(mass(geometry, theta)), 4)} kg".removeprefix(", ")
    ends, shaded = (-ROOM * a, ROOM * a), Area(ribs[:, 0], ribs[:, 1], BLUE)
    return Panel(
        "x (mm)", "y (mm)", tuple(curves), x_range=ends, y_range=ends, title=title,
        forbidden=(shaded,), equal=True,
    )  # fmt: skip


def _cut(geometry: Geometry, theta: Sequence[float], tall: float) -> Panel:
    """A cut along x through the bays: one outline, the ribs stand on the plate without a joint."""
    a, h, top = 500.0 * geometry.side, 1e3 * float(theta[0]), 1e3 * float(theta[0] + theta[4])
    edges = [-a, *(end for bay in _bays(geometry, theta) for end in bay), a]
    way = [(-a, 0.0)]
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        way += [(left, h), (left, top), (right, top), (right, h)]
    outline = np.array([*way, (a, 0.0), (-a, 0.0)])
    x, z = outline.T
    return Panel("x (mm)", "z (mm)", (Curve(x, z, "", BLACK, width=0.7),),
                 x_range=(-ROOM * a, ROOM * a), y_range=(-0.1 * tall, 1.1 * tall),
                 forbidden=(Area(x, z, BLUE),))  # fmt: skip


def _caption(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> str:
    """How the mass changes from the first stage to the last, and which parameters with it."""
    names, values = list(thetas), list(thetas.values())
    words = "The ribs from above, below them a cut through the bays. "
    if geometry.point_masses:
        words += "Dots: masses fixed to the lower face. "
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
