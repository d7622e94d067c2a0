"""Lagrange elements on the unit cube: one-dimensional integrals and their tensor products.

A box with edges l_x, l_y, l_z has K_e = Σ_{p<=q} l_x l_y l_z/(l_p l_q) K_pq and
M_e = l_x l_y l_z M_1, with matrices of the unit cube that know nothing of θ.
"""

from functools import cache

import numpy as np
from numpy.polynomial import legendre

from ccd_casadi.case_studies.rib_stage.geometry import Material
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
