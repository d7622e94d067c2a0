"""Plan, cut and mode shapes of rib stages."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ccd_casadi.drawing.content import Area, Curve, Figure, Lines, Panel, Table
from ccd_casadi.drawing.svg import (
    BLACK,
    BLUE,
    ORANGE,
    ModeShape,
    ModeShapes,
    outer_faces,
    short_label,
)
from ccd_casadi.extensions.rib_stage.assembly import mirror_signs, swap_displacements
from ccd_casadi.extensions.rib_stage.geometry import (
    NAMES,
    Geometry,
    Mesh,
    axis_lengths,
    bays,
    has_square_symmetry,
    mass,
)
from ccd_casadi.extensions.rib_stage.model import ModeCount, RibStage, discretisation, modes_at
from ccd_casadi.extensions.rib_stage.stage_modes import sector_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import number

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
    """List where the four bays along an axis begin and end, mm from the centre."""
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
    """Describe how the mass changes from the first stage to the last, and which parameters with
    it."""
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


QUADRANTS = ((False, False), (True, False), (True, True), (False, True))
MOST = 6  # modes that a page shows
CLOSEST = 0.02  # share of the side; drawn points keep this distance inside a bay
SHAPES = {  # by symmetry; they differ by the diagonal and the mirrors of the square
    "A1": "bowl",
    "B1": "saddle x² − y²",
    "B2": "twist",
    "A2": "pinwheel x y (x² − y²)",
    "SA": "bent tilt",
}
WITHOUT = "bending"  # where point masses break the square, no mode has a symmetry
ORDINALS = ("", "second", "third", "fourth", "fifth", "sixth")
AT_CORNERS = "vertical at the corners (share of it)"
# corners of a cell's six faces, counter-clockwise from outside
FACES = (
    ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
    ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
    ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
    ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
    ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
)


def mode_shapes(stage: RibStage, theta: Sequence[float], count: int = MOST) -> ModeShapes:
    """The `count` lowest different flexible modes, whatever the model keeps; lowest first.

    A pair of equal frequency, which a quarter turn makes of each other, is one of them.
    """
    found = _lowest_shapes(stage, tuple(float(v) for v in theta), max(count, MOST))
    return replace(found, modes=found.modes[:count])


@lru_cache(maxsize=2)
def _lowest_shapes(stage: RibStage, theta: tuple[float, ...], count: int) -> ModeShapes:
    """A page draws a few of them here and more there: the elements are solved once."""
    # the modes of the model are not the lowest of all; at worst every picture stands for a pair
    total = 2 * count if has_square_symmetry(stage.geometry) else count
    whole = replace(stage, truncation="frequency", modes=ModeCount(total, 0, 0, 0, 0))
    here = np.array(theta)
    mesh = discretisation(whole).assembler.mesh
    points, first, faces = _surface(mesh, here, stage)
    corners = np.isclose(np.abs(points), (*[0.5 * stage.geometry.side] * 2, 0.0)).all(axis=1)
    modes: list[ModeShape] = []
    seen: dict[str, int] = {}
    for index, mode in enumerate(whole.frequencies(theta)[3:]):
        if mode.name == "AS" or len(modes) == count:
            continue
        seen[mode.name] = seen.get(mode.name, 0) + 1
        words = SHAPES.get(mode.name, WITHOUT)
        if mode.name in SHAPES:
            place = seen[mode.name]
            ordinal = ORDINALS[place - 1] if place <= len(ORDINALS) else f"{place}th"
            words = f"{ordinal} {words}".strip()
        moved = np.concatenate([_quadrant(whole, here, index, *side) for side in QUADRANTS])[first]
        largest = np.linalg.norm(moved, axis=1).max()
        numbers = (index + 1, index + 2) if mode.name == "SA" else (index + 1,)
        share = float(np.abs(moved[corners, 2]).max() / largest)
        modes.append(ModeShape(moved, mode.frequency, numbers, words, {AT_CORNERS: share}))
    return ModeShapes(points, faces, tuple(modes), "the ribbed side")


def _surface(mesh: Mesh, theta: Array, stage: RibStage) -> tuple[Array, np.ndarray, np.ndarray]:
    """Points (n, 3), where they are among the nodes of all quadrants, and faces (q, 4).

    As many as a picture needs: a rib stays one face wide, and the narrow elements beside it are
    for stresses.
    """
    offset, slope = axis_lengths(stage.geometry)
    edges, nodes = np.cumsum(offset + slope @ theta), mesh.plan.positions(theta)
    plan, least = [0], CLOSEST * stage.geometry.side
    for end in np.abs(nodes - edges[:, None]).argmin(axis=1).tolist():
        for node in range(plan[-1] + 1, end):
            if min(nodes[node] - nodes[plan[-1]], nodes[end] - nodes[node]) >= least:
                plan.append(node)
        plan.append(end)
    ends = np.cumsum([0.0, theta[0], theta[4]])
    levels = np.abs(mesh.height.positions(theta) - ends[:, None]).argmin(axis=1)
    rib, high = (np.repeat(axis.rib, axis.orders) for axis in (mesh.plan, mesh.height))
    rib, high = rib[plan[:-1]], high[levels[:-1]]
    i, j, k = np.nonzero(~high | rib[:, None, None] | rib[:, None])
    number = mesh.number[np.ix_(plan, plan, levels)]
    cells = [[number[i + a, j + b, k + c] for a, b, c in corners] for corners in FACES]
    quarter, faces = mesh.coordinates(theta), np.concatenate(cells, axis=1).T
    points, quads = [], []
    for place, (left, below) in enumerate(QUADRANTS):
        points.append(quarter * [-1.0 if left else 1.0, -1.0 if below else 1.0, 1.0])
        # one mirror turns the winding over, two do not
        quads.append((faces[:, ::-1] if left != below else faces) + place * len(quarter))
    everywhere = np.concatenate(points)
    used, inner = np.unique(np.concatenate(quads), return_inverse=True)
    # nodes on the mirror planes are there once in each quadrant
    _, first, same = np.unique(
        everywhere[used].round(9) + 0.0, axis=0, return_index=True, return_inverse=True
    )
    seen, outer = np.unique(outer_faces(same.ravel()[inner].reshape(-1, 4)), return_inverse=True)
    chosen = used[first[seen]]
    return everywhere[chosen], chosen, outer.reshape(-1, 4)


def _quadrant(stage: RibStage, theta: Array, flexible: int, left: bool, below: bool) -> Array:
    """(nodes, 3) displacements of a quadrant, one row a node of the quarter mesh."""
    disc, found = discretisation(stage), modes_at(stage, tuple(theta.tolist()))
    mode = found.flexible[flexible]
    item = found.spectra[mode.group]
    vector, start = item.vectors[:, mode.place], 0
    out = np.zeros((disc.assembler.mesh.nodes, 3))
    for symmetry in item.group.images[mode.image]:
        T = sector_of(disc, symmetry).fold.matrix
        field = T @ vector[start : start + T.shape[1]]
        start += T.shape[1]
        if symmetry.name == "AS":
            field = field[swap_displacements(disc.assembler.mesh)]
        out += field.reshape(-1, 3) * np.array(mirror_signs(symmetry, left, below))
    return out
