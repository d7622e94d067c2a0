"""The rib-reinforced stage: parameters, lengths, mass, rigid-body modes; its quarter as a mesh.

The quarter x, y >= 0 is a fixed grid of boxes of Lagrange elements."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.polynomial import legendre

from ccd_casadi.plants.finite_elements import Material
from ccd_casadi.support.arrays import Array

NAMES = ("h", "t_o", "t_i", "t_c", "H", "x_i")
LOWER = (1e-3, 3e-3, 3e-3, 3e-3, 6e-3, 67.5e-3)
UPPER = (4e-3, 8e-3, 8e-3, 8e-3, 20e-3, 95e-3)
IS_RIB = (True, False, True, False, True)  # t_c/2, b_2, t_i, b_1, t_o: from the centre

Point = tuple[float, float]


@dataclass(frozen=True)
class PointMass:
    """A magnet or target: mass in kg without rotary inertia, fixed to the lower face at (x, y)."""

    x: float
    y: float
    mass: float


@dataclass(frozen=True)
class Geometry:
    """The quantities of the stage that do not change with θ: side in m, material, added masses,
    least bay."""

    side: float = 0.3
    material: Material = field(default_factory=Material)
    point_masses: tuple[PointMass, ...] = ()
    least_bay: float = 8e-3


@dataclass(frozen=True)
class MassProperties:
    """Mass (kg), centre of gravity (m) and inertia tensor about it (kg m²), rows x, y, z.

    Entries are floats or CasADi expressions, as θ is.
    """

    mass: Any
    centre: tuple[Any, Any, Any]
    inertia: tuple[tuple[Any, Any, Any], ...]


def corners(geometry: Geometry) -> tuple[Point, ...]:
    """The four corners of the lower face, counter-clockwise from (+, +)."""
    a = 0.5 * geometry.side
    return ((a, a), (-a, a), (-a, -a), (a, -a))


def axis_lengths(geometry: Geometry) -> tuple[Array, Array]:
    """(5,) and (5, 6): lengths of an axis' intervals from the centre outwards are l₀ + S θ."""
    offset = np.array([0.0, 0.0, 0.0, 0.5 * geometry.side, 0.0])
    slope = np.zeros((5, 6))
    t_o, t_i, t_c, x_i = (NAMES.index(name) for name in ("t_o", "t_i", "t_c", "x_i"))
    slope[0, t_c] = 0.5
    slope[1, [x_i, t_i, t_c]] = 1.0, -0.5, -0.5
    slope[2, t_i] = 1.0
    slope[3, [x_i, t_o, t_i]] = -1.0, -1.0, -0.5
    slope[4, t_o] = 1.0
    return offset, slope


def height_lengths() -> tuple[Array, Array]:
    """(2,) and (2, 6): plate thickness and rib height, as `axis_lengths`."""
    slope = np.zeros((2, 6))
    slope[0, NAMES.index("h")] = slope[1, NAMES.index("H")] = 1.0
    return np.zeros(2), slope


def bays(geometry: Geometry, theta: Sequence[Any]) -> tuple[Any, Any]:
    """Widths (b_1, b_2) of the outer and the inner bay in m; floats or CasADi symbols."""
    _, t_o, t_i, t_c, _, x_i = theta
    return 0.5 * geometry.side - x_i - t_o - 0.5 * t_i, x_i - 0.5 * t_i - 0.5 * t_c


def constraints(geometry: Geometry, theta: Sequence[Any]) -> dict[str, Any]:
    """λ(θ) = 1 - b/b_least for both bays, without unit, met where <= 0."""
    outer, inner = bays(geometry, theta)
    return {"bay_1": 1.0 - outer / geometry.least_bay, "bay_2": 1.0 - inner / geometry.least_bay}


def mass(geometry: Geometry, theta: Sequence[Any]) -> Any:
    """Mass in kg, ρ (L² h + (L² - W²) H) + point masses, W the sum of an axis' bays.

    >>> theta = (1e-3, 3e-3, 8e-3, 8e-3, 16.806e-3, 67.5e-3)
    >>> f"{mass(Geometry(), theta):.4f}"
    '1.0189'
    """
    return mass_properties(geometry, theta).mass


def mass_properties(geometry: Geometry, theta: Sequence[Any]) -> MassProperties:
    """Mass, centre of gravity and inertia in closed form, exact for the stage as drawn."""
    h, _, t_i, t_c, H, x_i = theta
    L, rho = geometry.side, geometry.material.density
    outer, inner = bays(geometry, theta)
    W = 2.0 * (outer + inner)
    inner_end, outer_start = 0.5 * t_c + inner, x_i + 0.5 * t_i
    # ∫y² over an axis' bays; ribs are the square less bays times bays
    square = (inner_end**3 - (0.5 * t_c) ** 3) + ((outer_start + outer) ** 3 - outer_start**3)
    plate, ribs = rho * L**2 * h, rho * (L**2 - W**2) * H
    second = rho * (h * L**4 / 12.0 + H * (L**4 / 12.0 - W * 2.0 * square / 3.0))
    first_z = plate * h / 2.0 + ribs * (h + H / 2.0)
    second_z = plate * h**2 / 3.0 + ribs * (h**2 + h * H + H**2 / 3.0)
    added = geometry.point_masses  # all at z = 0
    total = plate + ribs + sum(p.mass for p in added)
    x = sum(p.mass * p.x for p in added) / total
    y = sum(p.mass * p.y for p in added) / total
    z = first_z / total
    xx = second + sum(p.mass * p.x**2 for p in added) - total * x * x
    yy = second + sum(p.mass * p.y**2 for p in added) - total * y * y
    zz = second_z - total * z * z
    xy = sum(p.mass * p.x * p.y for p in added) - total * x * y
    xz, yz = -total * x * z, -total * y * z
    inertia = ((yy + zz, -xy, -xz), (-xy, xx + zz, -yz), (-xz, -yz, xx + yy))
    return MassProperties(total, (x, y, z), inertia)


def has_square_symmetry(geometry: Geometry) -> bool:
    """Whether the point masses look the same after any mirror or quarter turn of the square."""

    def table(points: list[tuple[float, float, float]]) -> list[tuple[float, ...]]:
        heavy = [p for p in points if p[2] != 0.0]
        return sorted(tuple(round(v, 12) + 0.0 for v in p) for p in heavy)

    here = [(p.x, p.y, p.mass) for p in geometry.point_masses]
    mirrored = [(-x, y, m) for x, y, m in here]
    swapped = [(y, x, m) for x, y, m in here]
    return table(here) == table(mirrored) == table(swapped)


RIGID_NAMES = ("z", "tip", "tilt")


def rigid_fields(geometry: Geometry, points: Sequence[Point]) -> ca.Function:
    """θ -> u_z of the three modes at points of the lower face, (3, points) in 1/√kg, and ∂/∂θ."""
    theta = ca.SX.sym("theta", len(NAMES))
    modes = _coefficients(geometry, theta)
    x = ca.DM([[p[0] for p in points]])
    y = ca.DM([[p[1] for p in points]])
    one = ca.DM.ones(1, len(points))
    field = ca.densify(modes @ ca.vertcat(one, y, x))
    slope = ca.densify(ca.jacobian(ca.vec(field), theta))
    return ca.Function("rigid_fields", [theta], [field, slope])


def rigid_values(function: ca.Function, theta: Array) -> tuple[Array, Array]:
    """(3, points) and (θ, 3, points) from `rigid_fields`."""
    field, slope = (np.array(value) for value in function(theta))
    return field, slope.reshape(field.shape[1], field.shape[0], len(theta)).transpose(2, 1, 0)


def _coefficients(geometry: Geometry, theta: ca.SX) -> ca.SX:
    """(3, 3): u_z = c_0 + c_1 y + c_2 x of each mode."""
    body = mass_properties(geometry, [theta[i] for i in range(len(NAMES))])
    J, (x_c, y_c, _) = body.inertia, body.centre
    S_aa = J[0][0] - J[0][2] ** 2 / J[2][2]
    S_bb = J[1][1] - J[1][2] ** 2 / J[2][2]
    S_ab = -(J[0][1] - J[0][2] * J[1][2] / J[2][2])  # b turns about -y
    L_aa = ca.sqrt(S_aa)
    L_ba = S_ab / L_aa
    L_bb = ca.sqrt(S_bb - L_ba**2)
    tip_a = 1.0 / L_aa
    tilt_a, tilt_b = -L_ba / (L_aa * L_bb), 1.0 / L_bb
    return ca.vertcat(
        ca.horzcat(1.0 / ca.sqrt(body.mass), 0.0, 0.0),
        ca.horzcat(-tip_a * y_c, tip_a, 0.0),
        ca.horzcat(-tilt_a * y_c - tilt_b * x_c, tilt_a, tilt_b),
    )


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
        """The number of nodes along this axis."""
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
