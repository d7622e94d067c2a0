"""Plants of a box on which two of its modes have one frequency.

Of modes that forces drive alike and sensors see alike, i and j, what exceeds a bound may lie on a
ridge as narrow as their damping:

    (1 + p_i) ω_i = (1 + p_j) ω_j,   |cos(b_i, b_j) cos(c_i, c_j)| > `ALIKE`

b and c being a mode's row of B and column of C. A lattice of many parameters misses it.
"""

from itertools import combinations

import numpy as np

from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.support.arrays import Array

ALIKE = 0.3
ALONG = (0.02, 0.5, 0.98)  # where they meet, in shares of the frequencies that both may have
SAME = 1e-9  # relative: frequencies of one double mode, which meet without a shift


def meetings(uncertain: UncertainPlant) -> list[tuple[int, Array]]:
    """Points (option, p) where two modes meet, all others as the model's, with the least
    damping."""
    shift, names = uncertain.mode_shift, list(uncertain.names)
    if not shift:
        return []
    first, middle = names.index("mode_shift 1"), uncertain.nominal
    middle[[name == "damping" for name in names]] = uncertain.damping[0]
    found: list[tuple[int, Array]] = []
    for option in range(len(uncertain.options)):
        modal = uncertain.modal(option)
        numbers = modal.numbered
        omega = np.sqrt(np.diag(modal.K)[numbers])
        alike = _cosines(modal.B[numbers]) * _cosines(modal.C[:, numbers].T)
        for i, j in combinations(range(len(omega)), 2):
            own = omega[[i, j]]
            low, high = (1.0 - shift) * own.max(), (1.0 + shift) * own.min()
            if low >= high or alike[i, j] <= ALIKE or np.ptp(own) <= SAME * high:
                continue
            for share in ALONG:
                point = middle.copy()
                point[[first + i, first + j]] = (low + share * (high - low)) / own - 1.0
                found.append((option, point))
    return found


def _cosines(rows: Array) -> Array:
    """|cos| of the angle between every two rows."""
    unit = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    return np.abs(unit @ unit.T)
