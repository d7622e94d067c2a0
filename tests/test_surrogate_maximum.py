"""The maximum of smooth pieces: where one smooth surrogate meets a kink."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogates import (
    Maximum,
    SurrogateFitError,
    design,
    fit,
    fit_maximum,
    load,
    pieces_of,
    save,
    to_casadi,
)

BOX = {"lower": [0.0, -1.0], "upper": [1.0, 1.0]}
X = design("sobol", **BOX, n=40, seed=1)
T = design("lhs", **BOX, n=400, seed=2)


def both(points: np.ndarray) -> np.ndarray:
    """Two smooth functions that cross inside the box."""
    return np.array([np.sin(2.0 * points[:, 0] + points[:, 1]), 0.9 * np.cos(points.sum(1))])


def slopes(points: np.ndarray) -> np.ndarray:
    c, s = np.cos(2.0 * points[:, 0] + points[:, 1]), -0.9 * np.sin(points.sum(1))
    first, second = np.array([2.0 * c, c]).T, np.array([s, s]).T
    return np.where((both(points).argmax(0) == 0)[:, None], first, second)


@pytest.mark.parametrize("gradients", [False, True])
def test_pieces_follow_a_kink_that_one_surrogate_cannot(gradients: bool) -> None:
    Y, dY = both(X).max(0), slopes(X) if gradients else None
    whole = fit(X, Y, dY, **BOX, starts=1)
    parts = fit_maximum(X, Y, both(X).argmax(0), dY, **BOX, starts=1)

    def rms(surrogate: object) -> float:
        return float(np.sqrt(np.mean((surrogate.predict(T) - both(T).max(0)) ** 2)))

    assert rms(parts) < 0.3 * rms(whole)
    value, std = parts.predict(T, return_std=True)
    f = to_casadi(parts).map(len(T))(T.T)
    np.testing.assert_allclose(np.array(f[0]).ravel(), value, atol=1e-9)
    # The variance cancels to eps times that of the signal.
    np.testing.assert_allclose(np.array(f[1]).ravel(), std, atol=1e-5)
    assert parts.loo.rms < 0.3 * whole.loo.rms


def test_a_maximum_survives_its_file_and_has_the_slope_of_its_largest(tmp_path: Path) -> None:
    parts = fit_maximum(X, both(X).max(0), both(X).argmax(0), **BOX, starts=1)
    save(parts, tmp_path / "surrogate.json")
    (again,), _ = load(tmp_path / "surrogate.json")
    assert isinstance(again, Maximum)
    np.testing.assert_array_equal(again.predict(T), parts.predict(T))
    x = ca.MX.sym("x", 2)
    slope = ca.Function("g", [x], [ca.gradient(to_casadi(parts, std=False)(x), x)])
    at = np.array([0.3, 0.2])
    largest = max(parts.pieces, key=lambda piece: float(piece.predict(at)[0]))
    own = ca.Function("g", [x], [ca.gradient(to_casadi(largest, std=False)(x), x)])
    np.testing.assert_array_equal(np.array(slope(at)), np.array(own(at)))


@settings(max_examples=50)
@given(
    centres=st.lists(st.integers(0, 12), min_size=1, max_size=4, unique=True),
    sizes=st.lists(st.integers(1, 9), min_size=4, max_size=4),
    seed=st.integers(0, 99),
)
def test_pieces_are_what_stands_apart(centres: list[int], sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    own = np.concatenate([np.full(sizes[i], c) for i, c in enumerate(centres)])
    marks = 50.0 * 2.0**own * rng.uniform(0.95, 1.05, own.size)
    labels = pieces_of(marks, 4)
    kept = np.bincount(labels)
    assert (kept >= 4).all() or len(kept) == 1
    # Pieces are in the order of their marks, and a group is never torn apart.
    assert (np.diff(labels[np.argsort(marks)]) >= 0).all()
    for centre in centres:
        assert len(set(labels[own == centre])) == 1
    if min(sizes[: len(centres)]) >= 4:
        assert len(kept) == len(centres)


def test_what_cannot_be_parted_is_said() -> None:
    Y = both(X).max(0)
    labels = np.zeros(40)
    labels[:2] = 1
    with pytest.raises(SurrogateFitError, match=r"piece 1.0 has 2 samples, fewer than 4"):
        fit_maximum(X, Y, labels, **BOX)
    with pytest.raises(SurrogateFitError, match=r"expected pieces \(40,\)"):
        fit_maximum(X, Y, labels[:5], **BOX)
    with pytest.raises(ValueError, match="needs pieces"):
        Maximum((), np.zeros(1), fit(X, Y, **BOX, starts=1).loo)
