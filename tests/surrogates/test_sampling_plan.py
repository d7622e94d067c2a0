"""Sampling plans: inside the box, reproducible, and with the structure they promise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.draws import few

from surrogates import corners, design, grid, latin_hypercube, sobol

LOW, HIGH = np.array([-1.0, 10.0, 0.1]), np.array([2.0, 11.0, 0.3])
KINDS = st.sampled_from(["sobol", "lhs"])


@few(max_examples=25)
@given(KINDS, st.integers(1, 70), st.integers(0, 2**31))
def test_plans_fill_the_box_and_depend_on_the_seed_alone(kind: str, n: int, seed: int) -> None:
    X = design(kind, LOW, HIGH, n, seed)
    assert X.shape == (n, 3)
    assert (X >= LOW).all()
    assert (X <= HIGH).all()
    np.testing.assert_array_equal(X, design(kind, LOW, HIGH, n, seed))
    assert not np.array_equal(X, design(kind, LOW, HIGH, n, seed + 1))


@few(max_examples=15)
@given(st.integers(1, 60), st.integers(0, 1000))
def test_latin_hypercube_has_one_point_in_every_slice(n: int, seed: int) -> None:
    unit = latin_hypercube(np.zeros(3), np.ones(3), n, seed)
    slices = np.sort(np.floor(unit * n).astype(int), axis=0)
    np.testing.assert_array_equal(slices, np.tile(np.arange(n)[:, None], 3))


@few(max_examples=10)
@given(st.integers(0, 1000))
def test_sobol_is_balanced_and_nested(seed: int) -> None:
    X = sobol([0, 0], [1, 1], 16, seed)
    # A (0, 2)-sequence: 16 points, one in each elementary box of area 1/16.
    for bits in range(5):
        cells = np.floor(X * [2**bits, 2 ** (4 - bits)]).astype(int)
        assert len({tuple(c) for c in cells}) == 16
    np.testing.assert_array_equal(sobol([0, 0], [1, 1], 11, seed), X[:11])


def test_grid_is_the_tensor_product_with_bounds() -> None:
    X = grid([0, 10], [1, 20], [3, 2])
    np.testing.assert_array_equal(X, [[0, 10], [0, 20], [0.5, 10], [0.5, 20], [1, 10], [1, 20]])
    np.testing.assert_array_equal(grid([0, 0], [1, 4], [1, 1]), [[0.5, 2.0]])
    np.testing.assert_array_equal(design("grid", LOW, HIGH, 4), grid(LOW, HIGH, 4))


def test_corners_are_all_vertices() -> None:
    C = corners(LOW, HIGH)
    assert len({tuple(c) for c in C}) == 8
    assert ((C == LOW) | (C == HIGH)).all()


@pytest.mark.parametrize(
    "arguments",
    [
        ("halton", [0], [1], 4),
        ("sobol", [0], [1], 0),
        ("lhs", [0], [1], -3),
        ("grid", [0], [1], 0),
        ("lhs", [1], [0], 4),
        ("lhs", [0, 0], [1], 4),
        ("sobol", [0], [np.inf], 4),
    ],
)
def test_bad_requests_are_refused(arguments: tuple) -> None:
    with pytest.raises(ValueError, match=r"bounds|at least one|DesignKind"):
        design(*arguments)
