"""K and M of an elastic body in second-order tetrahedra by scikit-fem, and their slopes.

Where nodes move with velocity V, gradients and volumes of the element functions move with

    (∂_i φ)' = -Σ_k ∂_i V_k ∂_k φ,    dx' = div V dx,

exactly, as the functions are carried along by the mesh: so are the derivatives of the assembled
matrices, quadrature included. Displacements are second order, edges of elements straight.
Unknowns are all x, then all y, then all z.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import require

STIFF, INERT = 2, 4  # orders of quadrature that are exact for K and for M
AXES = range(3)


@dataclass(frozen=True)
class Material:
    """Isotropic linear elasticity: E in Pa, Poisson's ratio, density in kg/m³; 6061-T6."""

    young: float = 68.9e9
    poisson: float = 0.33
    density: float = 2700.0

    @property
    def lame(self) -> tuple[float, float]:
        """λ and μ in Pa."""
        shear = self.young / (2.0 * (1.0 + self.poisson))
        return 2.0 * shear * self.poisson / (1.0 - 2.0 * self.poisson), shear


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
        """Of K and of M."""
        fem = require("skfem", "cad")
        element = fem.ElementTetP2()
        return tuple(fem.Basis(self._mesh, element, intorder=n) for n in (STIFF, INERT))

    @property
    def places(self) -> Array:
        """(N, 3) where the N second-order nodes are."""
        return self.carried(self.points)

    def carried(self, values: Array) -> Array:
        """(N, 3) at all nodes of values linear on the elements, (n, 3) at their corners."""
        return np.vstack([values, values[self._mesh.edges].mean(axis=0)])

    def matrices(self) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
        """K (3N, 3N) in N/m and M (3N, 3N) in kg."""
        return self._assembled(lambda u, v, w: u.grad[w.i] * v.grad[w.j], lambda u, v, w: u * v)

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

        return self._assembled(product, inertia, velocity)

    def on(self, triangles: np.ndarray) -> np.ndarray:
        """(m,) numbers of the nodes on element faces (f, 3)."""
        return np.asarray(self._bases[0].get_dofs(self._facets(triangles)).all())

    def mean(self, triangles: np.ndarray, velocities: Array) -> tuple[Array, Array]:
        """(N,) weights of the mean over a face, and their slopes (p, N) to `velocities` (p, n, 3).

        `triangles` (f, 3) are the element faces that it is made of.
        """
        fem = require("skfem", "cad")
        facets = self._facets(triangles)
        basis = fem.FacetBasis(self._mesh, fem.ElementTetP2(), facets=facets, intorder=STIFF)

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

    def _assembled(
        self, product: Any, inertia: Any, velocity: Array | None = None
    ) -> tuple[sparse.csc_matrix, ...]:
        """Of P_ij = ∫ ∂_i u ∂_j v: block (j, i) is λ P_ij + μ (P_ij ᵀ + δ_ij Σ_k P_kk)."""
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
