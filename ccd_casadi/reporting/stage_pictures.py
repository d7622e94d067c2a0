"""The rib stage in pictures: its first flexible modes to turn, and its dimensions side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ccd_casadi.plants.rib_stage import Geometry, ModeCount, ModeShape, RibStage, mode_shape
from ccd_casadi.plants.rib_stage.geometry import (
    NAMES,
    axis_lengths,
    bays,
    has_square_symmetry,
    mass,
)
from ccd_casadi.reporting.page import Table, escape, figure_html, number
from ccd_casadi.reporting.stage_drawing import TALLER, draw_stages
from ccd_casadi.reporting.turntable import (
    REACH,
    Picture,
    Surface,
    coarse_surface,
    data,
    legend,
    still,
)
from ccd_casadi.support.arrays import Array

CLOSEST = 0.02  # share of the side; drawn points keep this distance inside a bay
SHAPES = {  # by symmetry; the diagonal and the mirrors of the square tell them apart
    "A1": "bowl",
    "B1": "saddle x² − y²",
    "B2": "twist",
    "A2": "pinwheel x y (x² − y²)",
    "SA": "bent tilt",
}
WITHOUT = "bending"  # where point masses break the square, no mode has a symmetry
MEANINGS = (
    "plate thickness",
    "outer rib, width",
    "inner ribs, width",
    "centre rib, width",
    "rib height above the plate",
    "inner ribs, from the centre",
)


@dataclass(frozen=True)
class NamedMode:
    """A mode's shape, its name in words, and its numbers among the flexible modes (two: a pair)."""

    shape: ModeShape
    words: str
    numbers: tuple[int, ...]


def first_modes(stage: RibStage, theta: Sequence[float], count: int = 6) -> list[NamedMode]:
    """The `count` lowest different flexible modes, whatever the model keeps; lowest first.

    A pair of equal frequency, which a quarter turn makes of each other, is one of them.
    """
    # the modes of the model are not the lowest of all; at worst every picture stands for a pair
    total = 2 * count if has_square_symmetry(stage.geometry) else count
    whole = replace(stage, truncation="frequency", modes=ModeCount(total, 0, 0, 0, 0))
    found: list[NamedMode] = []
    seen: dict[str, int] = {}
    names = [mode.name for mode in whole.frequencies(theta)[3:]]
    for index, name in enumerate(names):
        if name == "AS" or len(found) == count:
            continue
        pair = name == "SA"
        seen[name] = seen.get(name, 0) + 1
        words = SHAPES.get(name, WITHOUT)
        if seen[name] > 1 and name in SHAPES:
            words = f"{_ordinal(seen[name])} {words}"
        numbers = (index + 1, index + 2) if pair else (index + 1,)
        found.append(NamedMode(mode_shape(whole, theta, 3 + index), words, numbers))
    return found


def surface_of(stage: RibStage, theta: Sequence[float], shape: ModeShape) -> Surface:
    """The stage's surface with as many points as a picture needs, in m."""
    offset, slope = axis_lengths(stage.geometry)
    edges = np.concatenate([[0.0], np.cumsum(offset + slope @ np.array(theta, float))])
    nodes = np.unique(np.abs(shape.points[:, 0]).round(9))
    half, least = [0.0], CLOSEST * stage.geometry.side
    for start, end in pairwise(edges.tolist()):
        # a rib stays one quad wide, and the narrow elements beside it are for stresses
        for node in nodes[(nodes > start) & (nodes < end)].tolist():
            if min(node - half[-1], end - node) >= least:
                half.append(node)
        half.append(end)
    plan = np.array([-v for v in half[:0:-1]] + half)
    h, H = float(theta[NAMES.index("h")]), float(theta[NAMES.index("H")])
    return coarse_surface(shape.points, shape.quads, (plan, plan, np.array([0.0, h, h + H])))


def mode_shape_figure(stage: RibStage, theta: Sequence[float], count: int = 6) -> str:
    """The first flexible modes with their frequencies in Hz, as a figure's HTML.

    Without the page's script, and on paper, the pictures stand still.
    """
    modes = first_modes(stage, theta, count)
    surface = surface_of(stage, theta, modes[0].shape)
    pictures = [Picture(m.shape.displacement[surface.source], _title(m)) for m in modes]
    views = "\n".join(
        f'<div class="view"><p>{escape(_title(mode))}</p>'
        f'<div class="drawn">{still(surface, picture)}</div></div>'
        for mode, picture in zip(modes, pictures, strict=True)
    )
    scale = legend("displacement as a share of each mode's largest (–)")
    body = (
        f'<div class="turntable">\n<div class="views">\n{views}\n</div>\n{scale}\n'
        f'<script type="application/json">{data(surface, pictures)}</script>\n</div>'
    )
    return figure_html(body, caption_modes(modes), table_modes(stage, modes))


def _title(mode: NamedMode) -> str:
    places = " and ".join(map(str, mode.numbers))
    pair = ", a pair" if len(mode.numbers) > 1 else ""
    return f"{places}: {mode.words}{pair}, {number(mode.shape.frequency, 4)} Hz"


def _ordinal(place: int) -> str:
    words = ("first", "second", "third", "fourth", "fifth", "sixth")
    return words[place - 1] if place <= len(words) else f"{place}th"


def caption_modes(modes: Sequence[NamedMode]) -> str:
    """Which modes are shown, what limits the loop first, and how to turn them."""
    low, high = modes[0].shape.frequency, modes[-1].shape.frequency
    words = (
        f"The first {modes[-1].numbers[-1]} flexible modes, {number(low)} to {number(high)} Hz, "
        f"seen from the ribbed side. The lowest is {'' if modes[0].words == WITHOUT else 'the '}"
        f"{modes[0].words}"
    )
    if len(modes) > 1:
        words += f", a factor {number(modes[1].shape.frequency / low, 3)} below the next"
    if any(len(mode.numbers) > 1 for mode in modes):
        words += "; a pair has one frequency and two shapes, the other a quarter turn of this one"
    return words + (
        f". Displacements are exaggerated: the largest is drawn as {100 * REACH:.0f} % of the side."
        " On screen, drag a picture or use the sliders to turn all of them."
    )


def table_modes(stage: RibStage, modes: Sequence[NamedMode]) -> Table:
    """Every mode's frequency, largest displacement, and what vertical motion the corners see."""
    rows = []
    for mode in modes:
        size = np.linalg.norm(mode.shape.displacement, axis=1)
        rows.append((
            " and ".join(map(str, mode.numbers)), mode.words, mode.shape.frequency,
            float(size.max()), float(corner_motion(stage, mode.shape) / size.max()),
        ))  # fmt: skip
    head = ("mode", "shape", "frequency (Hz)", "largest displacement (1/√kg)",
            "vertical at the corners (share of it)")  # fmt: skip
    return Table(head, tuple(rows))


def corner_motion(stage: RibStage, shape: ModeShape) -> float:
    """Largest |u_z| at the four corners of the lower face, in 1/√kg."""
    half = 0.5 * stage.geometry.side
    corner = np.array([half, half, 0.0])
    at = np.linalg.norm(np.abs(shape.points) - corner, axis=1) < 1e-9
    return float(np.abs(shape.displacement[at, 2]).max())


def dimensions_figure(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> str:
    """Stages by name at equal scale with their dimensions in mm, as a figure's HTML."""
    caption, table = caption_dimensions(geometry, thetas), table_dimensions(geometry, thetas)
    return figure_html(draw_stages(geometry, thetas), caption, table)


def caption_dimensions(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> str:
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


def table_dimensions(geometry: Geometry, thetas: Mapping[str, Sequence[float]]) -> Table:
    """The six parameters and both bays in mm, and the mass in kg, a column a stage."""
    values = [tuple(float(v) for v in theta) for theta in thetas.values()]
    rows: list[tuple[object, ...]] = [
        (name, meaning, "mm", *(1e3 * theta[i] for theta in values))
        for i, (name, meaning) in enumerate(zip(NAMES, MEANINGS, strict=True))
    ]
    for i, (name, meaning) in enumerate((("b_1", "outer bay"), ("b_2", "inner bay"))):
        rows.append((name, meaning, "mm", *(1e3 * bays(geometry, theta)[i] for theta in values)))
    rows.append(("mass", "", "kg", *(float(mass(geometry, theta)) for theta in values)))
    return Table(("length", "what it is", "unit", *thetas), tuple(rows))
