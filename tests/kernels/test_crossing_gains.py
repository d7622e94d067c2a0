"""The judge finds a maximum of σ_max that a lesser singular value makes between two grid points."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ccd_casadi.fixed_structure.certificate_curves import HALF_POWER, peaks, with_crossings

ABOVE = 5e-4  # of 2: how far the short one passes above the broad one


@dataclass
class Crossing:
    """Two gains of a matrix, times `scale` of ω: a nearly constant one, and a resonance that passes
    above it over a short range, from -`half` to `half` around `peak_at`. KS is weighted by 1/scale.
    """

    peak_at: float
    half: float
    name: str = "S"
    scale: Callable[[np.ndarray], np.ndarray] = np.ones_like
    integrator: bool = True

    def weights(self, omega: np.ndarray) -> dict[str, Any]:
        return {"KS": 1.0 / self.scale(omega)} if self.name == "KS" else {}

    def with_lesser(self, which: np.ndarray, omega: np.ndarray) -> tuple[Any, Any]:
        away = omega - self.peak_at
        broad = 2.0 - ABOVE - 1e-5 * away / self.peak_at
        both = np.stack([broad, 2.0 - ABOVE * (away / self.half) ** 2], axis=-1)
        both = np.sort(both * self.scale(omega)[..., None], axis=-1)
        found = {self.name: both[..., -1]}
        found |= {f"weighted {k}": W * both[..., -1] for k, W in self.weights(omega).items()}
        return found, {self.name: both}

    def at(self, which: np.ndarray, omega: np.ndarray) -> dict[str, Any]:
        return self.with_lesser(which, omega)[0]


def between_points(seed: int) -> tuple[np.ndarray, float, float]:
    """A grid, and a place between two of its points with a tenth of their distance."""
    rng = np.random.default_rng(seed)
    grid = np.geomspace(1.0, 100.0, 120)[None]
    low, high = grid[0, rng.integers(40, 80) + np.array([0, 1])]
    return grid, low + rng.uniform(0.3, 0.7) * (high - low), 0.1 * (high - low)


@pytest.mark.parametrize("seed", range(20))
def test_a_short_range_of_the_other_singular_value_is_not_missed(seed: int) -> None:
    grid, at, half = between_points(seed)
    table: Any = Crossing(at, half)
    values = table.at(np.array([0]), grid)
    assert peaks(table, grid, values)["S"][0][0] < 2.0 - 0.5 * ABOVE
    finer, values = with_crossings(table, grid)
    assert (np.diff(finer) > 0.0).all()
    assert (values["S"] == table.at(np.array([0]), finer)["S"]).all()
    found, where = peaks(table, finer, values)["S"]
    assert found[0] == pytest.approx(2.0, rel=1e-9)
    assert where[0] == pytest.approx(at, rel=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_so_is_what_counts_only_weighted_as_room_or_as_the_first_crossing(seed: int) -> None:
    """Each far below the largest value of its curve: where it may not count, the grid stays."""
    grid, at, half = between_points(seed)
    most = 2.0 - 0.1 * ABOVE

    def low(omega: np.ndarray) -> np.ndarray:
        return np.where(omega < 40.0, 1.0, 10.0) * HALF_POWER / (2.0 - 0.5 * ABOVE)

    for name, scale in (("KS", lambda x: 1.0 / x), ("S", lambda x: x), ("S", low)):
        table: Any = Crossing(at, half, name, scale)
        finer, values = with_crossings(table, grid)
        near = np.abs(finer - at) < half
        assert (values[name] / scale(finer))[near].max() > most
    table = Crossing(at, half, "T", low)
    assert with_crossings(table, grid)[0].shape == grid.shape
