"""K and M of an elastic body by scikit-fem, its lowest modes, and how they move with θ."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from ccd_casadi.drawing.svg import ModeShape, ModeShapes, outer_faces
from ccd_casadi.plants.finite_elements import (
    Material,
    Pencil,
    build_pencil,
    build_resolvent,
    flexible_modes,
    orthonormal,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import require

AXES = range(3)


@dataclass(frozen=True)
class Body:
    """Tetrahedra (t, 4) on points (n, 3) in m, of one material."""

    points: Array
    tets: np.ndarray
    material: Material

    @cached_property
    def _mesh(self) -> Any:
        fem = require("skfem", "cad")
        return fem.MeshTet(np.ascontiguousarray(self.points.T), np.ascontiguousarray(self.tets.T))

    @cached_property
    def _bases(self) -> tuple[Any, Any]:
        """The finite-element bases of K and of M."""
        fem = require("skfem", "cad")
        element = fem.ElementTetP2()
        exact = (2, 4)  # orders of quadrature
        return tuple(fem.Basis(self._mesh, element, intorder=n) for n in exact)

    @property
    def places(self) -> Array:
        """(N, 3) where the N second-order nodes are."""
        return self.carry(self.points)

    def carry(self, values: Array) -> Array:
        """(N, 3) at all nodes of values linear on the elements, (n, 3) at their corners."""
        return np.vstack([values, values[self._mesh.edges].mean(axis=0)])

    def matrices(self) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
        """K (3N, 3N) in N/m and M (3N, 3N) in kg."""
        return self._assemble(lambda u, v, w: u.grad[w.i] * v.grad[w.j], lambda u, v, w: u * v)

    def slopes(self, velocity: Array) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
        """K' and M' where the points move with `velocity` (n, 3)."""

        def product(u: Any, v: Any, w: Any) -> Any:
            dV = w.velocity.grad  # k, i: ∂_i V_k
            change = (dV[0, 0] + dV[1, 1] + dV[2, 2]) * u.grad[w.i] * v.grad[w.j]
            for k in AXES:
                change -= dV[k, w.i] * u.grad[k] * v.grad[w.j]
                change -= u.grad[w.i] * dV[k, w.j] * v.grad[k]
            return change

        def inertia(u: Any, v: Any, w: Any) -> Any:
            dV = w.velocity.grad
            return (dV[0, 0] + dV[1, 1] + dV[2, 2]) * u * v

        return self._assemble(product, inertia, velocity)

    def on(self, triangles: np.ndarray) -> np.ndarray:
        """(m,) numbers of the nodes on element faces (f, 3)."""
        return np.asarray(self._bases[0].get_dofs(self._facets(triangles)).all())

    def mean(self, triangles: np.ndarray, velocities: Array) -> tuple[Array, Array]:
        """(N,) weights of the mean over a face, and their slopes (p, N) to `velocities` (p, n, 3).

        `triangles` (f, 3) are the element faces that it is made of.
        """
        fem = require("skfem", "cad")
        facets = self._facets(triangles)
        basis = fem.FacetBasis(self._mesh, fem.ElementTetP2(), facets=facets, intorder=2)

        @fem.LinearForm
        def value(v: Any, w: Any) -> Any:
            return v

        @fem.LinearForm
        def stretch(v: Any, w: Any) -> Any:
            dV = w.velocity.grad
            surface = sum(dV[k, k] for k in AXES)
            surface = surface - sum(w.n[k] * dV[k, i] * w.n[i] for k in AXES for i in AXES)
            return surface * v

        whole = value.assemble(basis)
        area = whole.sum()
        moved = np.array(
            [stretch.assemble(basis, velocity=self._field(basis, v)) for v in velocities]
        ).reshape(-1, len(whole))
        return whole / area, moved / area - moved.sum(axis=1)[:, None] * whole / area**2

    def _facets(self, triangles: np.ndarray) -> np.ndarray:
        """The mesh's numbers of the faces with these corners."""
        known = np.sort(self._mesh.facets, axis=0).T.tolist()
        numbers = {tuple(corners): k for k, corners in enumerate(known)}
        return np.array([numbers[tuple(row)] for row in np.sort(triangles, axis=1).tolist()])

    def _field(self, basis: Any, velocity: Array) -> Any:
        fem = require("skfem", "cad")
        linear = basis.with_element(fem.ElementVector(fem.ElementTetP1()))
        return linear.interpolate(velocity.ravel())

    def _assemble(
        self, product: Any, inertia: Any, velocity: Array | None = None
    ) -> tuple[sparse.csc_matrix, ...]:
        """Assemble K and M from P_ij = ∫ ∂_i u ∂_j v: block (j, i) is λ P_ij + μ (P_ij ᵀ + δ_ij Σ_k
        P_kk)."""
        fem = require("skfem", "cad")
        (first, shear), (stiff, inert) = self.material.lame, self._bases
        of_stiff, of_inert = (
            {} if velocity is None else {"velocity": self._field(basis, velocity)}
            for basis in (stiff, inert)
        )
        form = fem.BilinearForm(product)
        half = {(i, j): form.assemble(stiff, i=i, j=j, **of_stiff)
                for i in AXES for j in AXES if i <= j}  # fmt: skip
        P = half | {(j, i): item.T for (i, j), item in half.items()}
        trace = shear * sum(P[k, k] for k in AXES)
        blocks = [
            [first * P[i, j] + shear * P[j, i] + (trace if i == j else 0.0 * trace) for i in AXES]
            for j in AXES
        ]
        lump = self.material.density * fem.BilinearForm(inertia).assemble(inert, **of_inert)
        mass = sparse.block_diag([lump] * 3, format="csc")
        return sparse.bmat(blocks, format="csc"), mass


# corners of a tetrahedron's four faces, counter-clockwise from outside
OUTWARD = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))


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


def reduce_body(
    body: Body, velocities: Array, F: Array, dF: Array, count: int, held: np.ndarray
) -> Reduced:
    """The `count` lowest flexible modes; `velocities` (p, n, 3) of the points, F (3N, r), dF.

    `held` (3N,) marks unknowns that are zero; a body with none floats.
    """
    free = np.flatnonzero(~held)
    F, dF = F[free], dF[:, free]
    pencil, M, R, rigid, values, vectors = _solve(body, count, held)
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
            steps = body.carry(velocity) - _centre_slope(M, dM, body.places, velocity, body)
            dR = _motions(steps, False)
            moved = dR.T @ (M @ R)
            out.dM[t, :first, :first] = moved + moved.T + R.T @ (dM @ R)
            out.dF[t, :first] = R.T @ dF[t] + dR.T @ F
    return out


def mode_shapes(body: Body, count: int, held: np.ndarray) -> ModeShapes:
    """The `count` lowest flexible modes on the body's surface; `held` as in `reduce_body`."""
    values, vectors = _solve(body, count, held)[-2:]
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


def _solve(
    body: Body, count: int, held: np.ndarray, *, extra: int = 2, shift: float = 1e-3
) -> tuple[Pencil, sparse.csc_matrix, Array, Array, Array, Array]:
    """The pencil and M of what is free, rigid motions as they are and orthonormal, λ and modes.

    `extra` modes are solved beyond `count`: the resolvent converges the faster. `shift` is a share
    of E/(ρ L²), the square of a longitudinal wave's frequency through the body.
    """
    free = np.flatnonzero(~held)
    K, M = (item[free][:, free] for item in body.matrices())
    length = float(np.linalg.norm(np.ptp(body.points, axis=0)))
    shift *= body.material.young / (body.material.density * length**2)
    none = np.zeros((len(free), 0))
    pencil = build_pencil([(K + shift * M).tocsr()], [M.tocsr()], shift, none, np.zeros(0))
    R = none if held.any() else _motions(body.places - _centre(M, body.places), True)
    rigid = orthonormal(pencil, R)
    return pencil, M, R, rigid, *flexible_modes(pencil, rigid, count + extra)


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
    moment = change @ places + weight @ body.carry(velocity)
    return (moment - change.sum() * _centre(M, places)) / weight.sum()


def _weights(M: Array, places: Array) -> Array:
    """(N,) kg of each node, from the block of x."""
    return np.asarray(M[: len(places), : len(places)].sum(axis=1)).ravel()
