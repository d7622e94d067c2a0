"""The flexible modes of the stage at one θ, with exact derivatives of λ and of displacements.

Each symmetry has its own eigenproblem K φ = λ M φ, so the double frequencies of a square stage are
simple here. Point masses that break the square couple symmetries, and the eigenproblem is that of
the direct sum of the coupled ones.

Shapes: n is the number of reduced displacements q, those of one symmetry on the quarter x, y >= 0,
and of several symmetries their sum; θ in a shape is the number of parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import qr

from ccd_casadi.extensions.rib_stage.assembly import (
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
from ccd_casadi.extensions.rib_stage.geometry import (
    Geometry,
    MeshOrder,
    Point,
    PointMass,
    build_mesh,
    has_square_symmetry,
)
from ccd_casadi.plants.finite_elements import (
    Material,
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
        rad²/s²: K + shift M is factored, which is positive definite although the stage floats.
    cluster : float
        Relative distance up to which two eigenvalues are one multiple eigenvalue to a derivative.
    extra : int
        Modes solved beyond those of the model. With them deflated, the resolvent (K - λM)⁺
        converges faster.
    """

    shift: float = (2.0 * np.pi * 100.0) ** 2
    cluster: float = 1e-7
    extra: int = 2


@dataclass(frozen=True)
class Discretisation:
    """The discretisation, which does not depend on θ: the mesh with its material, its sectors by
    the name of a symmetry, and the side of the square in m."""

    assembler: Assembler
    sectors: dict[str, Sector]
    side: float


@lru_cache(maxsize=4)
def discretise(order: MeshOrder, side: float, material: Material) -> Discretisation:
    """Build the mesh, and fold and sparsity pattern of each symmetry; cached, as it takes 1-2 s."""
    assembler = build_assembler(build_mesh(order, side), material)
    return Discretisation(assembler, {s.name: build_sector(assembler, s) for s in SOLVED}, side)


@dataclass(frozen=True)
class Group:
    """Symmetries in one eigenproblem.

    Attributes
    ----------
    solved : tuple of Symmetry
        Those whose matrices it is the direct sum of.
    images : tuple of tuples of Symmetry
        Each eigenvector q is a mode once per image, in which q is read as of these symmetries. On
        a square stage SA has two, (SA,) and (AS,): the modes of AS are mirrored about x = y.
    """

    solved: tuple[Symmetry, ...]
    images: tuple[tuple[Symmetry, ...], ...]


SQUARE_GROUPS = tuple(Group((s,), ((s,), (AS,)) if s is SA else ((s,),)) for s in SOLVED)


def groups_of(geometry: Geometry) -> tuple[Group, ...]:
    """The finest groups of symmetries that the point masses do not couple.

    With the symmetry of the square each symmetry is a group. With all masses on one axis there are
    two groups, the symmetries even and odd about it. Otherwise all symmetries are one group.
    Frequencies of two groups may cross along a path of θ, those of one group do not.
    """
    if has_square_symmetry(geometry):
        return SQUARE_GROUPS
    for axis in ("y", "x"):
        if not any(getattr(mass, axis) for mass in geometry.point_masses):
            parities = (tuple(s for s in ALL if getattr(s, axis) == sign) for sign in (1, -1))
            return tuple(Group(coupled, (coupled,)) for coupled in parities)
    return (Group(ALL, (ALL,)),)


@dataclass(frozen=True)
class Spectrum:
    """Flexible modes of a group at θ."""

    group: Group
    theta: Array
    pencil: Pencil  # products with M, and the factorisation of K + shift M
    rigid: Array  # (n, r) rigid-body motions, ΦᵀMΦ = I
    values: Array  # (k,) λ in rad²/s², ascending
    vectors: Array  # (n, k) Φ, ΦᵀMΦ = I


def sector_of(disc: Discretisation, symmetry: Symmetry) -> Sector:
    """The sector that has a symmetry's matrices; those of AS are those of SA."""
    return disc.sectors[SA.name if symmetry is AS else symmetry.name]


def functionals(
    disc: Discretisation, image: Sequence[Symmetry], theta: Array, points: Sequence[Point]
) -> tuple[Array, Array]:
    """F with u = Fᵀ q, the displacements (u_x, u_y, u_z) at points of the lower face, and ∂F/∂θ.

    Each symmetry's part is Tᵀ f: f is the functional of all displacements of the quarter, T its
    fold, which does not depend on θ.

    Returns
    -------
    F : array (n, 3, points)
    dF : array (θ, n, 3, points)
        The points are fixed in space while the mesh moves with θ.
    """
    F, dF = [], []
    for symmetry in image:
        T = sector_of(disc, symmetry).fold.matrix
        pairs = [point_functional(disc.assembler.mesh, symmetry, theta, p) for p in points]
        shape = (T.shape[1], 3, len(points))
        f = np.stack([each for each, _ in pairs], axis=2)
        df = np.stack([each for _, each in pairs], axis=3)
        F.append((T.T @ f.reshape(-1, 3 * len(points))).reshape(shape))
        part = np.zeros((len(theta), *shape))
        for t in range(len(theta)):
            if np.any(df[t]):  # zero for corners and centre, which stay on their nodes
                part[t] = (T.T @ df[t].reshape(-1, 3 * len(points))).reshape(shape)
        dF.append(part)
    return np.concatenate(F), np.concatenate(dF, axis=1)


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
    """The `count` lowest flexible modes of a group, of the sign for which `sign_functional` is > 0.

    `boxes`: `Assembler.box_matrices` at θ and `shift`, where a caller with several groups has them.
    """
    shift = options.shift
    stiffness, mass = disc.assembler.box_matrices(theta, shift) if boxes is None else boxes
    sectors = [sector_of(disc, symmetry) for symmetry in group.solved]
    G, m, _ = _point_masses(disc, group, theta, geometry.point_masses)
    A = (sector.stiffness.fill(stiffness) for sector in sectors)  # one at a time: they are large
    M = [sector.mass.fill(mass) for sector in sectors]
    pencil = build_pencil(A, M, shift, G, m)
    rigid = orthonormal(pencil, rigid_vectors(disc, group, theta))
    values, vectors = flexible_modes(pencil, rigid, count)
    vectors = vectors * np.where(sign_functional(disc, group, theta) @ vectors < 0.0, -1.0, 1.0)
    return Spectrum(group, theta, pencil, rigid, values, vectors)


@dataclass(frozen=True)
class GroupModes:
    """A `Spectrum` without its factorisation, which is large.

    `slopes` are those of the function of this name for u_z at points, None without points.
    """

    group: Group
    values: Array
    vectors: Array
    slopes: tuple[Array, Array] | None


def group_modes(
    disc: Discretisation, geometry: Geometry, modes: Spectrum, keep: int, points: Sequence[Point]
) -> GroupModes:
    """The modes of a spectrum, with the slopes of the `keep` lowest in u_z at `points`, if any."""
    derivatives = None
    if points:
        F, dF = heights(disc, modes.group, modes.theta, points)
        derivatives = slopes(disc, geometry, modes, keep, F, dF)
    return GroupModes(modes.group, modes.values, modes.vectors, derivatives)


def heights(
    disc: Discretisation, group: Group, theta: Array, points: Sequence[Point]
) -> tuple[Array, Array]:
    """F (n, r) of u_z = Fᵀ q at points, image after image (r = images × points); ∂F (θ, n, r)."""
    pairs = [functionals(disc, image, theta, points) for image in group.images]
    return (
        np.hstack([F[:, 2] for F, _ in pairs]),
        np.concatenate([dF[:, :, 2] for _, dF in pairs], axis=2),
    )


def slopes(
    disc: Discretisation, geometry: Geometry, modes: Spectrum, keep: int, F: Array, dF: Array
) -> tuple[Array, Array]:
    """Derivatives to θ of the k = `keep` lowest modes and of their displacements Fᵀφ.

    With M-orthonormal modes, and (K - λ_i M)⁺ the inverse on the M-complement of the modes at λ_i,

        λ_i' = φ_iᵀ(K' - λ_i M')φ_i,
        φ_i' = -½ φ_i φ_iᵀM'φ_i - (K - λ_i M)⁺ (K' - λ_i M') φ_i.

    One solution serves all parameters if the resolvent is applied to F instead (adjoint method):

        (Fᵀφ_i)' = F'ᵀφ_i - ½ (Fᵀφ_i) φ_iᵀM'φ_i - Z_iᵀ(K' - λ_i M')φ_i,   Z_i = (K - λ_i M)⁺F.

    The vectors of a multiple eigenvalue are not unique, so modes i, j of a cluster are
    differentiated as a block in fixed modal coordinates: M stays I, and K has the slopes
    φ_iᵀ(K' - ½(λ_i + λ_j)M')φ_j off its diagonal too.

    Parameters
    ----------
    F, dF : array (n, r), (θ, n, r)

    Returns
    -------
    dK : array (θ, k, k)
        Of the modal stiffness diag(λ), rad²/s² per unit of θ.
    dU : array (θ, r, k)
        Of Fᵀφ.
    """
    lam, V = modes.values, modes.vectors
    rigid, phi = modes.rigid, V[:, :keep]
    Q, R = compress(F)
    resolvent = build_resolvent(modes.pencil, np.hstack([rigid, V]), Q, lam[keep - 1])
    cluster = np.abs(lam[:keep, None] - lam[None, :]) <= StageModeOptions.cluster * lam[None, :]
    Z = []
    for i in range(keep):
        # what the resolvent leaves out, Σ φ_j φ_jᵀQ/(λ_j - λ_i), where a rigid λ_j is 0
        gap = np.where(cluster[i], np.inf, lam - lam[i])
        ZQ = resolvent(lam[i]) + V @ ((V.T @ Q) / gap[:, None]) - rigid @ (rigid.T @ Q) / lam[i]
        Z.append(ZQ @ R)
    dK, dM = _slope_forms(disc, geometry, modes, np.hstack([phi, *Z]), phi)
    modal_dK, modal_dM = dK[:, :keep], dM[:, :keep]
    mean = 0.5 * (lam[:keep, None] + lam[None, :keep])
    pair = cluster[:, :keep]  # i = j among them
    dU = np.einsum("tnr,nk->trk", dF, phi)
    dU -= 0.5 * np.einsum("jr,tji->tri", phi.T @ F, np.where(pair, modal_dM, 0.0))
    r = F.shape[1]
    for i in range(keep):
        rows = slice(keep + i * r, keep + (i + 1) * r)  # those of Z_i
        dU[:, :, i] -= dK[:, rows, i] - lam[i] * dM[:, rows, i]
    return np.where(pair, modal_dK - mean * modal_dM, 0.0), dU


def compress(F: Array) -> tuple[Array, Array]:
    """F (n, r) = Q R by a rank-revealing QR, Q (n, rank): u_z of one mode at the four corners
    differs by signs only, so one right-hand side is solved for instead of four."""
    Q, pivoted, pivot = qr(F, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(pivoted))
    rank = int((diagonal > 1e-12 * max(diagonal.max(initial=0.0), 1e-300)).sum())
    R = np.zeros_like(pivoted[:rank])
    R[:, pivot] = pivoted[:rank]
    return Q[:, :rank], R


def _slope_forms(
    disc: Discretisation, geometry: Geometry, modes: Spectrum, left: Array, right: Array
) -> tuple[Array, Array]:
    """leftᵀ ∂K right and leftᵀ ∂M right (θ, a, b) of left (n, a), right (n, b).

    Point masses add G diag(m) Gᵀ to M, which moves with their functionals G.
    """
    theta, group = modes.theta, modes.group
    dK = np.zeros((len(theta), left.shape[1], right.shape[1]))
    dM = np.zeros_like(dK)
    start = 0
    for symmetry in group.solved:
        sector = sector_of(disc, symmetry)
        rows = slice(start, start + sector.fold.size)
        part_K, part_M = disc.assembler.slopes(sector, theta, left[rows], right[rows])
        dK, dM, start = dK + part_K, dM + part_M, rows.stop
    G, m, dG = _point_masses(disc, group, theta, geometry.point_masses)
    for t in range(len(theta)):
        if m.size and np.any(dG[t]):
            change = (left.T @ dG[t]) @ (m[:, None] * (G.T @ right))
            change += (left.T @ G) @ (m[:, None] * (dG[t].T @ right))
            dM[t] += change
    return dK, dM


def _point_masses(
    disc: Discretisation, group: Group, theta: Array, masses: Sequence[PointMass]
) -> tuple[Array, Array, Array]:
    """G (n, 3 masses) of their displacements, m (3 masses,) in kg, and ∂G (θ, n, 3 masses)."""
    n = sum(sector_of(disc, s).fold.size for s in group.solved)
    if not masses:
        return np.zeros((n, 0)), np.zeros(0), np.zeros((len(theta), n, 0))
    G, dG = functionals(disc, group.images[0], theta, [(p.x, p.y) for p in masses])
    m = np.tile([p.mass for p in masses], 3)  # the same in each direction
    return G.reshape(n, -1), m, dG.reshape(len(theta), n, -1)


def rigid_vectors(disc: Discretisation, group: Group, theta: Array) -> Array:
    """The rigid-body motions q of a group, (n, at most 6), not orthonormal.

    Each belongs to one symmetry: u_z lifts in A1; the turn about z is in A2; a shift and a turn are
    in SA (along y and about x) and in AS (along x and about y).
    """
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
            T = sector_of(disc, symmetry).fold.matrix
            quarter = field[swap_displacements(mesh)] if symmetry is AS else field
            parts.append(float(symmetry.name == name) * (T.T @ quarter))
        columns.append(np.concatenate(parts))
    nonzero = [c for c in columns if np.any(c)]
    n = sum(sector_of(disc, s).fold.size for s in group.solved)
    return np.hstack(nonzero) if nonzero else np.zeros((n, 0))


def sign_functional(disc: Discretisation, group: Group, theta: Array) -> Array:
    """s (n,): a mode has the sign for which sᵀφ > 0. It is u_z at an antinode of each symmetry.

    It is smooth in θ, so signs do not change along a path of designs. Of coupled symmetries it is
    the sum. SA and AS have unequal weights in it: a pair along the diagonals is (SA ± AS)/√2, and
    with equal weights sᵀφ of one of the two would be 0.
    """
    a = 0.5 * disc.side
    parts = []
    for symmetry in group.solved:
        # a corner, but on the edge where the symmetry has a node line through the corner
        point = {"B1": (a, 0.0), "A2": (a, 0.5 * a)}.get(symmetry.name, (a, a))
        weight = 0.6 if symmetry is AS else 1.0
        parts.append(weight * functionals(disc, (symmetry,), theta, [point])[0][:, 2, 0])
    return np.concatenate(parts)
