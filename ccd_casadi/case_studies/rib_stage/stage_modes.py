"""The flexible modes of the stage at one θ, with exact derivatives of λ and of displacements.

Each symmetry is an eigenproblem of its own, so the double frequencies of a square stage are
simple here. Point masses that break the square couple symmetries: these form a direct sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import qr

from ccd_casadi.case_studies.rib_stage.assembly import (
    ALL,
    AS,
    SA,
    SOLVED,
    Assembler,
    Sector,
    Symmetry,
    build_assembler,
    build_sector,
    point_functional,
    swap_displacements,
)
from ccd_casadi.case_studies.rib_stage.geometry import (
    Geometry,
    Material,
    Point,
    PointMass,
    has_square_symmetry,
)
from ccd_casadi.case_studies.rib_stage.mesh import MeshOrder, build_mesh
from ccd_casadi.plants.eigenpairs import (
    Pencil,
    build_pencil,
    build_resolvent,
    flexible_modes,
    orthonormal,
)
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class StageModeOptions:
    """Numbers of the stage's eigenproblems.

    Attributes
    ----------
    shift : float
        rad²/s²: K + shift M is factored.
    cluster : float
        Relative distance below which two eigenvalues are differentiated as a pair.
    extra : int
        Modes solved beyond those kept, with which the resolvent converges faster.
    """

    shift: float = (2.0 * np.pi * 100.0) ** 2
    cluster: float = 1e-7
    extra: int = 2


@dataclass(frozen=True)
class Discretisation:
    """What a mesh and a material fix before θ is known."""

    assembler: Assembler
    sectors: dict[str, Sector]
    side: float


@lru_cache(maxsize=4)
def discretise(order: MeshOrder, side: float, material: Material) -> Discretisation:
    """Mesh, folds and sparsity patterns; a second or two, once."""
    assembler = build_assembler(build_mesh(order, side), material)
    return Discretisation(assembler, {s.name: build_sector(assembler, s) for s in SOLVED}, side)


@dataclass(frozen=True)
class Group:
    """Symmetries solved together, and those whose modes they give: SA gives AS as well."""

    solved: tuple[Symmetry, ...]
    images: tuple[tuple[Symmetry, ...], ...]


SQUARE_GROUPS = tuple(Group((s,), ((s,), (AS,)) if s is SA else ((s,),)) for s in SOLVED)


def groups_of(geometry: Geometry) -> tuple[Group, ...]:
    """The symmetries that point masses leave apart: each, those even and odd about an axis on which
    all masses lie, or none. Modes of two groups cross where θ moves; those of one do not."""
    if has_square_symmetry(geometry):
        return SQUARE_GROUPS
    for axis in ("y", "x"):
        if not any(getattr(mass, axis) for mass in geometry.point_masses):
            sides = (tuple(s for s in ALL if getattr(s, axis) == sign) for sign in (1, -1))
            return tuple(Group(side, (side,)) for side in sides)
    return (Group(ALL, (ALL,)),)


@dataclass(frozen=True)
class Spectrum:
    """Flexible modes of a group: λ in rad²/s², and M-orthonormal vectors (n, k), n summed."""

    group: Group
    theta: Array
    pencil: Pencil
    rigid: Array
    values: Array
    vectors: Array


def sector_of(disc: Discretisation, symmetry: Symmetry) -> Sector:
    """The sector that holds a symmetry's matrices; AS is solved in those of SA."""
    return disc.sectors[SA.name if symmetry is AS else symmetry.name]


def functionals(
    disc: Discretisation, image: Sequence[Symmetry], theta: Array, points: Sequence[Point]
) -> tuple[Array, Array]:
    """(n, 3, points) displacements at points of the lower face, and (θ, n, 3, points)."""
    values, steps = [], []
    for symmetry in image:
        T = sector_of(disc, symmetry).fold.matrix
        here = [point_functional(disc.assembler.mesh, symmetry, theta, p) for p in points]
        shape, n = (3, len(points)), T.shape[1]
        values.append(T.T @ np.stack([g for g, _ in here], axis=2).reshape(-1, 3 * len(points)))
        values[-1] = values[-1].reshape(n, *shape)
        moved = np.stack([dg for _, dg in here], axis=3)
        step = np.zeros((len(theta), n, *shape))
        for t in range(len(theta)):
            if np.any(moved[t]):  # corners and centre stay on their nodes
                step[t] = (T.T @ moved[t].reshape(-1, 3 * len(points))).reshape(n, *shape)
        steps.append(step)
    return np.concatenate(values), np.concatenate(steps, axis=1)


def spectrum(
    disc: Discretisation,
    geometry: Geometry,
    theta: Array,
    group: Group,
    count: int,
    boxes: tuple[Array, Array] | None = None,
    *,
    options: StageModeOptions = StageModeOptions(),
) -> Spectrum:
    """The `count` lowest flexible modes of a group, signed by `sign_functional`.

    `boxes`: `Assembler.box_matrices` at θ and `shift`, which all groups share, if known.
    """
    shift = options.shift
    stiff, body = disc.assembler.box_matrices(theta, shift) if boxes is None else boxes
    sectors = [sector_of(disc, symmetry) for symmetry in group.solved]
    G, masses, _ = _point_masses(disc, group, theta, geometry.point_masses)
    shifted = (sector.stiffness.fill(stiff) for sector in sectors)  # one at a time: they are large
    bodies = [sector.mass.fill(body) for sector in sectors]
    pencil = build_pencil(shifted, bodies, shift, G, masses)
    rigid = orthonormal(pencil, rigid_vectors(disc, group, theta))
    values, vectors = flexible_modes(pencil, rigid, count)
    vectors = vectors * np.where(sign_functional(disc, group, theta) @ vectors < 0.0, -1.0, 1.0)
    return Spectrum(group, theta, pencil, rigid, values, vectors)


@dataclass(frozen=True)
class GroupModes:
    """Modes of a group without its factorisation: λ (k,), vectors (n, k), and `slopes` of them."""

    group: Group
    values: Array
    vectors: Array
    slopes: tuple[Array, Array] | None


def group_modes(
    disc: Discretisation, geometry: Geometry, found: Spectrum, keep: int, points: Sequence[Point]
) -> GroupModes:
    """Those of a spectrum, with slopes of the `keep` lowest if there are points to see them at."""
    moved = None
    if points:
        F, dF = heights(disc, found.group, found.theta, points)
        moved = slopes(disc, geometry, found, keep, F, dF)
    return GroupModes(found.group, found.values, found.vectors, moved)


def heights(
    disc: Discretisation, group: Group, theta: Array, points: Sequence[Point]
) -> tuple[Array, Array]:
    """u_z at points, image after image: (n, images points), and (θ, n, images points)."""
    made = [functionals(disc, image, theta, points) for image in group.images]
    return (
        np.hstack([values[:, 2] for values, _ in made]),
        np.concatenate([steps[:, :, 2] for _, steps in made], axis=2),
    )


def slopes(
    disc: Discretisation, geometry: Geometry, found: Spectrum, keep: int, F: Array, dF: Array
) -> tuple[Array, Array]:
    """∂K (θ, k, k) and ∂(Fᵀφ) (θ, r, k) of the k = `keep` lowest modes, F (n, r), dF (θ, n, r).

    φ' = -½ φ φᵀM'φ - (K - λM)⁺ (K' - λM') φ, taken from the side of F:
    Fᵀφ' = -½ (Fᵀφ) φᵀM'φ - Zᵀ(K' - λM')φ, Z = (K - λM)⁺F, so that the number of θ costs nothing.
    Within a cluster the modes are not told apart: M stays I, K' has entries off the diagonal.
    """
    lam, V = found.values, found.vectors
    rigid, kept = found.rigid, V[:, :keep]
    Q, R = compressed(F)
    resolvent = build_resolvent(found.pencil, np.hstack([rigid, V]), Q, lam[keep - 1])
    close = np.abs(lam[:keep, None] - lam[None, :]) <= StageModeOptions.cluster * lam[None, :]
    adjoint = []
    for i in range(keep):
        gap = np.where(close[i], np.inf, lam - lam[i])
        Z = resolvent(lam[i]) + V @ ((V.T @ Q) / gap[:, None]) - rigid @ (rigid.T @ Q) / lam[i]
        adjoint.append(Z @ R)
    rank = F.shape[1]
    left = np.hstack([kept, *adjoint])
    dK, dM = _forms(disc, geometry, found, left, kept)
    own_K, own_M = dK[:, :keep], dM[:, :keep]
    mean = 0.5 * (lam[:keep, None] + lam[None, :keep])
    pair = close[:, :keep]
    out_K = np.where(pair, own_K - mean * own_M, 0.0)
    dU = np.einsum("tnr,nk->trk", dF, kept)
    dU -= 0.5 * np.einsum("jr,tji->tri", kept.T @ F, np.where(pair, own_M, 0.0))
    for i in range(keep):
        rows = slice(keep + i * rank, keep + (i + 1) * rank)
        dU[:, :, i] -= dK[:, rows, i] - lam[i] * dM[:, rows, i]
    return out_K, dU


def compressed(F: Array) -> tuple[Array, Array]:
    """F = Q R with as few columns as F has directions: corners differ by signs only."""
    Q, R, pivot = qr(F, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    rank = int((size > 1e-12 * max(size.max(initial=0.0), 1e-300)).sum())
    unpivoted = np.zeros_like(R[:rank])
    unpivoted[:, pivot] = R[:rank]
    return Q[:, :rank], unpivoted


def _forms(
    disc: Discretisation, geometry: Geometry, found: Spectrum, left: Array, right: Array
) -> tuple[Array, Array]:
    """leftᵀ ∂K right and leftᵀ ∂M right (θ, a, b), point masses included."""
    theta, group = found.theta, found.group
    dK = np.zeros((len(theta), left.shape[1], right.shape[1]))
    dM = np.zeros_like(dK)
    start = 0
    for symmetry in group.solved:
        sector = sector_of(disc, symmetry)
        rows = slice(start, start + sector.fold.size)
        part_K, part_M = disc.assembler.slopes(sector, theta, left[rows], right[rows])
        dK, dM, start = dK + part_K, dM + part_M, rows.stop
    G, masses, dG = _point_masses(disc, group, theta, geometry.point_masses)
    for t in range(len(theta)):
        if masses.size and np.any(dG[t]):
            moved = (left.T @ dG[t]) @ (masses[:, None] * (G.T @ right))
            moved += (left.T @ G) @ (masses[:, None] * (dG[t].T @ right))
            dM[t] += moved
    return dK, dM


def _point_masses(
    disc: Discretisation, group: Group, theta: Array, masses: Sequence[PointMass]
) -> tuple[Array, Array, Array]:
    """Functionals (n, 3 points), their masses (3 points,) and slopes (θ, n, 3 points)."""
    n = sum(sector_of(disc, s).fold.size for s in group.solved)
    if not masses:
        return np.zeros((n, 0)), np.zeros(0), np.zeros((len(theta), n, 0))
    G, dG = functionals(disc, group.images[0], theta, [(p.x, p.y) for p in masses])
    added = np.tile([p.mass for p in masses], 3)
    return G.reshape(n, -1), added, dG.reshape(len(theta), n, -1)


def rigid_vectors(disc: Discretisation, group: Group, theta: Array) -> Array:
    """The rigid-body motions within a group, (n, at most 6), not yet orthonormal."""
    mesh = disc.assembler.mesh
    x, y, z = mesh.coordinates(theta).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    motions = (
        ("A1", (zero, zero, one)),
        ("A2", (-y, x, zero)),
        ("SA", (zero, one, zero)),
        ("SA", (zero, -z, y)),
        ("AS", (one, zero, zero)),
        ("AS", (-z, zero, x)),
    )
    columns = []
    for name, motion in motions:
        field = np.stack(motion, axis=1).reshape(-1, 1)
        parts = []
        for symmetry in group.solved:
            folded = sector_of(disc, symmetry).fold
            here = field[swap_displacements(mesh)] if symmetry is AS else field
            active = float(symmetry.name == name)
            parts.append(active * (folded.matrix.T @ here))
        columns.append(np.concatenate(parts))
    live = [c for c in columns if np.any(c)]
    n = sum(sector_of(disc, s).fold.size for s in group.solved)
    return np.hstack(live) if live else np.zeros((n, 0))


def sign_functional(disc: Discretisation, group: Group, theta: Array) -> Array:
    """(n,) a functional made positive for every mode: u_z where its symmetry has an antinode.

    It moves smoothly with θ, so signs hold along a path of designs. In a whole model each
    symmetry's part counts; unequal weights of SA and AS keep pairs along the diagonals.
    """
    a = 0.5 * disc.side
    parts = []
    for symmetry in group.solved:
        point = {"B1": (a, 0.0), "A2": (a, 0.5 * a)}.get(symmetry.name, (a, a))
        weight = 0.6 if symmetry is AS else 1.0
        parts.append(weight * functionals(disc, (symmetry,), theta, [point])[0][:, 2, 0])
    return np.concatenate(parts)
