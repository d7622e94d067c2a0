"""K and M of an elastic body by scikit-fem, its lowest modes, and how they move with θ.

A displacement field of N nodes is (3N,): x of all nodes, then y, then z.
"""

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
from ccd_casadi.support.text import HZ

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
        """The finite-element bases of K and of M: the order of quadrature is that of what they
        integrate, products of two gradients of second-order functions, or of two functions."""
        fem = require("skfem", "cad")
        return tuple(fem.Basis(self._mesh, fem.ElementTetP2(), intorder=n) for n in (2, 4))

    @property
    def places(self) -> Array:
        """(N, 3) where the N second-order nodes are."""
        return self.carry(self.points)

    def carry(self, values: Array) -> Array:
        """(N, 3) at all nodes, corners and middles of edges, of values linear on the elements,
        (n, 3) at their corners."""
        return np.vstack([values, values[self._mesh.edges].mean(axis=0)])

    def matrices(self) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
        """K (3N, 3N) in N/m and M (3N, 3N) in kg."""
        return self._assemble(lambda u, v, w: u.grad[w.i] * v.grad[w.j], lambda u, v, w: u * v)

    def slopes(self, velocity: Array) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
        """K' and M' where the points move with `velocity` (n, 3), V.

        Functions move with the mesh, so that on a moving domain (∂_i u)' = -∂_i V_k ∂_k u and
        (dx)' = div V dx (shape derivatives; Haslinger and Mäkinen, 2003):

            (∫ ∂_i u ∂_j v)' = ∫ div V ∂_i u ∂_j v - ∂_i V_k ∂_k u ∂_j v - ∂_i u ∂_j V_k ∂_k v
            (∫ u v)' = ∫ div V u v
        """

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

        `triangles` (f, 3) are the element faces that it is made of. The weights are ∫ v / area; on
        a surface with the normal n (dS)' = (div V - n_k ∂_i V_k n_i) dS.
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

        integral = value.assemble(basis)
        area = integral.sum()  # the functions add to 1
        slopes = np.array(
            [stretch.assemble(basis, velocity=self._field(basis, v)) for v in velocities]
        ).reshape(-1, len(integral))
        return integral / area, slopes / area - slopes.sum(axis=1)[:, None] * integral / area**2

    def _facets(self, triangles: np.ndarray) -> np.ndarray:
        """The mesh's numbers of the faces with these corners."""
        known = np.sort(self._mesh.facets, axis=0).T.tolist()
        numbers = {tuple(corners): k for k, corners in enumerate(known)}
        return np.array([numbers[tuple(row)] for row in np.sort(triangles, axis=1).tolist()])

    def _field(self, basis: Any, velocity: Array) -> Any:
        """A `velocity` (n, 3) of the points, linear on the elements, where `basis` integrates."""
        fem = require("skfem", "cad")
        linear = basis.with_element(fem.ElementVector(fem.ElementTetP1()))
        return linear.interpolate(velocity.ravel())

    def _assemble(
        self, product: Any, inertia: Any, velocity: Array | None = None
    ) -> tuple[sparse.csc_matrix, ...]:
        """Assemble K and M of ∫ λ div u div v + 2 μ ε(u):ε(v), λ and μ Lamé's, and ∫ ρ u·v.

        With P_ij = ∫ ∂_i u ∂_j v, rows of v and columns of u, the block of v_j and u_i is
        λ P_ij + μ (P_ji + δ_ij Σ_k P_kk), and P_ji = P_ijᵀ: six of nine are integrated.
        """
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
        blocks = [[first * P[i, j] + shear * P[j, i] for i in AXES] for j in AXES]
        trace = shear * sum(P[k, k] for k in AXES)
        for i in AXES:
            blocks[i][i] = blocks[i][i] + trace
        of_one_axis = self.material.density * fem.BilinearForm(inertia).assemble(inert, **of_inert)
        mass = sparse.block_diag([of_one_axis] * 3, format="csc")
        return sparse.bmat(blocks, format="csc"), mass


# corners of a tetrahedron's four faces, counter-clockwise from outside
OUTWARD = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))


@dataclass(frozen=True)
class Reduced:
    """M, K (n, n) and F (n, r) of 6 rigid-body motions (none of a held body) and k modes.

    `dM`, `dK` (p, n, n) and `dF` (p, n, r) are their slopes to θ. Rigid motions are along the axes
    and about them through the centre of gravity; modes have unit modal mass.
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

    `held` (3N,) marks unknowns that are zero; a body with none floats. The slopes are those of
    Φᵀ K Φ, Φᵀ M Φ and Φᵀ F in a basis Φ whose own slopes Φ' have no part within the kept subspace:
    with modes φ_m of all other λ_m

        Φᵀ K' Φ,   Φᵀ M' Φ,   φ_iᵀ F' - φ_iᵀ (K' - λ_i M') Z_i,
        Z_i = Σ_m φ_m φ_mᵀ F / (λ_m - λ_i).

    So modes of equal λ need no other treatment. The sum goes over rigid motions, λ_m = 0, over
    modes that are solved but not kept, and over all others, which is a resolvent. Rigid motions R
    stay as they are defined, about a centre that moves: their slopes R' are those of the arms.
    """
    free = np.flatnonzero(~held)
    F, dF = F[free], dF[:, free]
    solved = _solve(body, count, held)
    M, R, rigid, values, vectors = (
        solved.M,
        solved.motions,
        solved.rigid,
        solved.values,
        solved.vectors,
    )
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
    resolvent = build_resolvent(solved.pencil, np.hstack([rigid, vectors]), F, lam[-1])
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
            steps = body.carry(velocity)
            dR = np.zeros_like(R)
            dR[:, 3:] = _rotations(steps - _centre_slope(M, dM, body.places, steps))
            moved = dR.T @ (M @ R)
            out.dM[t, :first, :first] = moved + moved.T + R.T @ (dM @ R)
            out.dF[t, :first] = R.T @ dF[t] + dR.T @ F
    return out


def mode_shapes(body: Body, count: int, held: np.ndarray) -> ModeShapes:
    """The `count` lowest flexible modes on the body's surface; `held` as in `reduce_body`."""
    solved = _solve(body, count, held)
    used, faces = surface(body.tets)
    modes = []
    for i in range(count):
        field = np.zeros(len(held))
        field[~held] = solved.vectors[:, i]
        moved = field.reshape(3, -1).T[used]  # the corners of the elements come first
        modes.append(ModeShape(moved, float(np.sqrt(solved.values[i])) / HZ, (i + 1,)))
    return ModeShapes(body.points[used], faces, tuple(modes))


def surface(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) of the points on the surface, and its faces (q, 4) of places among these."""
    faces = np.concatenate([tets[:, list(corners)] for corners in OUTWARD])
    used, outer = np.unique(outer_faces(faces), return_inverse=True)
    return used, outer.reshape(-1, 3)[:, [0, 1, 2, 2]]


@dataclass(frozen=True)
class SolvedBody:
    """The eigenproblem of an elastic body over the f unknowns that are free, and its solution.

    Attributes
    ----------
    pencil, M : Pencil, sparse (f, f)
    motions, rigid : array (f, 6)
        Rigid motions as they are defined, and M-orthonormal; (f, 0) of a held body.
    values, vectors : array (k,), (f, k)
        λ in rad²/s² and M-orthonormal modes, the lowest first.
    """

    pencil: Pencil
    M: sparse.csc_matrix
    motions: Array
    rigid: Array
    values: Array
    vectors: Array


def _solve(
    body: Body, count: int, held: np.ndarray, *, extra: int = 2, shift: float = 1e-3
) -> SolvedBody:
    """The `count` lowest flexible modes and `extra` ones.

    With these the resolvent converges the faster. K of a free body is singular: K + shift M is
    factored, with `shift` a share of E/(ρ L²), the square of a longitudinal wave's frequency
    through the body.
    """
    free = np.flatnonzero(~held)
    K, M = (item[free][:, free] for item in body.matrices())
    length = float(np.linalg.norm(np.ptp(body.points, axis=0)))
    shift *= body.material.young / (body.material.density * length**2)
    none = np.zeros((len(free), 0))
    pencil = build_pencil([(K + shift * M).tocsr()], [M.tocsr()], shift, none, np.zeros(0))
    R = none if held.any() else _motions(body.places - _centre(M, body.places))
    rigid = orthonormal(pencil, R)
    return SolvedBody(pencil, M, R, rigid, *flexible_modes(pencil, rigid, count + extra))


def _motions(arms: Array) -> Array:
    """(3N, 6): along x, y, z and about them, with `arms` (N, 3) from the centre of gravity."""
    shifts = np.kron(np.eye(3), np.ones((len(arms), 1)))
    return np.hstack([shifts, _rotations(arms)])


def _rotations(arms: Array) -> Array:
    """(3N, 3): about x, y and z by one radian to first order, axis x arm; linear in the arms."""
    return np.stack([np.cross(axis, arms).T.ravel() for axis in np.eye(3)], axis=1)


def _centre(M: Array, places: Array) -> Array:
    """(3,) of gravity: second-order functions hold x, y and z exactly."""
    weight = _weights(M, places)
    return weight @ places / weight.sum()


def _centre_slope(M: Array, dM: Array, places: Array, steps: Array) -> Array:
    """(3,) of the centre Σ w p / Σ w, where masses w change with dM and places p by `steps`."""
    weight, change = _weights(M, places), _weights(dM, places)
    moment = change @ places + weight @ steps
    return (moment - change.sum() * _centre(M, places)) / weight.sum()


def _weights(M: Array, places: Array) -> Array:
    """(N,) kg of each node, the row sums of the block of x."""
    return np.asarray(M[: len(places), : len(places)].sum(axis=1)).ravel()
