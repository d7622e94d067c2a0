"""The quarter x, y >= 0 as a fixed grid of boxes of Lagrange elements."""

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.polynomial import legendre

from ccd_casadi.extensions.rib_stage.geometry import IS_RIB, Geometry, axis_lengths, height_lengths
from ccd_casadi.plants.finite_elements import Material
from ccd_casadi.support.arrays import Array

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@cache
def line_nodes(order: int) -> Array:
    """Gauss-Lobatto points on [0, 1], both ends included; well conditioned at any order."""
    if order == 1:
        return np.array([0.0, 1.0])
    slope = legendre.legder([0.0] * order + [1.0])
    return 0.5 * (1.0 + np.concatenate([[-1.0], np.sort(legendre.legroots(slope)), [1.0]]))


def line_values(order: int, points: Array) -> tuple[Array, Array]:
    """(n, order + 1) values and slopes of the Lagrange polynomials at points of [0, 1]."""
    degrees = np.eye(order + 1)
    to_nodal = np.linalg.inv(legendre.legval(2.0 * line_nodes(order) - 1.0, degrees).T)
    xi = 2.0 * np.asarray(points, float) - 1.0
    slopes = 2.0 * legendre.legder(degrees)
    return legendre.legval(xi, degrees).T @ to_nodal, legendre.legval(xi, slopes).T @ to_nodal


@cache
def line_matrices(order: int) -> tuple[Array, Array, Array]:
    """∫NᵀN, ∫N'ᵀN, ∫N'ᵀN' over [0, 1]; the quadrature is exact."""
    points, weights = legendre.leggauss(order + 1)
    N, dN = line_values(order, 0.5 * (points + 1.0))
    w = 0.5 * weights[:, None]
    return N.T @ (w * N), dN.T @ (w * N), dN.T @ (w * dN)


@cache
def cube_mass(orders: tuple[int, int, int]) -> Array:
    """∫NᵀN over the unit cube, (n, n), n nodes with x slowest and z fastest."""
    return _tensor([line_matrices(p)[0] for p in orders])


@cache
def cube_stiffness(
    orders: tuple[int, int, int], material: Material
) -> tuple[tuple[int, int, int, Array], ...]:
    """K_pq of the PAIRS as (pair, i, j, (n, n) in Pa): what component j of nodes does to i.

    K_pq collects C_ikjl ∂_k N_a ∂_l N_b for {k, l} = {p, q}, with
    C_ikjl = λ δ_ik δ_jl + μ (δ_ij δ_kl + δ_il δ_kj). What is left out is zero.
    """
    lame, mu = material.lame
    lines = [line_matrices(p) for p in orders]

    def moved(k: int, m: int) -> Array:
        """∫ ∂_k N_a ∂_m N_b."""
        factors = []
        for axis, (mass, slope, stiffness) in enumerate(lines):
            if k == m == axis:
                factors.append(stiffness)
            elif axis == k:
                factors.append(slope)
            elif axis == m:
                factors.append(slope.T)
            else:
                factors.append(mass)
        return _tensor(factors)

    found = []
    for pair, (p, q) in enumerate(PAIRS):
        one = moved(p, q)
        if p == q:
            own = mu * one
            found += [(pair, i, i, (lame + 2.0 * mu) * one if i == p else own) for i in range(3)]
        else:
            across = lame * one + mu * one.T
            found += [(pair, p, q, across), (pair, q, p, across.T)]
    return tuple(found)


def _tensor(factors: list[Array]) -> Array:
    """Kronecker product, the first factor slowest."""
    x, y, z = factors
    return np.kron(np.kron(x, y), z)


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
class MeshAxis:
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

    plan: MeshAxis
    height: MeshAxis
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


def _axis(offset: Array, slope: Array, cells: list[Cells], rib: tuple[bool, ...]) -> MeshAxis:
    parts = [(interval, *cell) for interval, group in enumerate(cells) for cell in group]
    index = np.array([part[0] for part in parts])
    share = np.array([part[1] for part in parts])
    orders = tuple(part[2] for part in parts)
    starts = (0, *np.cumsum(orders)[:-1].tolist())
    ribs = tuple(rib[part[0]] for part in parts)
    return MeshAxis(offset[index] * share, slope[index] * share[:, None], orders, starts, ribs)


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
