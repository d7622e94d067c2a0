"""The peaks of S that the judge found on its grids, confirmed by Hamiltonian matrices.

A level γ above σ_max(D) is reached where the Hamiltonian matrix of `lti.norms` has an imaginary
eigenvalue; between two neighbours of these σ_max stays on one side of γ. Where it stays below γ at
all of them, just above the peak on the grid, that peak is the norm.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure.certificate_responses import Responses
from ccd_casadi.lti.norms import hinf_norm, level_frequencies
from ccd_casadi.lti.state_space import StateSpace, balanced
from ccd_casadi.support.arrays import Array

CONFIRMED = 1e-6  # relative: between the peak of S on the grid and by the Hamiltonian
ABOVE = 1e-9  # relative: the level that is tested, over the peak on the grid


def norms(
    loops: Sequence[StateSpace],
    table: Responses,
    peak: Array,
    at: Array,
    row: Sequence[float] | None = None,
) -> tuple[Array, np.ndarray]:
    """‖S‖∞ (P,) of every plant's loop, or of a row of it, and whether `peak` (P,) at ω (P,) is it.

    `loops` are S, of sampled loops in z; one whose peak the test does not show to be the largest
    has its norm searched.
    """
    found, confirmed = peak.copy(), np.ones(len(peak), bool)
    for i, loop in enumerate(loops):
        continuous = _over_w(loop, table.period)
        level = peak[i] * (1.0 + ABOVE)
        if not _highest(continuous, table, i, level, row):
            found[i] = max(peak[i], hinf_norm(continuous)[0])
            confirmed[i] = abs(found[i] / peak[i] - 1.0) <= CONFIRMED
    return found, confirmed


def _highest(
    loop: StateSpace, table: Responses, plant: int, level: float, row: Sequence[float] | None
) -> bool:
    """Whether no frequency has more than `level`."""
    if level <= np.linalg.norm(loop.D, 2) * (1.0 + CONFIRMED):
        return False
    edges = level_frequencies(loop, level)
    edges = edges[edges > 0.0]
    if not len(edges):
        return True
    between = np.sqrt(edges[:-1] * edges[1:])
    w = np.concatenate([[0.5 * edges[0], 2.0 * edges[-1]], between, edges])
    omega = w if table.period is None else 2.0 / table.period * np.arctan(w)
    return bool((table.sensitivity(np.array([plant]), omega[None], row) <= level).all())


def _over_w(S: StateSpace, period: float | None) -> StateSpace:
    """S balanced; of a sampled loop over w, z = (1 + w)/(1 - w)."""
    if period is None:
        return StateSpace(*balanced(S.A, S.B, S.C), S.D)
    inverse = np.linalg.inv(S.A + np.eye(len(S.A)))
    root = np.sqrt(2.0)
    A = inverse @ (S.A - np.eye(len(S.A)))
    parts = balanced(A, root * inverse @ S.B, root * S.C @ inverse)
    return StateSpace(*parts, S.D - S.C @ inverse @ S.B)
