"""The judge finds a maximum of σ_max that a lesser singular value makes between two grid points."""

from typing import Any

import numpy as np
import pytest

from ccd_casadi.fixed_structure.certificate_curves import peaks, with_crossings

ABOVE = 5e-4  # of 2: how far the short one passes above the broad one


class Crossing:
    """Two gains: a nearly constant one, and a resonance that passes above it over a short range."""

    def __init__(self, at: float, half: float) -> None:
        self.peak_at, self.half = at, half  # half of the range

    def singular(self, which: np.ndarray, omega: np.ndarray) -> np.ndarray:
        away = omega - self.peak_at
        broad = 2.0 - ABOVE - 1e-5 * away / self.peak_at
        both = np.stack([broad, 2.0 - ABOVE * (away / self.half) ** 2], axis=-1)
        return np.sort(both, axis=-1)[None, ..., ::-1]

    def at(self, which: np.ndarray, omega: np.ndarray) -> dict[str, Any]:
        return {"S": self.singular(which, omega)[0, ..., 0]}


@pytest.mark.parametrize("seed", range(20))
def test_a_short_range_of_the_other_singular_value_is_not_missed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid, rows = np.geomspace(1.0, 100.0, 120)[None], np.array([0])
    low, high = grid[0, rng.integers(40, 80) + np.array([0, 1])]
    at = low + rng.uniform(0.3, 0.7) * (high - low)  # and a fifth of the step between two points
    table: Any = Crossing(at, 0.1 * (high - low))
    assert peaks(table, grid, table.at(rows, grid))["S"][0][0] < 2.0 - 0.5 * ABOVE
    finer = with_crossings(table, grid)
    found, where = peaks(table, finer, table.at(rows, finer))["S"]
    assert found[0] == pytest.approx(2.0, rel=1e-9)
    assert where[0] == pytest.approx(at, rel=1e-4)
