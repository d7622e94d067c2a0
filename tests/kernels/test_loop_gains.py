"""The rebuilt loop and its gains: what the reference reaches, S, the weighted stack, levels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.differences import difference
from oracles.helpers import (
    HZ,
    OMEGA_LOW,
    PAPER,
    few,
    flexible_case,
    in_time_unit,
    random_plant,
    scaled,
    stack_gain,
    state_response,
    two_mass,
)
from oracles.kernel_draws import WEIGHTS, random_system, seeds

from ccd_casadi.kernels import frequency, sensitivity
from ccd_casadi.kernels import loop_certificate as certificate
from ccd_casadi.kernels.loop_certificate import loop_matrices, reachable_loop, weighted_loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.synthesis.synthesis import synthesise


def loop_of(plant, K: StateSpace, weights=WEIGHTS):  # type: ignore[no-untyped-def]
    parts = (np.ascontiguousarray(part) for part in (K.A, K.B, K.C, K.D))
    w = weights.scale(plant.omega_0)
    return weighted_loop(plant.A, plant.B, plant.C, *parts, w, 0.0)


@pytest.fixture(scope="module", params=["two masses", "flexible"])
def observer_based(request):  # type: ignore[no-untyped-def]
    """A plant, its own controller in the plant's unit of time, and the weights."""
    if request.param == "two masses":
        plant, weights = two_mass(60.0, 57.0), WEIGHTS
    else:
        case = flexible_case(3)
        plant, weights = case.plant, case.weights
    K = synthesise(plant, weights, omega_low=OMEGA_LOW).controller
    return plant, in_time_unit(K, plant.omega_0, plant.force), weights


def test_the_reachable_loop_is_half_as_large_and_the_same_to_the_reference(observer_based) -> None:
    plant, K, weights = observer_based
    loop = loop_of(plant, K, weights)
    n, N = len(plant.A), len(K.A)
    small_loop, smaller = reachable_loop(loop, n, N)
    assert smaller
    assert small_loop[0].shape == (N, N)
    omega = np.geomspace(1e-3, 1e3, 40)
    whole = state_response(StateSpace(*loop), omega)
    part = state_response(StateSpace(*small_loop), omega)
    size = np.abs(whole).max(axis=(1, 2))
    assert (np.abs(part - whole).max(axis=(1, 2)) < 1e-7 * size).all()


def test_any_entry_moved_by_more_than_rounding_keeps_the_whole_loop(observer_based) -> None:
    """However small the entry, a zero among them: the tolerance is relative to its own terms."""
    plant, K, weights = observer_based
    n, N = len(plant.A), len(K.A)
    Az, Bz, *_ = loop_of(plant, K, weights)
    z, k = np.r_[:n, n + N : 2 * N], np.arange(n, n + N)
    terms = np.abs(Az[np.ix_(z, z)]) + np.abs(Az[np.ix_(z, k)])
    terms += np.abs(Az[np.ix_(k, z)]) + np.abs(Az[np.ix_(k, k)])
    sizes = {"A": terms, "B": np.abs(Bz[z]) + np.abs(Bz[k])}
    rng = np.random.default_rng(0)
    for name, size in sizes.items():
        for i in range(N):
            j = int(rng.integers(size.shape[1]))
            matrix = getattr(K, name).copy()
            matrix[i, j] += 1e-9 * size[i, j] or 1e-20
            loop = loop_of(plant, StateSpace(**(vars(K) | {name: matrix})), weights)
            same, smaller = reachable_loop(loop, n, N)
            assert not smaller
            assert same[0].shape == loop[0].shape


def test_a_controller_of_another_order_keeps_the_whole_loop(observer_based) -> None:
    plant, K, weights = observer_based
    n, N = len(plant.A), len(K.A)
    fewer = StateSpace(K.A[1:, 1:], K.B[1:], K.C[:, 1:], K.D)
    assert not reachable_loop(loop_of(plant, fewer, weights), n, N - 1)[1]


@pytest.mark.parametrize("outputs", [1, 2])
@few(max_examples=12)
@given(seeds, st.floats(-1.0, 1.0))
def test_the_slope_of_the_sensitivity_is_that_of_its_gain(outputs: int, seed: int, at: float):
    G = random_system(seed, 5, outputs, outputs)
    K = random_system(seed + 1, 3, outputs, outputs)
    Dk = np.random.default_rng(seed).normal(size=(outputs, outputs))
    g, k = frequency.prepare(G.A, G.B, G.C), frequency.prepare(K.A, K.B, K.C)
    omega, h = 10.0**at, 1e-4 * 10.0**at
    gain, slope = sensitivity.sensitivity_slope(g, k, Dk, omega)
    assert gain == pytest.approx(sensitivity.sensitivity_gain(g, k, Dk, omega), rel=1e-11)

    def f(x: float) -> float:
        return sensitivity.sensitivity_gain(g, k, Dk, omega + x)

    assert slope == pytest.approx(difference(f, h), rel=1e-5, abs=1e-6 * gain / omega)


@few(max_examples=12)
@given(seeds, st.integers(1, 2), st.integers(1, 3))
def test_the_gain_of_the_stack_is_that_of_the_si_loop(seed: int, p: int, m: int) -> None:
    """Any controller, with a feedthrough too; at one frequency and at many."""
    plant = scaled(
        mechanics(random_plant(seed, rigid=1, flexible=2, inputs=m, outputs=p), (0.5, 0.5)), 1e5
    )
    rng = np.random.default_rng(seed)
    K = StateSpace(-np.diag(rng.uniform(0.1, 10.0, 3)), rng.normal(size=(3, p)),
                   rng.normal(size=(m, 3)), rng.normal(size=(m, p)))  # fmt: skip
    weights = PAPER.at(30.0 * HZ, 100.0 * HZ)
    weights = type(weights)(**(vars(weights) | {"M_K": 1e5}))
    G, k = frequency.prepare(plant.A, plant.B, plant.C), frequency.prepare(K.A, K.B, K.C)
    w = weights.scale(plant.omega_0)
    omega = np.geomspace(1e-2, 1e2, 9)
    expected = stack_gain(
        plant.plant_si(), in_time_unit(K, 1.0 / plant.omega_0, 1.0 / plant.force), weights,
        omega * plant.omega_0,
    )  # fmt: skip
    np.testing.assert_allclose(
        certificate.stack_gains(G, k, K.D, w, 0.0, omega), expected, rtol=1e-8
    )
    one = [certificate.stack_gain(G, k, K.D, w, 0.0, at) for at in omega]
    np.testing.assert_allclose(one, expected, rtol=1e-8)


@few(max_examples=15)
@given(st.floats(0.05, 0.95), st.floats(-2.0, 2.0))
def test_a_first_order_gain_is_at_a_level_where_it_says(level: float, exponent: float) -> None:
    """|a/(jω + a)| = l at ω = a √(1/l² - 1)."""
    a = np.full((1, 1), 10.0**exponent)
    found, info = sensitivity.axis_frequencies(
        -a, np.ones((1, 1)), a.copy(), np.zeros((1, 1)), level
    )
    assert info == 0
    np.testing.assert_allclose(found, a[0] * np.sqrt(level**-2 - 1.0), rtol=1e-7)
    none, _ = sensitivity.axis_frequencies(-a, np.ones((1, 1)), a.copy(), np.zeros((1, 1)), 1.1)
    assert none.size == 0


def test_a_gain_above_the_level_at_a_candidate_is_not_passed() -> None:
    """A resonance so narrow that the points about the candidate do not see it."""
    omega, zeta, one = 3.0, 1e-4, np.ones((1, 1))
    A = np.array([[0.0, omega], [-omega, -2.0 * zeta * omega]])
    G = frequency.prepare(A, np.array([[0.0], [1.0]]), np.array([[6.0 * zeta * omega, 0.0]]))
    K = frequency.prepare(-one, one, 0.0 * one)
    w = np.array([2.0, 1e-3, 1e-3, 1.0, 1.0, 1.0, 1.0, 1.0])  # |W1| is 1/2 but far below
    Dk = 0.3 * one
    level = 0.65
    assert certificate.stack_gain(G, K, Dk, w, 0.0, omega) > 1.1 * level
    for beside in (0.5, 0.99, 1.01, 2.0):
        assert certificate.stack_gain(G, K, Dk, w, 0.0, beside * omega) < level
    # a loop that has its one candidate there: |a/(jω + a)| = level
    a = omega / np.sqrt(level**-2 - 1.0) * one
    loop = (-a, one, a, 0.0 * one)
    assert sensitivity.axis_frequencies(*loop, level)[0] == pytest.approx([omega], rel=1e-9)
    assert not certificate.level_test(G, K, Dk, w, 0.0, loop, level)
    flat = frequency.prepare(-one, one, 0.0 * one)
    assert certificate.level_test(flat, K, Dk, w, 0.0, loop, level)


def test_the_loop_of_s_is_the_inverse_of_one_plus_gk() -> None:
    plant, rng = two_mass(60.0, 60.0), np.random.default_rng(1)
    K = StateSpace(
        -np.diag([1.0, 2.0]), rng.normal(size=(2, 1)), rng.normal(size=(1, 2)), np.full((1, 1), 0.7)
    )
    A, B, C = loop_matrices(plant.A, plant.B, plant.C, K.A, K.B, K.C, K.D)
    omega = np.geomspace(1e-2, 1e2, 20)
    found = state_response(StateSpace(A, B, C, np.eye(1)), omega)
    G = StateSpace(plant.A, plant.B, plant.C, np.zeros((1, 1)))
    expected = 1.0 / (1.0 + state_response(G, omega) * state_response(K, omega))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
