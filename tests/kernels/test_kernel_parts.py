"""The kernels' building blocks against dense algebra: small matrices, responses, brackets."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import few, state_response
from oracles.kernel_draws import complex_matrix, random_system, seeds

from ccd_casadi.kernels import frequency
from ccd_casadi.kernels import linear_algebra as algebra
from ccd_casadi.kernels.frequency import _vertex, narrow, next_trial, promised_rise


@few(max_examples=40)
@given(seeds, st.integers(1, 5), st.integers(1, 4))
def test_small_matrices_are_those_of_numpy(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = complex_matrix(rng, n, n), complex_matrix(rng, n, m)
    np.testing.assert_allclose(algebra.multiply(A, B), A @ B, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(algebra.invert(A) @ A, np.eye(n), atol=1e-10 * np.linalg.cond(A))
    assert algebra.largest_singular(B.copy()) == pytest.approx(np.linalg.norm(B, 2), rel=1e-12)


def test_a_matrix_with_a_zero_pivot_is_inverted_and_a_singular_one_is_infinite() -> None:
    swap = np.array([[0.0, 1.0], [1.0, 0.0]]) + 0.0j
    np.testing.assert_array_equal(algebra.invert(swap), swap)
    tiny = np.array([[1e-20, 1.0], [1.0, 1.0]]) + 0.0j  # without row exchanges: all digits lost
    np.testing.assert_allclose(algebra.invert(tiny), [[-1.0, 1.0], [1.0, 0.0]], atol=1e-15)
    assert np.isinf(algebra.invert(np.ones((3, 3)) + 0.0j)).all()


def test_the_largest_singular_value_of_a_diagonal_matrix_wherever_it_stands() -> None:
    for order in ((3.0, 1.0, 2.0), (1.0, 3.0, 2.0), (1.0, 2.0, 3.0)):
        assert algebra.largest_singular(np.diag(order) + 0.0j) == 3.0


@few(max_examples=25)
@given(seeds, st.integers(1, 8), st.integers(1, 3), st.integers(1, 3))
def test_schur_responses_and_slopes_are_those_of_dense_solves(seed, n, m, p) -> None:
    system = random_system(seed, n, m, p)
    prepared = frequency.prepare(system.A, system.B, system.C)
    # whole chunks and a part of one
    omega = np.geomspace(1e-2, 1e2, 2 * frequency.OPTIONS.chunk + 3)
    expected = state_response(system, omega)
    size = np.linalg.norm(system.C) * np.linalg.norm(system.B)
    inverse = np.linalg.inv(1j * omega[:, None, None] * np.eye(n) - system.A)
    scale = size * np.linalg.norm(inverse, 2, axis=(1, 2))
    error = np.abs(frequency.responses(prepared, omega) - expected).max(axis=(1, 2))
    assert (error <= 1e-11 * scale).all()
    slopes = -1j * (system.C @ inverse @ inverse @ system.B)
    for i in (0, 20, 40, 66):
        value, slope = frequency.response_and_slope(prepared, omega[i])
        assert np.abs(value - expected[i]).max() <= 1e-11 * scale[i]
        assert np.abs(slope - slopes[i]).max() <= 1e-10 * scale[i] ** 2 / size
        assert (
            np.abs(frequency.response(prepared, omega[i]) - expected[i]).max() <= 1e-11 * scale[i]
        )


@few(max_examples=100)
@given(st.floats(-5.0, 5.0), st.floats(0.1, 10.0), st.floats(0.1, 2.0), st.floats(0.1, 2.0))
def test_the_vertex_of_a_parabola_is_found(top: float, bend: float, left: float, right: float):
    def f(x: float) -> float:
        return 3.0 - bend * (x - top) ** 2

    x = top + 0.3 * (right - left)
    a, b = x - left, x + right
    assert _vertex(a, f(a), x, f(x), b, f(b)) == pytest.approx(top, abs=1e-10)
    assert _vertex(a, -f(a), x, -f(x), b, -f(b)) == x  # it bends upwards
    points = (a, f(a), x, f(x), b, f(b))
    assert promised_rise(*points) == pytest.approx(3.0 - f(x), rel=1e-6, abs=1e-9)
    assert promised_rise(a, -f(a), x, -f(x), b, -f(b)) == np.inf


@few(max_examples=60)
@example(0.333984375, 16.0, 0.25)  # 20
@given(st.floats(0.05, 0.95), st.floats(0.5, 20.0), st.floats(0.05, 0.95))
def test_a_bracket_closes_around_the_maximum_it_holds(top: float, sharp: float, x: float) -> None:
    """a < x < b with f(x) the best throughout; few trials for a smooth peak, and no step left."""

    def f(at: float) -> float:
        return 1.0 / (1.0 + (sharp * (at - top)) ** 2)

    a, b = (0.0, 1.0) if f(x) > max(f(0.0), f(1.0)) else (2.0 * top - 2.0, 2.0)
    x = x if a == 0.0 else top + 0.1
    bracket = (a, f(a), x, f(x), b, f(b))
    for _ in range(25):  # trials: 21 at most in 200,000 draws, in two of three 14 to 17
        a, fa, x, fx, b, fb = bracket
        assert a < x < b
        assert fx >= max(fa, fb)
        assert a <= top <= b
        new, room = next_trial(*bracket, 1e-12)
        if room == 0.0:
            break
        assert a < new < b
        assert new != x
        assert room == max(fx - fa, fx - fb)
        bracket = narrow(*bracket, new, f(new))
    assert room == 0.0
    assert x == pytest.approx(top, abs=1e-5)
