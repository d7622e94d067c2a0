"""The lowest modes of a body at one θ, and how they and what drives and reads them move with θ.

The reduced plant's coordinates are the rigid-body motions about the centre of gravity and the
lowest flexible modes Φ, M-orthonormal. To first order in θ the modes turn within their own span,
which ΦᵀK'Φ and ΦᵀM'Φ say, and leave it by

    φ_i' = -(K - λ_i M)⁺ (K' - λ_i M') φ_i,

the inverse taken beside the modes kept. So no difference of two kept frequencies is divided by,
and modes that cross or are double need no care. It is applied from the side of the forces and
sensors F, whose number is smaller than that of the modes.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ccd_casadi.drawing.pictures import ModeShape, ModeShapes, outer_faces
from ccd_casadi.plants.cad.elements import Body
from ccd_casadi.plants.eigenpairs import (
    Pencil,
    build_pencil,
    build_resolvent,
    flexible_modes,
    orthonormal,
)
from ccd_casadi.support.arrays import Array

EXTRA = 2  # modes solved beyond those kept: the resolvent converges the faster
# corners of a tetrahedron's four faces, counter-clockwise from outside
OUTWARD = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
SHIFT = 1e-3  # of E/(ρ L²), the square of a longitudinal wave's time through the body


@dataclass(frozen=True)
class Reduced:
    """M, K (n, n) and F (n, r) of 6 rigid-body motions (none of a held body) and k modes.

    `dM`, `dK` (p, n, n) and `dF` (p, n, r) are their slopes to θ.
    """

    M: Array
    K: Array
    F: Array
    dM: Array
    dK: Array
    dF: Array


def reduced(
    body: Body, velocities: Array, F: Array, dF: Array, count: int, held: np.ndarray
) -> Reduced:
    """The `count` lowest flexible modes; `velocities` (p, n, 3) of the points, F (3N, r), dF.

    `held` (3N,) marks unknowns that are zero; a body with none floats.
    """
    free = np.flatnonzero(~held)
    F, dF = F[free], dF[:, free]
    pencil, M, R, rigid, values, vectors = _solved(body, count, held)
    lam, kept, more = values[:count], vectors[:, :count], vectors[:, count:]
    first = R.shape[1]
    size, flexible = first + count, slice(first, None)
    out = Reduced(
        np.eye(size), np.zeros((size, size)), np.vstack([R.T @ F, kept.T @ F]),
        *(np.zeros((len(velocities), size, width)) for width in (size, size, F.shape[1])),
    )  # fmt: skip
    out.M[:first, :first] = R.T @ (M @ R)
    out.K[flexible, flexible] = np.diag(lam)
    if not len(velocities):
        return out
    resolvent = build_resolvent(pencil, np.hstack([rigid, vectors]), F, lam[-1])
    beside = [
        resolvent(value)
        + more @ ((more.T @ F) / (values[count:] - value)[:, None])
        - rigid @ (rigid.T @ F) / value
        for value in lam
    ]
    for t, velocity in enumerate(velocities):
        dK, dM = (item[free][:, free] for item in body.slopes(velocity))
        K_kept, M_kept = dK @ kept, dM @ kept
        out.dK[t, flexible, flexible] = kept.T @ K_kept
        out.dM[t, flexible, flexible] = kept.T @ M_kept
        out.dF[t, flexible] = kept.T @ dF[t]
        for i, Z in enumerate(beside):
            out.dF[t, first + i] -= (K_kept[:, i] - lam[i] * M_kept[:, i]) @ Z
        if first:
            steps = body.carried(velocity) - _centre_slope(M, dM, body.places, velocity, body)
            dR = _motions(steps, False)
            moved = dR.T @ (M @ R)
            out.dM[t, :first, :first] = moved + moved.T + R.T @ (dM @ R)
            out.dF[t, :first] = R.T @ dF[t] + dR.T @ F
    return out


def mode_shapes(body: Body, count: int, held: np.ndarray) -> ModeShapes:
    """The `count` lowest flexible modes on the body's surface; `held` as in `reduced`."""
    values, vectors = _solved(body, count, held)[-2:]
    used, faces = surface(body.tets)
    modes = []
    for i in range(count):
        field = np.zeros(len(held))
        field[~held] = vectors[:, i]
        moved = field.reshape(3, -1).T[used]  # the corners of the elements come first
        modes.append(ModeShape(moved, float(np.sqrt(values[i])) / (2.0 * np.pi), (i + 1,)))
    return ModeShapes(body.points[used], faces, tuple(modes))


def surface(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) of the points on the surface, and its faces (q, 4) of places among these."""
    faces = np.concatenate([tets[:, list(corners)] for corners in OUTWARD])
    used, outer = np.unique(outer_faces(faces), return_inverse=True)
    return used, outer.reshape(-1, 3)[:, [0, 1, 2, 2]]


def _solved(
    body: Body, count: int, held: np.ndarray
) -> tuple[Pencil, sparse.csc_matrix, Array, Array, Array, Array]:
    """The pencil and M of what is free, rigid motions as they are and orthonormal, λ and modes."""
    free = np.flatnonzero(~held)
    K, M = (item[free][:, free] for item in body.matrices())
    length = float(np.linalg.norm(np.ptp(body.points, axis=0)))
    shift = SHIFT * body.material.young / (body.material.density * length**2)
    none = np.zeros((len(free), 0))
    pencil = build_pencil([(K + shift * M).tocsr()], [M.tocsr()], shift, none, np.zeros(0))
    R = none if held.any() else _motions(body.places - _centre(M, body.places), True)
    rigid = orthonormal(pencil, R)
    return pencil, M, R, rigid, *flexible_modes(pencil, rigid, count + EXTRA)


def _motions(arms: Array, shifts: bool) -> Array:
    """(3N, 6): along x, y, z and about them, with `arms` (N, 3) from the centre of gravity.

    Without `shifts`, which no arm enters, their slope where `arms` is that of the arms.
    """
    count = len(arms)
    out = np.zeros((3 * count, 6))
    for k, axis in enumerate(np.eye(3)):
        out[k * count : (k + 1) * count, k] = float(shifts)
        out[:, 3 + k] = np.cross(axis, arms).T.ravel()
    return out


def _centre(M: Array, places: Array) -> Array:
    """(3,) of gravity: second-order functions hold x, y and z exactly."""
    weight = _weights(M, places)
    return weight @ places / weight.sum()


def _centre_slope(M: Array, dM: Array, places: Array, velocity: Array, body: Body) -> Array:
    weight, change = _weights(M, places), _weights(dM, places)
    moment = change @ places + weight @ body.carried(velocity)
    return (moment - change.sum() * _centre(M, places)) / weight.sum()


def _weights(M: Array, places: Array) -> Array:
    """(N,) kg of each node, from the block of x."""
    return np.asarray(M[: len(places), : len(places)].sum(axis=1)).ravel()
