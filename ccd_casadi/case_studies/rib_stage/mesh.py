"""The quarter x >= 0, y >= 0 as a fixed grid of boxes whose edges are affine in θ.

Each interval of the axes carries one or several Lagrange elements of high order: a plate bay
1 mm thick does not lock at order five, a rib twists right from order three on, and narrow
elements of order two beside the ribs catch the singular edges there (they pay more than any
order: without them errors double). Nodes are numbered once; θ only moves them.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ccd_casadi.case_studies.rib_stage.geometry import (
    IS_RIB,
    Geometry,
    axis_lengths,
    height_lengths,
)
from ccd_casadi.case_studies.rib_stage.reference import line_nodes, line_values
from ccd_casadi.support.arrays import Array

Cells = tuple[tuple[float, int], ...]


@dataclass(frozen=True)
class MeshOrder:
    """Elements of each interval as (share of its length, polynomial order).

    Bays and ribs count along x and y, height and plate along z. The shares mirror themselves,
    but for those along the height, which count from the plate upwards. The default is the mesh
    shipped; COARSE is for quick tests, FINE for verification.
    """

    bay: Cells = ((0.03, 2), (0.94, 5), (0.03, 2))
    rib: Cells = ((1.0, 3),)
    height: Cells = ((1.0, 3),)
    plate: Cells = ((1.0, 2),)


def plain(bay: int, rib: int, height: int, plate: int = 2) -> MeshOrder:
    """One element an interval, of these orders."""
    return MeshOrder(((1.0, bay),), ((1.0, rib),), ((1.0, height),), ((1.0, plate),))


COARSE = plain(4, 2, 2)
FINE = MeshOrder(((0.03, 2), (0.94, 6), (0.03, 2)), ((1.0, 4),), ((0.06, 2), (0.94, 4)))


@dataclass(frozen=True)
class Axis:
    """One direction: cell lengths l₀ + S θ, orders, the first node of each cell and rib cells."""

    offset: Array
    slope: Array
    orders: tuple[int, ...]
    starts: tuple[int, ...]
    rib: tuple[bool, ...]

    @property
    def nodes(self) -> int:
        """How many nodes lie along this axis."""
        return self.starts[-1] + self.orders[-1] + 1

    def lengths(self, theta: Array) -> Array:
        """(cells,) lengths in m."""
        return self.offset + self.slope @ theta

    def positions(self, theta: Array) -> Array:
        """(nodes,) coordinates in m."""
        lengths = self.lengths(theta)
        edges = np.concatenate([[0.0], np.cumsum(lengths)])
        out = np.zeros(self.nodes)
        for cell, order in enumerate(self.orders):
            first = self.starts[cell]
            out[first : first + order + 1] = edges[cell] + lengths[cell] * line_nodes(order)
        return out

    def interpolate(self, theta: Array, value: float) -> tuple[Array, Array]:
        """Shape functions at a fixed coordinate: (nodes,) and their derivative (θ, nodes).

        The point stays while the mesh moves, hence dN = N'(ξ) dξ/dθ. On the border of two
        cells the derivative is that of the inner cell.
        """
        lengths = self.lengths(theta)
        edges = np.concatenate([[0.0], np.cumsum(lengths)])
        last = len(lengths) - 1
        cell = int(np.clip(np.searchsorted(edges, value * (1.0 - 1e-12)) - 1, 0, last))
        edge_slope = self.slope[:cell].sum(axis=0)
        xi = (value - edges[cell]) / lengths[cell]
        N, dN = line_values(self.orders[cell], np.array([xi]))
        span = slice(self.starts[cell], self.starts[cell] + self.orders[cell] + 1)
        values, slopes = np.zeros(self.nodes), np.zeros((len(theta), self.nodes))
        values[span] = N[0]
        slopes[:, span] = -np.outer(edge_slope + xi * self.slope[cell], dN[0]) / lengths[cell]
        return values, slopes


@dataclass(frozen=True)
class Block:
    """A box of the grid: its cell along x, y, z, the orders and its nodes (x slowest)."""

    cells: tuple[int, int, int]
    orders: tuple[int, int, int]
    nodes: np.ndarray


@dataclass(frozen=True)
class Mesh:
    """Axes along x (and y, which is alike) and z, boxes, and node (i, j, k) -> number or -1."""

    plan: Axis
    height: Axis
    blocks: tuple[Block, ...]
    number: np.ndarray
    grid: np.ndarray  # (nodes, 3): i, j, k of each node

    @property
    def nodes(self) -> int:
        """Number of nodes of the quarter; it has three times as many displacements."""
        return len(self.grid)

    def coordinates(self, theta: Array) -> Array:
        """(nodes, 3) positions in m."""
        x, z = self.plan.positions(theta), self.height.positions(theta)
        return np.stack([x[self.grid[:, 0]], x[self.grid[:, 1]], z[self.grid[:, 2]]], axis=1)

    def interpolate(self, theta: Array, x: float, y: float) -> tuple[Array, Array]:
        """(nodes,) weights of the point (x, y, 0), x, y >= 0, and derivatives (θ, nodes)."""
        (Nx, dNx), (Ny, dNy) = self.plan.interpolate(theta, x), self.plan.interpolate(theta, y)
        number = self.number[:, :, 0].ravel()
        values, slopes = np.zeros(self.nodes), np.zeros((len(theta), self.nodes))
        values[number] = np.outer(Nx, Ny).ravel()
        for t in range(len(theta)):
            slopes[t, number] = (np.outer(dNx[t], Ny) + np.outer(Nx, dNy[t])).ravel()
        return values, slopes


def _axis(offset: Array, slope: Array, cells: list[Cells], rib: tuple[bool, ...]) -> Axis:
    parts = [(interval, *cell) for interval, group in enumerate(cells) for cell in group]
    index = np.array([part[0] for part in parts])
    share = np.array([part[1] for part in parts])
    orders = tuple(part[2] for part in parts)
    starts = (0, *np.cumsum(orders)[:-1].tolist())
    ribs = tuple(rib[part[0]] for part in parts)
    return Axis(offset[index] * share, slope[index] * share[:, None], orders, starts, ribs)


@lru_cache(maxsize=8)
def build_mesh(order: MeshOrder, side: float) -> Mesh:
    """The quarter mesh of a stage with this side in m; θ does not enter."""
    plan_cells = [order.rib if rib else order.bay for rib in IS_RIB]
    plan = _axis(*axis_lengths(Geometry(side=side)), plan_cells, IS_RIB)
    height = _axis(*height_lengths(), [order.plate, order.height], (False, True))
    spans = [
        [np.arange(s, s + p + 1) for s, p in zip(axis.starts, axis.orders, strict=True)]
        for axis in (plan, height)
    ]
    boxes = [
        (i, j, k)
        for i in range(len(plan.orders))
        for j in range(len(plan.orders))
        for k in range(len(height.orders))
        if not height.rib[k] or plan.rib[i] or plan.rib[j]
    ]
    used = np.zeros((plan.nodes, plan.nodes, height.nodes), bool)
    for i, j, k in boxes:
        used[np.ix_(spans[0][i], spans[0][j], spans[1][k])] = True
    number = np.where(used, np.cumsum(used).reshape(used.shape) - 1, -1)
    blocks = tuple(
        Block(
            (i, j, k),
            (plan.orders[i], plan.orders[j], height.orders[k]),
            number[np.ix_(spans[0][i], spans[0][j], spans[1][k])].ravel(),
        )
        for i, j, k in boxes
    )
    return Mesh(plan, height, blocks, number, np.argwhere(used))
