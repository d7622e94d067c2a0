"""The kernels' parts against what they stand for: dense algebra, differences, closed forms."""

import numpy as np
import pytest
from helpers import (
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
from hypothesis import given
from hypothesis import strategies as st

from ccd_casadi.kernels import certificate, design, frequency, riccati, sensitivity, small
from ccd_casadi.kernels.closed_loop import loop_matrices, reachable_loop, weighted_loop
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.kernels.refine import _vertex, narrow, next_trial
from ccd_casadi.plant import mechanics
from ccd_casadi.scaling import StateSpace
from ccd_casadi.synthesis import synthesise

seeds = st.integers(0, 10**6)
WEIGHTS = PAPER.at(800.0 * HZ, 40.0 * HZ)


# ---- small complex matrices ----------------------------------------------------------------------


def complex_matrix(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


@few(max_examples=40)
@given(seeds, st.integers(1, 5), st.integers(1, 4))
def test_small_matrices_are_those_of_numpy(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = complex_matrix(rng, n, n), complex_matrix(rng, n, m)
    np.testing.assert_allclose(small.multiply(A, B), A @ B, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(small.invert(A) @ A, np.eye(n), atol=1e-10 * np.linalg.cond(A))
    Z = np.eye(m) + 0.0j
    small.add_gram(Z, B, 2.5)
    np.testing.assert_allclose(Z, np.eye(m) + 2.5 * B.conj().T @ B, rtol=1e-13, atol=1e-13)
    largest = np.linalg.eigvalsh(Z)[-1]
    assert small.largest_eigenvalue(Z.copy()) == pytest.approx(largest, rel=1e-12)


def test_a_matrix_with_a_zero_pivot_is_inverted_and_a_singular_one_is_infinite() -> None:
    swap = np.array([[0.0, 1.0], [1.0, 0.0]]) + 0.0j
    np.testing.assert_array_equal(small.invert(swap), swap)
    tiny = np.array([[1e-20, 1.0], [1.0, 1.0]]) + 0.0j  # without row exchanges: all digits lost
    np.testing.assert_allclose(small.invert(tiny), [[-1.0, 1.0], [1.0, 0.0]], atol=1e-15)
    assert np.isinf(small.invert(np.ones((3, 3)) + 0.0j)).all()


def test_the_largest_eigenvalue_of_a_diagonal_matrix_wherever_it_stands() -> None:
    for order in ((3.0, 1.0, 2.0), (1.0, 3.0, 2.0), (1.0, 2.0, 3.0)):
        assert small.largest_eigenvalue(np.diag(order) + 0.0j) == 3.0


# ---- frequency responses -------------------------------------------------------------------------


def random_system(seed: int, n: int, m: int, p: int) -> StateSpace:
    """Real and complex poles, some of them double."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - 2.0 * np.eye(n)
    return StateSpace(A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), np.zeros((p, m)))


@few(max_examples=25)
@given(seeds, st.integers(1, 8), st.integers(1, 3), st.integers(1, 3))
def test_schur_responses_and_slopes_are_those_of_dense_solves(seed, n, m, p) -> None:
    system = random_system(seed, n, m, p)
    prepared = frequency.prepare(system.A, system.B, system.C)
    omega = np.geomspace(1e-2, 1e2, 2 * frequency.CHUNK + 3)  # whole chunks and a part of one
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


# ---- brackets ------------------------------------------------------------------------------------


@few(max_examples=100)
@given(st.floats(-5.0, 5.0), st.floats(0.1, 10.0), st.floats(0.1, 2.0), st.floats(0.1, 2.0))
def test_the_vertex_of_a_parabola_is_found(top: float, bend: float, left: float, right: float):
    def f(x: float) -> float:
        return 3.0 - bend * (x - top) ** 2

    x = top + 0.3 * (right - left)
    a, b = x - left, x + right
    assert _vertex(a, f(a), x, f(x), b, f(b)) == pytest.approx(top, abs=1e-10)
    assert _vertex(a, -f(a), x, -f(x), b, -f(b)) == x  # it bends upwards


@few(max_examples=60)
@given(st.floats(0.05, 0.95), st.floats(0.5, 20.0), st.floats(0.05, 0.95))
def test_a_bracket_closes_around_the_maximum_it_holds(top: float, sharp: float, x: float) -> None:
    """a < x < b with f(x) the best throughout; few trials for a smooth peak, and no step left."""

    def f(at: float) -> float:
        return 1.0 / (1.0 + (sharp * (at - top)) ** 2)

    a, b = (0.0, 1.0) if f(x) > max(f(0.0), f(1.0)) else (2.0 * top - 2.0, 2.0)
    x = x if a == 0.0 else top + 0.1
    bracket = (a, f(a), x, f(x), b, f(b))
    for _ in range(20):  # trials
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


# ---- the loop that the reference can reach -------------------------------------------------------


def loop_of(plant, K: StateSpace, weights=WEIGHTS):  # type: ignore[no-untyped-def]
    parts = (np.ascontiguousarray(part) for part in (K.A, K.B, K.C, K.D))
    return weighted_loop(plant.A, plant.B, plant.C, *parts, weights.scaled(plant.omega_0))


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


# ---- the gain of S and of the stack --------------------------------------------------------------


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

    found = (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)
    assert slope == pytest.approx(found, rel=1e-5, abs=1e-6 * gain / omega)


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
    w = weights.scaled(plant.omega_0)
    omega = np.geomspace(1e-2, 1e2, 9)
    expected = stack_gain(
        plant.plant_si(), in_time_unit(K, 1.0 / plant.omega_0, 1.0 / plant.force), weights,
        omega * plant.omega_0,
    )  # fmt: skip
    np.testing.assert_allclose(certificate.stack_gains(G, k, K.D, w, omega), expected, rtol=1e-8)
    one = [certificate.stack_gain(G, k, K.D, w, at) for at in omega]
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
    assert certificate.stack_gain(G, K, Dk, w, omega) > 1.1 * level
    for beside in (0.5, 0.99, 1.01, 2.0):
        assert certificate.stack_gain(G, K, Dk, w, beside * omega) < level
    # a loop that has its one candidate there: |a/(jω + a)| = level
    a = omega / np.sqrt(level**-2 - 1.0) * one
    loop = (-a, one, a, 0.0 * one)
    assert sensitivity.axis_frequencies(*loop, level)[0] == pytest.approx([omega], rel=1e-9)
    assert not certificate.level_test(G, K, Dk, w, loop, level)
    flat = frequency.prepare(-one, one, 0.0 * one)
    assert certificate.level_test(flat, K, Dk, w, loop, level)


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


# ---- sweeps and channels -------------------------------------------------------------------------


def test_the_guess_is_exact_where_gamma_is_a_product_of_powers() -> None:
    """ln γ = a ln ω_S + b ln ω_T: every point but the first and those beside it is foretold."""
    x, y = [0.0, 0.7, 1.1, 2.0], [0.3, 0.9, 1.0, 1.6]
    found = np.full((4, 4), np.nan)
    for j in range(4):
        side = 1 if j % 2 == 0 else -1
        for step in range(4):
            i = step if side == 1 else 3 - step
            guess = design._guess(found, x, y, i, j, side, step)
            found[i, j] = 0.8 * x[i] - 0.5 * y[j]
            if (step, j) == (0, 0):
                assert guess == 0.0
            elif (step, j) == (1, 0):
                assert guess == pytest.approx(np.exp(found[0, 0]))
            elif (step, j) != (0, 1):
                assert guess == pytest.approx(np.exp(found[i, j]), rel=1e-12)


def test_a_guess_from_what_was_not_certified_is_the_last_one_or_none() -> None:
    x = y = [0.0, 1.0, 2.0]
    found = np.full((3, 3), np.nan)
    found[1, 0] = 0.4
    assert design._guess(found, x, y, 2, 0, 1, 2) == pytest.approx(np.exp(0.4))
    found[1, 0] = np.nan
    assert design._guess(found, x, y, 2, 0, 1, 2) == 0.0


def test_a_sweep_needs_fewer_schur_forms_than_its_points_alone() -> None:
    plant = two_mass(58.0, 63.0)
    omega_S = np.geomspace(10, 2000, 6) * HZ / plant.omega_0
    omega_T = np.geomspace(20, 1000, 5) * HZ / plant.omega_0
    w = PAPER.scaled(plant.omega_0)
    numbers = (plant.grid, plant.gain, 1.02, OMEGA_LOW / plant.omega_0)
    rows = design.sweep(plant.A, plant.B, plant.C, w, omega_S, omega_T, *numbers)
    alone = 0.0
    for i, S in enumerate(omega_S):
        for j, T in enumerate(omega_T):
            w[2], w[7] = S, T
            row = design.design(plant.A, plant.B, plant.C, w, *numbers, 0.0)[0]
            alone += row[design.Figure.SCHUR_FORMS]
            assert rows[i, j, design.Figure.GAMMA_OPT] == pytest.approx(
                row[design.Figure.GAMMA_OPT], rel=1e-9
            )
    assert rows[:, :, design.Figure.SCHUR_FORMS].sum() < 0.7 * alone


def test_the_search_for_gamma_takes_few_schur_forms() -> None:
    """Newton's method in 1/t from afar, and the step of order four from a guess 1 % off."""
    plant = two_mass(58.0, 63.0)
    numbers = (plant.grid, plant.gain, 1.02, OMEGA_LOW / plant.omega_0)
    cold, near = [], []
    for S in np.geomspace(10, 2000, 8) * HZ:
        for T in np.geomspace(20, 1000, 5) * HZ:
            arguments = (plant.A, plant.B, plant.C, PAPER.at(S, T).scaled(plant.omega_0), *numbers)
            row = design.design(*arguments, 0.0)[0]
            cold.append(row[design.Figure.SCHUR_FORMS])
            for factor in (0.99, 1.01):
                again = design.design(*arguments, factor * row[design.Figure.GAMMA_OPT])[0]
                near.append(again[design.Figure.SCHUR_FORMS])
    assert np.mean(cold) < 4.0
    assert max(cold) <= 8
    assert np.mean(near) < 2.2


# ---- the Riccati level ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def level():  # type: ignore[no-untyped-def]
    """`riccati_level` of a design as a function of t, t at γ_opt, and what `root_nearby` takes."""
    plant = two_mass(58.0, 63.0)
    _, B1, B2, C1, _, d1, d2 = gp = generalized_plant(
        plant.A, plant.B, plant.C, WEIGHTS.scaled(plant.omega_0)
    )
    H0 = riccati.lqr_hamiltonian(gp[0], B2, C1, d2, 1, 1)
    gamma = synthesise(plant, WEIGHTS, omega_low=OMEGA_LOW).figures.gamma_opt

    def at(t: float):  # type: ignore[no-untyped-def]
        return riccati.riccati_level(H0, B1, C1, d1, t, riccati.NOISE)

    return at, gamma**2 - d1**2, (B1, C1, d1)


@pytest.mark.parametrize("factor", [0.9, 0.999, 1.01, 2.0, 10.0])
def test_the_slope_of_the_riccati_level_is_that_of_its_differences(level, factor: float) -> None:
    """Also where X is no longer positive; zero at γ_opt, increasing in t."""
    at, top, _ = level
    t = factor * top
    f, slope, ok, _ = at(t)
    assert ok
    assert (f > 0.0) == (factor > 1.0)
    h = 1e-4 * t
    found = (8.0 * (at(t + h)[0] - at(t - h)[0]) - at(t + 2 * h)[0] + at(t - 2 * h)[0]) / (12.0 * h)
    assert slope > 0.0
    assert slope == pytest.approx(found, rel=1e-6)


def test_the_step_to_the_root_is_of_order_four(level) -> None:  # type: ignore[no-untyped-def]
    """Half as far away the error is a sixteenth at last, and the estimate of it is no smaller."""
    at, top, parts = level
    errors, estimates = [], []
    for off in (0.08, 0.04, 0.02):
        t = (1.0 + off) * top
        f, slope, _, frame = at(t)
        step, estimate = riccati.root_nearby(*parts, frame, f / (slope * t * t))
        errors.append(abs(t / (1.0 + step * t) - top) / top)
        estimates.append(estimate * top)
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert (ratios > 11.0).all()  # of order three they would tend to eight
    assert (np.array(estimates) > errors).all()
    assert (np.array(estimates) < 100.0 * np.array(errors)).all()


@pytest.mark.parametrize("seed", [0, 15, 27])
def test_the_error_of_the_step_to_the_root_is_within_its_estimate(seed: int) -> None:
    """From either side, where the root is well conditioned."""
    case = flexible_case(seed)
    plant, w = case.plant, case.weights.scaled(case.plant.omega_0)
    gp = generalized_plant(plant.A, plant.B, plant.C, w)
    H0 = riccati.lqr_hamiltonian(gp[0], gp[2], gp[3], gp[6], 3, 3)
    gamma = synthesise(plant, case.weights, omega_low=OMEGA_LOW).figures.gamma_opt
    top = gamma**2 - gp[5] ** 2
    for off in (-0.1, -0.03, 0.03, 0.1):
        t = (1.0 + off) * top
        f, slope, _, frame = riccati.riccati_level(H0, gp[1], gp[3], gp[5], t, riccati.NOISE)
        step, estimate = riccati.root_nearby(gp[1], gp[3], gp[5], frame, f / (slope * t * t))
        assert abs(t / (1.0 + step * t) - top) < top * estimate * top
