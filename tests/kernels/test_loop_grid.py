"""The grid runs through every root and its flanks; the kernels find what a plain search finds."""

import numpy as np
import pytest

from ccd_casadi.kernels.loop_grid import find_unseen, maxima, merge
from ccd_casadi.lti.frequency_grid import RootOptions, root_flanks

APART = 1e-8


def roots(rng: np.random.Generator, *shape: int) -> np.ndarray:
    found = -(10.0 ** rng.uniform(-3.0, 2.0, shape)) * np.exp(1j * rng.uniform(-1.5, 1.5, shape))
    return np.asarray(np.concatenate([found, found.conj()], axis=-1))


@pytest.mark.parametrize("seed", range(20))
def test_a_grid_goes_through_every_root(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = np.geomspace(1e-2, 1e2, 40)
    plants, own, poles = roots(rng, 3, 2), roots(rng, 3), roots(rng, 3, 4)
    fixed = np.concatenate(
        [np.tile(base, (3, 1)), root_flanks(plants), np.abs(plants)], axis=1
    )  # fmt: skip
    v, place = merge(fixed, own, poles, np.array(RootOptions.flanks), (1e-2, 1e2), APART, 1e3)
    assert (np.diff(v, axis=1) > 0.0).all()
    assert (v[:, 0] < 1e-2).all()
    for i in range(3):
        sought = [fixed[i], root_flanks(own), np.abs(own), root_flanks(poles[i]), np.abs(poles[i])]
        inside = np.concatenate(sought)
        inside = inside[inside >= 1e-2]
        nearest = np.abs(v[i][:, None] / inside - 1.0).min(axis=0)
        assert nearest.max() < len(inside) * APART
        assert v[i, -1] == pytest.approx(1e3 * max(100.0, *np.abs(own), *np.abs(poles[i])))
        known = place[i] >= 0
        np.testing.assert_array_equal(v[i, known], fixed[i, place[i, known]])
        rest = v[i, ~known & (v[i] >= 1e-2)][:-1]
        assert np.abs(rest[:, None] / np.concatenate(sought[1:]) - 1.0).min(axis=1).max() < 1e-15
        np.testing.assert_array_equal(np.isin(base, v[i, known]), np.isin(base, v[i]))


@pytest.mark.parametrize("seed", range(10))
def test_maxima_are_those_of_a_plain_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    value, v = rng.normal(size=(3, 50, 2, 2)), np.sort(rng.uniform(1.0, 9.0, (3, 50)))
    value[rng.random(value.shape) < 0.1] = -np.inf
    end = np.array([[7.0, np.inf], [np.inf, 3.0]])
    found, beside = maxima(value, v, end, -0.5)
    expected = []
    for i, c, k in np.ndindex(3, 2, 2):
        y = np.concatenate([[-np.inf], value[i, :, c, k], [-np.inf]])
        for j in np.flatnonzero((y[1:-1] >= y[:-2]) & (y[1:-1] > y[2:]) & (y[1:-1] > -0.5)):
            high = min(v[i, min(j + 1, 49)], end[c, k])
            expected.append((i, int(j), c, k, v[i, max(j - 1, 0)], high))
    assert sorted(expected) == [(*map(int, at), *ends)
                                for at, ends in zip(found, beside, strict=True)]  # fmt: skip


@pytest.mark.parametrize("seed", range(10))
def test_a_flat_maximum_between_points_is_sought_and_one_that_shows_is_not(seed: int) -> None:
    x = np.linspace(-1.0, 1.0, 9) + np.random.default_rng(seed).uniform(0.0, 0.2)
    value, v = (-((x**2 - 0.02) ** 2))[None, :, None, None], np.exp(x)[None]
    _, ends = find_unseen(value, v, -1e-2)
    shown = maxima(value, v, np.full((1, 1), np.inf), -1e-2)[1]
    for top in np.exp(np.sqrt(0.02) * np.array([-1.0, 1.0])):
        covered = [(low < top) & (top < high) for low, high in (ends.T, shown.T)]
        assert np.concatenate(covered).any()
    assert find_unseen(value - 1.0, v, -1e-2)[0].shape == (0, 3)
    smooth = (-(x**2))[None, :, None, None]
    assert find_unseen(smooth, v, -10.0)[0].shape == (0, 3)
