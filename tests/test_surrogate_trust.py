"""Assessment and extrapolation: what a surrogate says about its own worth."""

import numpy as np
import pytest

from surrogates import Roughness, assess, design, extrapolation, fit
from surrogates.extrapolation import hull_distance

BOX = {"lower": [-2.0, 0.0], "upper": [2.0, 3.0]}


def smooth(X: np.ndarray) -> np.ndarray:
    return 3.0 + np.sin(X[:, 0]) * np.cos(0.7 * X[:, 1]) + 0.3 * X[:, 0]


X = design("sobol", **BOX, n=64, seed=3)


@pytest.mark.parametrize("kind", ["gaussian_process", "polynomial", "radial_basis", "network"])
def test_a_smooth_function_is_trusted(kind: str) -> None:
    Y = smooth(X)
    folds = 2 if kind == "network" else 5  # a training each, and five more for its own errors
    found = assess(fit(X, Y, **BOX, kind=kind), X, Y, folds=folds)
    assert found.smooth_enough
    assert found.roughness is Roughness.SMOOTH
    assert found.kfold.q2 > 0.99
    assert found.recommendation.startswith("One smooth surrogate suits the samples")
    assert (found.coverage is not None) == (kind in ("gaussian_process", "polynomial"))
    if found.coverage is not None:
        assert found.coverage >= 0.75
        assert (found.coverage >= 0.9) == ("too narrow" not in found.recommendation)


@pytest.mark.parametrize("kind", ["gaussian_process", "polynomial", "radial_basis"])
def test_a_kink_is_recognised_whatever_was_fitted(kind: str) -> None:
    P = design("sobol", **BOX, n=100, seed=3)
    Y = smooth(P) + 4.0 * np.abs(P @ [1.0, -0.7] + 0.8)
    found = assess(fit(P, Y, **BOX, kind=kind), P, Y, folds=5)
    assert not found.smooth_enough
    assert found.roughness is Roughness.KINKED
    assert "kinks" in found.recommendation
    assert "One smooth surrogate is not enough" in found.recommendation


def test_a_jump_is_recognised_and_located() -> None:
    P = design("sobol", **BOX, n=120, seed=3)
    across = P @ [1.0, -0.7] + 0.8
    Y = smooth(P) + 4.0 * (across > 0)
    found = assess(fit(P, Y, **BOX, noise=0.0), P, Y, folds=5)
    assert found.roughness is Roughness.JUMPS
    assert "jumps" in found.recommendation
    assert abs(found.worst @ [1.0, -0.7] + 0.8) < 0.6
    assert found.worst_share > 0.5
    logs = assess(fit(P, Y, **BOX, transform="log", kind="polynomial"), P, Y, folds=4)
    assert logs.roughness is Roughness.JUMPS


def test_given_noise_is_no_roughness() -> None:
    Y = smooth(X) + 0.1 * np.random.default_rng(0).standard_normal(64)
    found = assess(fit(X, Y, **BOX, noise=0.1), X, Y, noise=0.1, folds=5)
    assert found.smooth_enough
    assert 0.85 <= found.coverage <= 1.0
    assert 0.6 < found.stretch < 1.6


def test_bands_cover_what_they_say() -> None:
    # Unseen points of functions the prior is right about: 95 % to statistics.
    unseen = design("lhs", **BOX, n=1000, seed=8)
    for kind in ("gaussian_process", "polynomial"):
        s = fit(X, smooth(X) + 0.3 * np.sin(5 * X[:, 0] + X[:, 1]), **BOX, kind=kind)
        mean, std = s.predict(unseen, return_std=True)
        truth = smooth(unseen) + 0.3 * np.sin(5 * unseen[:, 0] + unseen[:, 1])
        assert np.mean(np.abs(truth - mean) <= 1.96 * std) > 0.85


def test_few_samples_and_bad_fits_are_said() -> None:
    rough = np.sin(9 * X[:, 0]) * np.cos(8 * X[:, 1])
    found = assess(fit(X, rough, **BOX, kind="polynomial"), X, rough, folds=5)
    assert "take more samples" in found.recommendation or not found.smooth_enough
    constant = assess(fit(X, np.ones(64), **BOX, kind="polynomial"), X, np.ones(64), folds=4)
    assert constant.smooth_enough
    with pytest.raises(TypeError, match="cannot refit"):
        assess(Foreign(), X, rough)


class Foreign:
    """A surrogate of somebody else's."""

    lower, upper = np.array(BOX["lower"]), np.array(BOX["upper"])


def test_extrapolation_is_flagged_with_its_reason() -> None:
    inner = X[(np.abs(X[:, 0]) < 1.0) & (X[:, 1] < 2.0)]
    s = fit(inner, smooth(inner), **BOX)
    assert not extrapolation(s, inner, [0.1, 1.1]).flagged
    out = extrapolation(s, inner, [1.9, 2.9])
    assert out.flagged
    assert out.deviation is not None
    assert "outside the hull" in " ".join(out.reasons)
    assert "deviation is" in " ".join(out.reasons)
    assert "input 0, 1 is outside" in extrapolation(s, inner, [2.5, -1.0]).reasons[0]
    plain = fit(inner, smooth(inner), **BOX, kind="radial_basis")
    assert extrapolation(plain, inner, [1.9, 2.9]).deviation is None
    # A hole in the middle is no matter of the hull.
    ring = X[np.hypot(X[:, 0] / 2, X[:, 1] / 1.5 - 1) > 0.8]
    hole = extrapolation(fit(ring, smooth(ring), **BOX, kind="radial_basis"), ring, [0.0, 1.5])
    assert hole.hull < 1e-6
    assert "nearest sample" in hole.reasons[0]


@pytest.mark.parametrize("d", [2, 6])
def test_points_between_the_samples_are_not_flagged(d: int) -> None:
    low, high = np.zeros(d), np.ones(d)
    P = design("sobol", low, high, 64, seed=0)
    s = fit(P, np.sin(P.sum(1)), lower=low, upper=high, starts=1)
    unseen = design("lhs", low, high, 40, seed=1)
    flagged = [extrapolation(s, P, x).flagged for x in unseen]
    assert np.mean(flagged) < 0.1


def test_distance_to_the_hull() -> None:
    rng = np.random.default_rng(0)
    P = rng.random((50, 3))
    w = rng.dirichlet(np.ones(50))
    assert hull_distance(P, P.T @ w) < 1e-9
    corner = np.vstack([np.zeros(3), np.eye(3)])
    assert hull_distance(corner, np.ones(3)) == pytest.approx(2 / np.sqrt(3), rel=1e-5)
