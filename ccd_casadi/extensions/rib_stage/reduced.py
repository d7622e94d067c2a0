"""The stage near θ that are known, by a reduced basis: Rayleigh and Ritz in what the modes span.

A basis V of a symmetry holds its modes φ at some θ, what they move by, (K + σM)⁻¹(∂K - λ ∂M)φ, the
rigid motions at every θ, and what forces at actuators, sensors and point masses bend: what a mode's
move lacks in V counts with what these forces' answer lacks in it. In it

    Vᵀ K(θ) V = Σ c_q(θ) Vᵀ K_q V,   Vᵀ M(θ) V likewise,

are small and exact, so that frequencies and displacements are those of the elements at the known
θ, and elsewhere off by the square of what the basis leaves out. Point masses couple the modes of
the small problems. Derivatives are those of the small problem. Nodes move with θ, their numbers do
not: vectors of different θ may be combined. (Noor and Peters 1980; Rozza, Huynh and Patera 2008.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from weakref import WeakValueDictionary

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag, eigh

from ccd_casadi.extensions.rib_stage.assembly import AS, mirror_signs, swap_displacements
from ccd_casadi.extensions.rib_stage.geometry import (
    LOWER,
    UPPER,
    MeshOrder,
    Point,
    has_square_symmetry,
)
from ccd_casadi.extensions.rib_stage.model import (
    TWENTY,
    RibStage,
    assemble,
    discretisation,
    fade,
    points_of,
    rigid_part,
)
from ccd_casadi.extensions.rib_stage.stage_modes import (
    SQUARE_GROUPS,
    Discretisation,
    Group,
    StageModeOptions,
    compress,
    discretise,
    functionals,
    groups_of,
    rigid_vectors,
    sector_of,
    spectrum,
)
from ccd_casadi.plants.finite_elements import Material
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import side_by_side

RIGID = {"A1": 1, "A2": 1, "SA": 2, "AS": 2}  # rigid motions of a symmetry


@dataclass(frozen=True)
class ReducedBasisOptions:
    """Numbers of the reduced basis."""

    known_slope: float = 1e-4  # share of a mode's derivative that may lie beside the basis
    known_mode: float = 1e-8  # the same of a mode: rounding
    beyond: int = 4  # modes of a symmetry beyond those kept, by which shapes change
    levels: int = 2  # static responses to forces, as levels of a Krylov space
    coupled: int = 24  # lowest modes of each symmetry that point masses couple


Theta = tuple[float, ...]
Terms = tuple[np.ndarray, sparse.csr_matrix]


@dataclass(frozen=True)
class ReducedBasis:
    """The reduced basis of a group: V (n, r); the forms of K and of M to each coefficient, their
    lower triangles row by row (terms, r(r + 1)/2); u on the nodes of the lower face (nodes, 3, r)
    of every image."""

    vectors: Array
    stiff: Array
    mass: Array
    faces: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Bases:
    """The bases of the groups of the square, from these θ."""

    known: tuple[Theta, ...] = ()
    of: tuple[ReducedBasis, ...] = ()


@dataclass(frozen=True)
class Small:
    """Modes of a small problem, lowest first: λ (m,), ∂K and ∂M between them (θ, m, k), k <= m; u
    at points (m, 3, p) with its slopes (θ, m, 3, p)."""

    values: Array
    dK: Array
    dM: Array
    u: Array
    du: Array


# The last ones of a stage, as long as somebody has them: they are large.
_bases = WeakValueDictionary[RibStage, Bases]()


def applies(stage: RibStage) -> bool:
    """Whether the stage keeps so many modes of each symmetry, or its masses couple them all."""
    square = has_square_symmetry(stage.geometry)
    return stage.truncation == "symmetry" and not (square and stage.geometry.point_masses)


def mechanics(stage: RibStage, known: Bases, theta: Sequence[float]) -> Mechanics:
    """`RibStage.mechanics` in bases of what is known, but for the signs of modes."""
    here, masses, points = np.array(theta, float), stage.geometry.point_masses, points_of(stage)
    assembler = discretisation(stage).assembler
    c, dc = assembler.coefficients(here)
    both, lower = np.concatenate([c[None], dc]), assembler.mesh.number[:, :, 0].ravel()
    seen = [*points, *((p.x, p.y) for p in masses)]
    # the corners are one point of the quarter
    weights = {place: np.vstack(assembler.mesh.interpolate(here, *place))[:, lower]
               for place in {(abs(x), abs(y)) for x, y in seen}}  # fmt: skip
    groups = zip(SQUARE_GROUPS, known.of, strict=True)
    small = [_modes(stage, group, basis, both, seen, weights) for group, basis in groups]
    of = {s: one for group, own in zip(SQUARE_GROUPS, small, strict=True)
          for (s,), one in zip(group.images, own, strict=True)}  # fmt: skip
    coupled, row, later = groups_of(stage.geometry), 3, 3 + stage.modes.total
    n = later + stage.fading * len(coupled)
    lam, u, du = np.zeros(n), np.zeros((n, len(points))), np.zeros((len(here), n, len(points)))
    dK = np.zeros((len(here), n, n))
    u[:3], du[:, :3] = rigid_part(stage, here)
    for group in coupled:
        rigid, count = sum(RIGID.get(s.name, 0) for s in group.solved), stage.modes.of(group)
        images = (
            [of[s] for (s,) in group.images]
            if not masses
            else [_couple([of[s] for s in group.solved], [mass.mass for mass in masses])]
        )
        kept = count + stage.fading
        for place, one in enumerate(images):
            # A pair of modes of one frequency stands in turns; those that fade follow all others.
            own = row + place + len(images) * np.arange(count)
            own = np.append(own, later + np.arange(stage.fading))
            lam[own] = one.values[rigid : rigid + kept]
            u[own], du[:, own], dK[:, own[:, None], own] = _slopes(one, rigid, kept, len(points))
            if stage.fading:
                slopes = np.diagonal(_slopes(one, rigid, kept + 1, 0)[2], 0, 1, 2)
                w, dw = fade(one.values[rigid : rigid + kept + 1], slopes, count)
                du[:, own] = w[:, None] * du[:, own] + dw[:, :, None] * u[own]
                u[own] *= w[:, None]
        row, later = row + len(images) * count, later + stage.fading
    return assemble(stage, lam[3:], u, du, dK)


def bases(stage: RibStage, known: tuple[Theta, ...]) -> Bases:
    """Build the bases from what is known at some θ; grown from the stage's last ones where these
    know the first of them."""
    last = _bases.pop(stage, Bases())
    have, made = (last.known, last.of) if last.known == known[: len(last.known)] else ((), ())
    disc = discretisation(stage)
    for theta in map(np.array, known[len(have) :]):
        before = made or [_of_rigid(stage, disc, group, theta) for group in SQUARE_GROUPS]

        def grown(
            index: int, here: Array = theta, before: Sequence[ReducedBasis] = before
        ) -> ReducedBasis:
            return _grow(stage, disc, SQUARE_GROUPS[index], before[index], here)

        # That of the tilts takes longest.
        made = tuple(side_by_side(grown, range(len(SQUARE_GROUPS))[::-1])[::-1])
    found = _bases[stage] = Bases(known, made)
    return found


def _of_rigid(stage: RibStage, disc: Discretisation, group: Group, theta: Array) -> ReducedBasis:
    """Rigid motions at every θ, in which they are affine."""
    step = 0.1 * (np.array(UPPER) - np.array(LOWER))
    motions = [rigid_vectors(disc, group, place) for place in (theta, *(theta + np.diag(step)))]
    of_K, of_M = _terms(stage.order, disc.side, stage.geometry.material)
    empty = np.zeros((len(of_K[0]), 0)), np.zeros((len(of_M[0]), 0))
    nothing = ReducedBasis(np.zeros((len(motions[0]), 0)), *empty, ())
    return _wider(stage, disc, group, nothing, np.hstack(motions), ReducedBasisOptions.known_mode)


def _grow(
    stage: RibStage,
    disc: Discretisation,
    group: Group,
    basis: ReducedBasis,
    theta: Array,
    *,
    options: ReducedBasisOptions = ReducedBasisOptions(),
) -> ReducedBasis:
    """Add the modes at θ, what they move by, and what forces at the points bend."""
    masses = stage.geometry.point_masses
    count = max(TWENTY.of(group), stage.modes.of(group)) + options.beyond
    body, sector = replace(stage.geometry, point_masses=()), sector_of(disc, group.solved[0])
    found = spectrum(disc, body, theta, group, count)
    vectors, inverse = found.vectors, found.pencil.inverse
    acting = [*points_of(stage), *((p.x, p.y) for p in masses)]
    for image in group.images:
        bending = compress(functionals(disc, image, theta, acting)[0].reshape(len(vectors), -1))[0]
        for _ in range(options.levels):
            bending = inverse(bending)
            vectors = np.hstack([vectors, bending])
            bending = found.pencil.mass(bending)
    basis = _wider(stage, disc, group, basis, vectors, options.known_mode)
    moved = disc.assembler.apply_slopes(sector, theta, found.values, found.vectors)
    return _wider(stage, disc, group, basis, inverse(moved), options.known_slope)


def _wider(
    stage: RibStage, disc: Discretisation, group: Group, basis: ReducedBasis, X: Array, known: float
) -> ReducedBasis:
    """Add the columns of X that the basis lacks by more than `known` of their length."""
    V, r = basis.vectors, basis.vectors.shape[1]
    X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    for _ in range(2):
        X = X - V @ (V.T @ X)
    left, size, _ = np.linalg.svd(X, full_matrices=False)
    V = np.hstack([V, left[:, size > known]])
    n, sector = V.shape[1], sector_of(disc, group.solved[0])
    fresh = disc.assembler.bilinear(sector, V, V[:, r:])

    below = np.arange(n) <= np.arange(r, n)[:, None]

    def forms(before: Array, new: Array, of: Terms) -> Array:
        flat = of[1] @ new.reshape(of[1].shape[1], n * (n - r))
        rows = flat.reshape(len(before), n, n - r).transpose(0, 2, 1)
        return np.hstack([before, rows[:, below]])

    of_K, of_M = _terms(stage.order, disc.side, stage.geometry.material)
    mesh = disc.assembler.mesh
    rows = (3 * mesh.number[:, :, 0].reshape(-1, 1) + np.arange(3)).ravel()
    images = [swap_displacements(mesh)[rows] if image == (AS,) else rows for image in group.images]
    faces = tuple((sector.fold.matrix[own] @ V).reshape(len(own) // 3, 3, n) for own in images)
    stiff = forms(basis.stiff, fresh[:, :6], of_K)
    return ReducedBasis(V, stiff, forms(basis.mass, fresh[:, 6:], of_M), faces)


@lru_cache(maxsize=4)
def _terms(order: MeshOrder, side: float, material: Material) -> tuple[Terms, Terms]:
    """Select the coefficients of K, and of M, that are no multiple of one before: where they are,
    and how the forms of all of them add up to theirs."""
    assembler, rng = discretise(order, side, material).assembler, np.random.default_rng(0)
    low, high = np.array(LOWER), np.array(UPPER)
    places = low + rng.uniform(0.1, 0.9, (3, len(low))) * (high - low)
    c = np.array([assembler.coefficients(theta)[0] for theta in places])
    found = []
    for flat in (c[:, :, :6].reshape(3, -1), c[:, :, 6]):
        ratios = np.round(np.log(flat[1:] / flat[0]), 9)
        _, lead, owner = np.unique(ratios, axis=1, return_index=True, return_inverse=True)
        owner = owner.ravel()
        entries = (flat[0] / flat[0, lead[owner]], (owner, np.arange(len(owner))))
        found.append((lead, sparse.csr_matrix(entries, shape=(len(lead), len(owner)))))
    return found[0], found[1]


def _modes(
    stage: RibStage,
    group: Group,
    basis: ReducedBasis,
    c: Array,
    seen: Sequence[Point],
    weights: Mapping[Point, Array],
) -> tuple[Small, ...]:
    """The small problem of a group for every image, of coefficients c and their slopes
    (1 + θ, blocks, 7) and the points to see u at; `weights` of the nodes for each point."""
    disc, masses, count = discretisation(stage), stage.geometry.point_masses, len(c)
    of_K, of_M = _terms(stage.order, disc.side, stage.geometry.material)
    K = _whole(c[:, :, :6].reshape(count, -1)[:, of_K[0]] @ basis.stiff)
    M = _whole(c[:, :, 6][:, of_M[0]] @ basis.mass)
    values, modes = eigh(K[0], M[0])
    kept = RIGID.get(group.solved[0].name, 0) + stage.modes.of(group)
    found = []
    for (symmetry,), face in zip(group.images, basis.faces, strict=True):
        flat, fields = face.reshape(len(face), -1), []
        at_places = {
            place: (N @ flat).reshape(count, 3, -1) @ modes for place, N in weights.items()
        }
        for x, y in seen:
            signs = np.array(mirror_signs(symmetry, x < 0.0, y < 0.0), float)[:, None]
            fields.append((signs * at_places[abs(x), abs(y)]).transpose(0, 2, 1))
        u, lam, left = np.stack(fields, 3), values, modes
        if masses:
            lam, turn = _lowest(values, u[0])
            u, left = np.einsum("tjcp,ji->ticp", u, turn), modes @ turn
        right = left if masses else left[:, :kept]
        dK, dM = (left.T @ (part[1:] @ right) for part in (K, M))
        found.append(Small(lam, dK, dM, u[0], u[1:]))
    return tuple(found)


def _whole(triangles: Array) -> Array:
    """Symmetric matrices (k, r, r) of their lower triangles."""
    r = int(np.sqrt(2 * triangles.shape[1]))
    i, j = np.tril_indices(r)
    out = np.empty((len(triangles), r, r))
    out[:, i, j] = out[:, j, i] = triangles
    return out


def _lowest(
    values: Array, G: Array, *, coupled: int = ReducedBasisOptions.coupled
) -> tuple[Array, Array]:
    """λ (k,) and directions (m, k) of the lowest modes and what forces at points bend of the others
    (m,), G (m, 3, p) being the displacements there."""
    few, shift = min(coupled, len(values)), StageModeOptions.shift
    high = values[few:]
    bending = G[few:].reshape(len(high), G.shape[1] * G.shape[2]) / (high + shift)[:, None]
    Q = compress(np.hstack([bending, bending / (high + shift)[:, None] * shift]))[0]
    own, turn = np.linalg.eigh(Q.T @ (high[:, None] * Q))
    return np.append(values[:few], own), block_diag(np.eye(few), Q @ turn)


def _couple(parts: Sequence[Small], masses: Sequence[float]) -> Small:
    """The direct sum of symmetries with point masses, which stand last among the points:

    M = I + G m Gᵀ, G the displacements there.
    """
    lam = np.concatenate([part.values for part in parts])
    n, count = len(lam), len(parts[0].dK)
    dK, dM, start = np.zeros((count, n, n)), np.zeros((count, n, n)), 0
    for part in parts:
        own = slice(start, start + len(part.values))
        dK[:, own, own], dM[:, own, own], start = part.dK, part.dM, own.stop
    u, du = np.concatenate([p.u for p in parts]), np.concatenate([p.du for p in parts], axis=1)
    G, dG = u[:, :, -len(masses) :], du[:, :, :, -len(masses) :]
    mass = np.eye(n) + np.einsum("acp,bcp,p->ab", G, G, masses)
    moved = np.einsum("tacp,bcp,p->tab", dG, G, masses)
    values, Y = eigh(np.diag(lam), mass)
    dK, dM = (Y.T @ (part @ Y) for part in (dK, dM + moved + moved.transpose(0, 2, 1)))
    return Small(values, dK, dM, np.tensordot(Y.T, u, 1), np.einsum("ij,ticp->tjcp", Y, du))


def _slopes(one: Small, rigid: int, count: int, points: int) -> tuple[Array, Array, Array]:
    """u_z of `count` modes at the points, its slopes and those of K, as in `stage_modes.slopes`:

    φ'_i = -½ φ_i φ_iᵀM'φ_i + Σ_j φ_j φ_jᵀ(K' - λ_i M')φ_i/(λ_i - λ_j).
    """
    kept = slice(rigid, rigid + count)
    lam, (dK, dM) = one.values[kept], (part[:, :, kept] for part in (one.dK, one.dM))
    gap = lam - one.values[:, None]
    close = np.abs(gap) <= StageModeOptions.cluster * np.maximum(lam, one.values[:, None])
    turn = np.where(close, -0.5 * dM, (dK - dM * lam) / np.where(close, 1.0, gap))
    u, du = one.u[:, 2, :points], one.du[:, kept, 2, :points]
    own_K, own_M = dK[:, kept], dM[:, kept]
    mean = 0.5 * (lam[:, None] + lam)
    K = np.where(close[kept], own_K - mean * own_M, 0.0)
    return u[kept], du + np.einsum("tji,jp->tip", turn, u), K
