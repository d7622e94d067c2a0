"""K(θ) and M(θ) of one symmetry of the square in a fixed sparsity pattern."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.polynomial import legendre
from scipy import sparse

from ccd_casadi.extensions.rib_stage.geometry import Block, Mesh, Point, line_values
from ccd_casadi.plants.finite_elements import Material
from ccd_casadi.support.arrays import Array

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


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


# exponents of (l_x, l_y, l_z) in the coefficients: the six of K, then that of M
EXPONENTS = np.array([[1 - (d == p) - (d == q) for d in range(3)] for p, q in PAIRS] + [[1, 1, 1]])
COPIES = 4  # quarters in the stage


@dataclass(frozen=True)
class Pattern:
    """Rows and columns of the lower half of a CSR matrix, and which entries of the boxes its data
    are sums of, in as few bytes as hold them: those of a fine mesh are millions.

    A datum is Σ sign · entry, times √½ for its row and for its column where these are `shared`
    (`Fold.shared`). `signs` are ±1 and ±2 (int8), at `boxes`; `counts` of them make a datum.
    """

    indices: np.ndarray
    indptr: np.ndarray
    shared: np.ndarray
    signs: np.ndarray
    boxes: np.ndarray
    counts: np.ndarray

    def fill(self, values: Array, *, at_once: int = 500_000) -> sparse.csr_matrix:
        """The symmetric matrix with these entries of the boxes, concatenated.

        `at_once` data are summed: the signs of all as floats are 100 MB.
        """
        size, data = len(self.indptr) - 1, np.empty(len(self.counts))
        first = np.append(0, np.cumsum(self.counts, dtype=np.int32))
        for low in range(0, len(data), at_once):
            own = first[low : low + at_once + 1]
            part, count = slice(own[0], own[-1]), len(own) - 1
            entries = self.signs[part], self.boxes[part], own - own[0]
            terms = sparse.csr_matrix(entries, shape=(count, len(values)))
            data[low : low + count] = terms @ values
        halves = np.repeat(self.shared, np.diff(self.indptr)) + self.shared[self.indices]
        data *= np.array([1.0, np.sqrt(0.5), 0.5])[halves]
        data[self.indptr[1:] - 1] *= 0.5  # the diagonal, which both halves have
        lower = sparse.csr_matrix((data, self.indices, self.indptr), shape=(size, size))
        return lower + lower.T.tocsr()


@dataclass(frozen=True)
class Sector:
    """One symmetry on one mesh: its fold, and patterns for the stiffness and the mass."""

    fold: Fold
    stiffness: Pattern
    mass: Pattern
    maps: tuple[tuple[int, np.ndarray, Array, int], ...]  # box, displacements, weights, copies


@dataclass(frozen=True)
class Assembler:
    """The boxes on or below the diagonal of a mesh, and its symmetries."""

    mesh: Mesh
    material: Material
    blocks: tuple[Block, ...]

    def lengths(self, theta: Array) -> tuple[Array, Array]:
        """(blocks, 3) edges in m and their slopes (blocks, 3, θ)."""
        plan, height = self.mesh.plan, self.mesh.height
        cells = np.array([block.cells for block in self.blocks])
        in_plan, in_height = plan.lengths(theta), height.lengths(theta)
        edges = np.stack([in_plan[cells[:, 0]], in_plan[cells[:, 1]], in_height[cells[:, 2]]], 1)
        slopes = [plan.slope[cells[:, 0]], plan.slope[cells[:, 1]], height.slope[cells[:, 2]]]
        return edges, np.stack(slopes, 1)

    def coefficients(self, theta: Array) -> tuple[Array, Array]:
        """c (blocks, 7) and dc (θ, blocks, 7): six of K and that of M, for the whole stage."""
        edges, slopes = self.lengths(theta)
        c = COPIES * np.prod(edges[:, None, :] ** EXPONENTS[None], axis=2)
        c[:, 6] *= self.material.density
        relative = slopes / edges[:, :, None]
        return c, np.einsum("bq,qd,bdt->tbq", c, EXPONENTS, relative)

    def box_matrices(self, theta: Array, shift: float) -> tuple[Array, Array]:
        """Entries of K_e + shift M_e and of the scalar mass matrices, boxes concatenated."""
        c, _ = self.coefficients(theta)
        stiff, mass = [], []
        for block, factors in zip(self.blocks, c, strict=True):
            M = factors[6] * cube_mass(block.orders)
            K = np.zeros((len(M), 3, len(M), 3))
            for pair, i, j, part in cube_stiffness(block.orders, self.material):
                K[:, i, :, j] += factors[pair] * part
            for component in range(3):
                K[:, component, :, component] += shift * M
            stiff.append(K.ravel())
            mass.append(M.ravel())
        return np.concatenate(stiff), np.concatenate(mass)

    def bilinear(self, sector: Sector, left: Array, right: Array) -> Array:
        """leftᵀ K_q right and leftᵀ M_q right of every box: (blocks, 7, a, b), reduced vectors."""
        out = np.zeros((len(self.blocks), 7, left.shape[1], right.shape[1]))
        pad = [np.vstack([v, np.zeros((1, v.shape[1]))]) for v in (left, right)]
        for box, places, weight, copies in sector.maps:
            block = self.blocks[box]
            a, b = (weight[:, None] * v[sector.fold.index[places]] for v in pad)
            n, M = len(block.nodes), cube_mass(block.orders)
            out[box, 6] += copies * (a.T @ (M @ b.reshape(n, -1)).reshape(b.shape))
            a, b = (v.reshape(n, 3, -1).transpose(1, 0, 2) for v in (copies * a, b))
            for pair, i, j, part in cube_stiffness(block.orders, self.material):
                out[box, pair] += a[i].T @ (part @ b[j])
        return out

    def apply_slopes(self, sector: Sector, theta: Array, values: Array, vectors: Array) -> Array:
        """(∂K - λ ∂M) φ of modes (n, k) with λ (k,): (n, θ k), reduced vectors."""
        _, dc = self.coefficients(theta)
        k, n = len(values), sector.fold.size
        out = np.zeros((n + 1, len(theta) * k))
        padded = np.vstack([vectors, np.zeros((1, k))])
        for box, places, weight, copies in sector.maps:
            block = self.blocks[box]
            index = sector.fold.index[places]
            b = (weight[:, None] * padded[index]).reshape(len(block.nodes), 3, k)
            wide = np.tensordot(cube_mass(block.orders), b, 1) * values
            d = dc[:, box, :, None, None]
            found = -d[:, 6, None] * wide
            for pair, i, j, part in cube_stiffness(block.orders, self.material):
                found[:, :, i] += d[:, pair] * (part @ b[:, j])
            moved = found.reshape(len(theta), len(index), k).transpose(1, 0, 2)
            rows = copies * weight[:, None] * moved.reshape(len(index), -1)
            np.add.at(out, index, rows)
        return out[:n]

    def slopes(self, sector: Sector, theta: Array, left: Array, right: Array) -> tuple[Array, ...]:
        """leftᵀ ∂K right and leftᵀ ∂M right, each (θ, a, b)."""
        _, dc = self.coefficients(theta)
        forms = self.bilinear(sector, left, right)
        return (
            np.einsum("tbq,bqij->tij", dc[:, :, :6], forms[:, :6]),
            np.einsum("tb,bij->tij", dc[:, :, 6], forms[:, 6]),
        )


def build_assembler(mesh: Mesh, material: Material) -> Assembler:
    """The assembler of a mesh; a box and its mirror image about x = y are one."""
    half = tuple(block for block in mesh.blocks if block.cells[0] <= block.cells[1])
    return Assembler(mesh, material, half)


def build_sector(assembler: Assembler, symmetry: Symmetry) -> Sector:
    """Fold and patterns of a symmetry; θ does not enter."""
    folded = fold(assembler.mesh, symmetry)
    swap = swap_displacements(assembler.mesh)
    maps = []
    for box, block in enumerate(assembler.blocks):
        places = (3 * block.nodes[:, None] + np.arange(3)).ravel()
        mirrored = block.cells[0] != block.cells[1]
        copies = 2 if mirrored and symmetry.diagonal else 1
        maps.append((box, places, folded.weight[places], copies))
        if mirrored and not symmetry.diagonal:
            image = swap[places]
            maps.append((box, image, folded.weight[image], 1))
    sizes = [3 * len(block.nodes) for block in assembler.blocks]
    stiffness, mass = (_pattern(maps, folded, sizes, stride) for stride in (1, 3))
    return Sector(folded, stiffness, mass, tuple(maps))


def _pattern(
    maps: list[tuple[int, np.ndarray, Array, int]], folded: Fold, sizes: list[int], stride: int
) -> Pattern:
    """Stride 1: every pair of displacements; 3: pairs of one component, boxes being scalar."""
    starts = np.concatenate([[0], np.cumsum([(size // stride) ** 2 for size in sizes])])
    rows, columns, boxes, signs = [], [], [], []
    for box, places, weight, copies in maps:
        for part in range(stride):
            # a mirror image swaps components within a node: part still names one of the box's
            index = folded.index[places[part::stride]]
            w = np.sign(weight[part::stride]).astype(np.int8)
            live = np.flatnonzero(index >= 0)
            n = len(index)
            i, j = np.repeat(live, len(live)), np.tile(live, len(live))
            lower = index[i] >= index[j]
            i, j = i[lower], j[lower]
            rows.append(index[i].astype(np.int32))
            columns.append(index[j].astype(np.int32))
            boxes.append((starts[box] + i * n + j).astype(np.int32))
            signs.append(np.int8(copies) * w[i] * w[j])
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = _sorted_by(column, folded.size)
    order = order[_sorted_by(row[order], folded.size)]
    row, column = row[order], column[order]
    first = np.flatnonzero((np.diff(row, prepend=-1) != 0) | (np.diff(column, prepend=-1) != 0))
    counts = np.diff(np.append(first, len(order))).astype(np.uint8)
    filled = np.bincount(row[first], minlength=folded.size)
    indptr = np.concatenate([[0], np.cumsum(filled)]).astype(np.int32)
    added = np.concatenate(signs)[order], np.concatenate(boxes)[order]
    return Pattern(column[first], indptr, folded.shared, *added, counts)


def _sorted_by(key: np.ndarray, size: int) -> np.ndarray:
    """The stable order of whole numbers below `size`, in linear time: a transposed CSR matrix."""
    count = len(key)
    bins = sparse.csr_matrix(
        (np.ones(count, dtype=bool), key, np.arange(count + 1, dtype=np.int32)), shape=(count, size)
    )
    return bins.tocsc().indices
