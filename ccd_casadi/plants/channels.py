"""Channels: an exactly block-diagonal plant as the small plants that it is made of.

The weights are multiples of the identity, so orthogonal changes of inputs and outputs leave the
mixed-sensitivity problem as it is. Where orthogonal U, V make Uᵀ G V block-diagonal (a square
stage: z, tip, tilt, twist), γ_opt is the largest of the blocks', and the central controller at
one common γ is that of every block, put together.

U and V are found from the modes' residues R_i = c_i b_iᵀ: the singular vectors of one random
combination of them, which are those of all of them where they can be diagonalised together.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from ccd_casadi.support.arrays import Array

EXACT = 1e-10  # share of a residue that may lie off the blocks and count as rounding
MIXTURES = 8
CERTAIN = 1e-13  # share of the strongest drive or reading under which a mode has none


@dataclass(frozen=True)
class Channel:
    """One block: its modes, and orthonormal directions of outputs (p, k) and inputs (m, k)."""

    modes: np.ndarray
    outputs: Array
    inputs: Array


def find_channels(K: Array, D: Array, B: Array, C: Array) -> tuple[Channel, ...]:
    """The blocks of q̈ + D q̇ + K q = B u, y = C q; one, the plant itself, where it has no more.

    Modes that are not driven, or not seen, are in no channel. Only square plants are split.
    """
    n, m = B.shape
    p = C.shape[0]
    whole = (Channel(np.arange(n), np.eye(p), np.eye(m)),)
    if p != m or p == 1:
        return whole
    b, c = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    live = (b > CERTAIN * b.max()) & (c > CERTAIN * c.max())
    coupled = _components(np.abs(K) + np.abs(D) > 0.0)
    kept = [group for group in coupled if live[group].any()]
    residues = []
    for group in kept:
        scale = max(float(np.outer(c[group], b[group]).max()), 1e-300)
        residues += [
            np.outer(C[:, i], B[j]) / scale
            for i in group
            for j in group
            if c[i] * b[j] > CERTAIN * scale
        ]
    U, s, Vt = _singular_vectors(np.array(residues))
    if s[-1] <= EXACT * s[0]:
        return whole
    turned = [np.abs(U.T @ residue @ Vt.T) for residue in residues]
    share = np.max([t / max(t.max(), 1e-300) for t in turned], axis=0)
    blocks = _components(np.maximum(share, share.T) > EXACT)
    if len(blocks) < 2:
        return whole
    found = []
    for block in blocks:
        out, into = U[:, block], Vt[block].T
        modes = [g for g in kept if np.linalg.norm(out.T @ C[:, g]) > EXACT * c[g].max()]
        found.append(Channel(np.sort(np.concatenate(modes)), out, into))
    together = np.concatenate([channel.modes for channel in found])
    if len(np.unique(together)) < len(together):  # a group of coupled modes spans two blocks
        return whole
    return tuple(found)


def _singular_vectors(residues: Array) -> tuple[Array, Array, Array]:
    """Those of the mixture, of some, whose singular values lie furthest apart.

    Any mixture will do but for rounding, which grows as two of them meet; the seed is fixed, so
    that the same plant has the same channels.
    """
    rng = np.random.default_rng(0)
    found = [
        np.linalg.svd(np.tensordot(rng.uniform(0.5, 1.5, len(residues)), residues, 1))
        for _ in range(MIXTURES)
    ]
    return max(found, key=lambda parts: -np.diff(parts[1]).max())


def _components(linked: np.ndarray) -> list[np.ndarray]:
    """Connected components of a symmetric relation, each sorted, in order of their first."""
    count, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    return [np.flatnonzero(label == i) for i in range(count)]
