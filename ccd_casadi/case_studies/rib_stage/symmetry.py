"""Symmetry of the square: how a quarter's displacements follow from a reduced vector.

The mirrors x -> -x and y -> -y split the displacements into sectors SS, SA, AS, AA: the parity of
u_z about x = 0, then about y = 0. The diagonal mirror x <-> y splits SS into A1 and B1 and AA
into B2 and A2 (names of the group C4v) and turns SA into AS. So SS and AA halve once more, and
the double frequencies of the stage are one simple frequency of SA.

    A1: piston and bowl    B1: x² - y²    B2: twist x y    A2: x y (x² - y²), yaw    SA, AS: tilt
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from ccd_casadi.case_studies.rib_stage.geometry import Point
from ccd_casadi.case_studies.rib_stage.mesh import Mesh
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Symmetry:
    """Parities of u_z about x = 0 and y = 0, and about the diagonal (0: not used)."""

    name: str
    sector: str
    x: int
    y: int
    diagonal: int


A1 = Symmetry("A1", "SS", 1, 1, 1)
B1 = Symmetry("B1", "SS", 1, 1, -1)
B2 = Symmetry("B2", "AA", -1, -1, 1)
A2 = Symmetry("A2", "AA", -1, -1, -1)
SA = Symmetry("SA", "SA", 1, -1, 0)
AS = Symmetry("AS", "AS", -1, 1, 0)
SOLVED = (A1, B1, B2, A2, SA)
ALL = (A1, B1, B2, A2, SA, AS)


@dataclass(frozen=True)
class Fold:
    """u = T q: displacement d of the quarter is weight[d] q[index[d]], zero where index < 0."""

    index: np.ndarray
    weight: Array
    size: int

    @cached_property
    def matrix(self) -> sparse.csr_matrix:
        """T (3 nodes, size): T q are the quarter's displacements, Tᵀ f the reduced forces."""
        live = np.flatnonzero(self.index >= 0)
        entries = (self.weight[live], (live, self.index[live]))
        return sparse.csr_matrix(entries, shape=(len(self.index), self.size))

    @cached_property
    def shared(self) -> np.ndarray:
        """(size,) int8: 1 where two displacements have √½ of it each."""
        found = np.zeros(self.size, np.int8)
        found[self.index[(self.index >= 0) & (np.abs(self.weight) < 1.0)]] = 1
        return found


def swap_displacements(mesh: Mesh) -> np.ndarray:
    """(3 nodes,) the displacement that the diagonal mirror makes of each one."""
    partner = mesh.number[mesh.grid[:, 1], mesh.grid[:, 0], mesh.grid[:, 2]]
    return (3 * partner[:, None] + np.array([1, 0, 2])).ravel()


def fold(mesh: Mesh, symmetry: Symmetry) -> Fold:
    """The reduction of this symmetry; T has orthonormal columns."""
    count = 3 * mesh.nodes
    component = np.tile(np.arange(3), mesh.nodes)
    on_x, on_y = np.repeat(mesh.grid[:, 0] == 0, 3), np.repeat(mesh.grid[:, 1] == 0, 3)
    # even u_z about x = 0 leaves no u_x there, odd u_z leaves nothing but u_x
    dead = on_x & ((component == 0) == (symmetry.x > 0))
    dead |= on_y & ((component == 1) == (symmetry.y > 0))
    here = np.arange(count)
    weight = np.ones(count)
    first = here
    if symmetry.diagonal:
        partner = swap_displacements(mesh)
        first = np.minimum(here, partner)
        weight = np.where(here == partner, 1.0, np.sqrt(0.5))
        weight[here > partner] *= symmetry.diagonal
        dead |= (here == partner) & (symmetry.diagonal < 0)
    kept = (first == here) & ~dead
    rank = np.where(kept, np.cumsum(kept) - 1, -1)
    index = np.where(dead, -1, rank[first])
    return Fold(index, np.where(dead, 0.0, weight), int(kept.sum()))


def point_functional(
    mesh: Mesh, symmetry: Symmetry, theta: Array, point: Point
) -> tuple[Array, Array]:
    """(3 nodes, 3) and (θ, 3 nodes, 3): u_x, u_y, u_z at (x, y, 0) from the quarter's vector.

    For AS the quarter's vector is that of SA: the field is its diagonal mirror image.
    """
    x, y = point
    values, slopes = mesh.interpolate(theta, abs(x), abs(y))
    out = np.zeros((3 * mesh.nodes, 3))
    d_out = np.zeros((len(theta), 3 * mesh.nodes, 3))
    for component, sign in enumerate(mirror_signs(symmetry, x < 0.0, y < 0.0)):
        out[component::3, component] = sign * values
        d_out[:, component::3, component] = sign * slopes
    if symmetry is AS:
        swap = swap_displacements(mesh)
        return out[swap], d_out[:, swap]
    return out, d_out


def mirror_signs(symmetry: Symmetry, left: bool, below: bool) -> tuple[int, int, int]:
    """Signs of u_x, u_y, u_z in a quadrant against the first quadrant."""
    sign = (symmetry.x if left else 1) * (symmetry.y if below else 1)
    return (-sign if left else sign, -sign if below else sign, sign)
