"""Blocks of real matrices: written out once, what each array expression would compile anew."""

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined


@compiled
def place(M, row, column, factor, block):
    """M[row:, column:] ← factor · block, as far as the block goes."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + i, column + j] = factor * block[i, j]


@compiled
def place_transposed(M, row, column, factor, block):
    """M[row:, column:] ← factor · blockᵀ."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + j, column + i] = factor * block[i, j]


@compiled
def add(M, row, column, factor, block):
    """M[row:, column:] ← itself + factor · block."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            M[row + i, column + j] += factor * block[i, j]


@compiled
def transposed(M):
    """A copy of Mᵀ."""
    out = np.empty((M.shape[1], M.shape[0]))
    place_transposed(out, 0, 0, 1.0, M)
    return out


@inlined
def scaled(factor, M):
    """factor · M."""
    out = np.empty(M.shape)
    place(out, 0, 0, factor, M)
    return out


@compiled
def symmetric_part(M, factor):
    """factor · (M + Mᵀ)."""
    n = M.shape[0]
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = factor * (M[i, j] + M[j, i])
    return out


@compiled
def frobenius(M):
    """‖M‖, the root of the sum of squares."""
    total = 0.0
    for i in range(M.shape[0]):
        for j in range(M.shape[1]):
            total += M[i, j] ** 2
    return np.sqrt(total)
