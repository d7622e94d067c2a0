"""Mode shapes on the surface of the stage, for pictures."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ccd_casadi.case_studies.rib_stage.geometry import axis_lengths, has_square_symmetry
from ccd_casadi.case_studies.rib_stage.mesh import Mesh
from ccd_casadi.case_studies.rib_stage.model import RibStage, discretisation, modes_at
from ccd_casadi.case_studies.rib_stage.modes import sector_of
from ccd_casadi.case_studies.rib_stage.symmetry import mirror_signs, swap_displacements
from ccd_casadi.case_studies.rib_stage.truncation import ModeCount
from ccd_casadi.drawing.pictures import ModeShape, ModeShapes, outer_faces
from ccd_casadi.support.arrays import Array

QUADRANTS = ((False, False), (True, False), (True, True), (False, True))
MOST = 6  # modes that a page shows
CLOSEST = 0.02  # share of the side; drawn points keep this distance inside a bay
SHAPES = {  # by symmetry; the diagonal and the mirrors of the square tell them apart
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
