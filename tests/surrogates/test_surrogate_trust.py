"""Bands that cover what they say, and points where the samples do not support a surrogate."""

import numpy as np
import pytest

from surrogates import design, extrapolation, fit
from surrogates.quality import hull_distance

BOX = {"lower": [-2.0, 0.0], "upper": [2.0, 3.0]}


def smooth(X: np.ndarray) -> np.ndarray:
    return 3.0 + np.sin(X[:, 0]) * np.cos(0.7 * X[:, 1]) + 0.3 * X[:, 0]


X = design("sobol", **BOX, n=64, seed=3)


def test_bands_cover_what_they_say() -> None:
    # Unseen points of functions the prior is right about: 95 % to statistics.
    unseen = design("lhs", **BOX, n=1000, seed=8)
    s = fit(X, smooth(X) + 0.3 * np.sin(5 * X[:, 0] + X[:, 1]), **BOX)
    mean, std = s.predict(unseen, return_std=True)
    truth = smooth(unseen) + 0.3 * np.sin(5 * unseen[:, 0] + unseen[:, 1])
    assert np.mean(np.abs(truth - mean) <= 1.96 * std) > 0.85


def test_extrapolation_is_flagged_with_its_reason() -> None:
    inner = X[(np.abs(X[:, 0]) < 1.0) & (X[:, 1] < 2.0)]
    s = fit(inner, smooth(inner), **BOX)
    assert not extrapolation(s, inner, [0.1, 1.1]).reasons
    out = extrapolation(s, inner, [1.9, 2.9])
    assert out.reasons
    assert out.deviation is not None
    assert "outside the hull" in " ".join(out.reasons)
    assert "deviation is" in " ".join(out.reasons)
    assert "input 0, 1 is outside" in extrapolation(s, inner, [2.5, -1.0]).reasons[0]
    # A hole in the middle is no matter of the hull.
    ring = X[np.hypot(X[:, 0] / 2, X[:, 1] / 1.5 - 1) > 0.8]
    hole = extrapolation(fit(ring, smooth(ring), **BOX), ring, [0.0, 1.5])
    assert hole.hull < 1e-6
    assert "nearest sample" in hole.reasons[0]


@pytest.mark.parametrize("d", [2, 6])
def test_points_between_the_samples_are_not_flagged(d: int) -> None:
    low, high = np.zeros(d), np.ones(d)
    P = design("sobol", low, high, 64, seed=0)
    s = fit(P, np.sin(P.sum(1)), lower=low, upper=high, starts=1)
    unseen = design("lhs", low, high, 40, seed=1)
    flagged = [bool(extrapolation(s, P, x).reasons) for x in unseen]
    assert np.mean(flagged) < 0.1


def test_distance_to_the_hull() -> None:
    rng = np.random.default_rng(0)
    P = rng.random((50, 3))
    w = rng.dirichlet(np.ones(50))
    assert hull_distance(P, P.T @ w) < 1e-9
    corner = np.vstack([np.zeros(3), np.eye(3)])
    assert hull_distance(corner, np.ones(3)) == pytest.approx(2 / np.sqrt(3), rel=1e-5)
