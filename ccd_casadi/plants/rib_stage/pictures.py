"""Mode shapes on the surface of the stage, for pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.plants.rib_stage.mesh import Mesh
from ccd_casadi.plants.rib_stage.model import RibStage, discretisation, modes_at
from ccd_casadi.plants.rib_stage.modes import sector_of
from ccd_casadi.plants.rib_stage.rigid import rigid_motion
from ccd_casadi.plants.rib_stage.symmetry import mirror_signs, swap_displacements
from ccd_casadi.support.arrays import Array

QUADRANTS = ((False, False), (True, False), (True, True), (False, True))


@dataclass(frozen=True)
class ModeShape:
    """Surface points (n, 3) in m, displacements (n, 3) in 1/√kg, quads (q, 4), frequency in Hz."""

    points: Array
    displacement: Array
    quads: np.ndarray
    frequency: float
    name: str
    sector: str


def mode_shape(stage: RibStage, theta: Sequence[float], index: int) -> ModeShape:
    """Mode `index` of the model (row of B; 0, 1, 2 are rigid) on the stage's outer surface.

    Quads join neighbouring nodes of the elements, wound counter-clockwise seen from outside.
    Nodes on the mirror planes appear once in each quadrant.
    """
    mesh, here = discretisation(stage).assembler.mesh, np.array([float(v) for v in theta])
    mode = stage.frequencies(theta)[index]
    quarter = mesh.coordinates(here)
    faces = surface_quads(mesh)
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 4)
    points, moves, quads = [], [], []
    for number, (left, below) in enumerate(QUADRANTS):
        sign = np.array([-1.0 if left else 1.0, -1.0 if below else 1.0, 1.0])
        points.append(quarter[used] * sign)
        # one mirror turns the winding over, two do not
        quads.append((faces[:, ::-1] if left != below else faces) + number * len(used))
        if index >= 3:
            moves.append(_quadrant(stage, here, index - 3, left, below)[used])
    everywhere = np.concatenate(points)
    if index < 3:
        moved = rigid_motion(stage.geometry, here, everywhere)[index]
    else:
        moved = np.concatenate(moves)
    return ModeShape(
        everywhere, moved, np.concatenate(quads), mode.frequency, mode.name, mode.sector
    )


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


def surface_quads(mesh: Mesh) -> np.ndarray:
    """(q, 4) node numbers of the quarter's outer surface, not its mirror planes."""
    number = mesh.number
    solid = np.zeros(tuple(n - 1 for n in number.shape), bool)
    for block in mesh.blocks:
        i, j, k = mesh.grid[block.nodes].T
        solid[i.min() : i.max(), j.min() : j.max(), k.min() : k.max()] = True
    padded = np.pad(solid, 1)
    inside = padded[1:-1, 1:-1, 1:-1]
    quads = []
    # corner offsets of each face, counter-clockwise from outside
    faces = {
        (0, 1): ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
        (0, -1): ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
        (1, 1): ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
        (1, -1): ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
        (2, 1): ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
        (2, -1): ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
    }
    for (axis, side), corners in faces.items():
        beyond = np.roll(padded, -side, axis)[1:-1, 1:-1, 1:-1]
        i, j, k = np.nonzero(inside & ~beyond)
        if axis < 2 and side < 0:
            off_plane = (i, j)[axis] > 0  # the mirror plane is no surface
            i, j, k = i[off_plane], j[off_plane], k[off_plane]
        quads.append(np.stack([number[i + a, j + b, k + c] for a, b, c in corners], axis=1))
    return np.concatenate(quads)
