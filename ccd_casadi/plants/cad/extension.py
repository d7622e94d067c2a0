"""The harmonic extension of values on some nodes of a mesh to all of its nodes."""

import math

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ccd_casadi.support.arrays import Array


def laplacian(points: Array, simplices: np.ndarray) -> sparse.csc_matrix:
    """∫ ∇φ_a·∇φ_b of linear elements on triangles or tetrahedra in space, (n, n).

    `points` (n, 3), `simplices` (e, 3) or (e, 4). With the edges E from a simplex' first corner
    and G = E Eᵀ, gradients in its own plane are G⁻¹ E, so that a triangle needs no coordinates
    of its surface.
    """
    corners, k = points[simplices], simplices.shape[1] - 1
    edges = corners[:, 1:] - corners[:, :1]
    metric = edges @ edges.transpose(0, 2, 1)
    volume = np.sqrt(np.linalg.det(metric)) / math.factorial(k)
    steps = np.vstack([-np.ones(k), np.eye(k)])  # of the corners' own functions along the edges
    local = volume[:, None, None] * (steps @ np.linalg.inv(metric) @ steps.T)
    rows = np.repeat(simplices, k + 1, axis=1).ravel()
    columns = np.tile(simplices, k + 1).ravel()
    size = len(points)
    return sparse.coo_matrix((local.ravel(), (rows, columns)), shape=(size, size)).tocsc()


def extended(points: Array, simplices: np.ndarray, known: np.ndarray, values: Array) -> Array:
    """Values (n, d), those at the nodes `known` as given (k, d), harmonic at the mesh's others.

    Nodes that the mesh does not touch are zero. A linear function of space is its own extension.
    """
    out = np.zeros((len(points), values.shape[1]))
    out[known] = values
    free = np.setdiff1d(simplices, known)
    if free.size:
        L = laplacian(points, simplices)[free]
        out[free] = splu(L[:, free].tocsc()).solve(-(L[:, known] @ values))
    return out
