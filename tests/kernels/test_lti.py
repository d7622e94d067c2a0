"""Linear systems: the closed loop, hold and delay beside the judges' own, zeros, grids, peaks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from ccd_casadi.fixed_structure.certificate_responses import zoh as judged
from ccd_casadi.lti.frequency_grid import frequency_grid, local_maxima, refine_peak, root_flanks
from ccd_casadi.lti.loop import Loop, Sampling, at_instants, held, in_w, transfer, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop, responses_of

OMEGA = np.geomspace(0.1, 50.0, 40)


def system(seed: int, n: int, m: int, p: int, direct: bool = False) -> StateSpace:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(n)
    D = rng.normal(size=(p, m)) if direct else np.zeros((p, m))
    return StateSpace(A, rng.normal(size=(n, m)), 0.3 * rng.normal(size=(p, n)), D)


@pytest.mark.parametrize("period", [0.0, 0.02])
def test_every_response_of_the_closed_loop_is_that_of_its_parts(period: float) -> None:
    G, K = system(1, 5, 2, 2), system(2, 4, 2, 2, direct=True)
    if period:
        G, K = zoh(G, period, 0.7 * period), tustin(K, period)
    loop, omega = closed_loop(G, K), OMEGA
    parts = responses_of(G.response(omega), K.response(omega))
    for name in ("S", "KS", "T", "GS"):
        np.testing.assert_allclose(getattr(loop, name).response(omega), parts[name], atol=1e-10)
    np.testing.assert_allclose(G.sweep(omega), G.response(omega), atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.02, 0.033])
def test_hold_and_delay_are_those_of_the_judge_and_of_the_modal_form(delay: float) -> None:
    G, T = system(3, 4, 2, 2), 0.02
    found = zoh(G, T, delay).response(OMEGA)
    other = judged(G, Sampling(1.0 / T, 1e6 * delay))
    np.testing.assert_allclose(other.at(np.exp(1j * OMEGA * T)), found, atol=1e-11)
    assert G.modes is not None
    poles, drive, reading = G.modes
    f = transfer(poles, OMEGA, T, delay)
    np.testing.assert_allclose((reading * f[:, None, :]) @ drive, found, atol=1e-10)
    in_the_plane = in_w(zoh(G, T, delay)).at(2j / T * np.tan(0.5 * OMEGA * T))
    np.testing.assert_allclose(in_the_plane, found, atol=1e-9)


def test_the_sampled_loop_is_that_of_the_judge() -> None:
    G, K, at = system(4, 4, 1, 1), system(5, 2, 1, 1), Sampling(60.0, 9e3)
    loop = Loop(G, K, at)
    held = replace(judged(G, at), period=at.period)
    other = closed_loop(held, tustin(K, at.period)).S
    np.testing.assert_allclose(loop.sensitivity(OMEGA), other.response(OMEGA), atol=1e-10)
    assert loop.stable == bool(np.abs(other.poles).max() < 1.0)


def test_zeros_and_series() -> None:
    first = StateSpace(np.diag([-1.0, -3.0]), np.ones((2, 1)), np.array([[1.0, 2.0]]),
                       np.zeros((1, 1)))  # fmt: skip
    then = StateSpace(np.array([[-4.0]]), np.eye(1), np.array([[3.0]]), np.array([[0.5]]))
    both = first.series(then)
    np.testing.assert_allclose(both.response(OMEGA), then.response(OMEGA) @ first.response(OMEGA))
    np.testing.assert_allclose(np.sort(both.zeros(5.0).real), [-10.0, -5.0 / 3.0], rtol=1e-9)
    assert first.zeros().imag == pytest.approx(0.0)
    assert not len(system(6, 3, 2, 1).zeros())


def test_a_held_loop_equals_the_continuous_one_at_its_instants() -> None:
    loop = closed_loop(system(7, 3, 1, 1), system(8, 2, 1, 1))
    coarse, fine = at_instants(loop, 0.4), at_instants(loop, 0.1)
    A = np.linalg.matrix_power(fine.A, 4)
    np.testing.assert_allclose(coarse.A, A, atol=1e-12)
    steps = sum(np.linalg.matrix_power(fine.A, i) for i in range(4))
    np.testing.assert_allclose(coarse.B_d, steps @ fine.B_d, atol=1e-12)


def test_a_grid_holds_its_resonances_and_a_climb_ends_on_top() -> None:
    roots = np.array([-0.01 + 3.0j, -0.01 - 3.0j])
    grid = frequency_grid(0.1, 10.0, 30, root_flanks(roots), np.array([np.nan, 20.0]), apart=1e-6)
    assert (np.diff(grid) > 1e-6 * grid[1:]).all()
    assert np.isin(3.0, grid)
    assert grid[-1] == pytest.approx(10.0)

    def gain(omega: float) -> float:
        return abs(1.0 / (9.0 - omega**2 + 0.02j * omega))

    values = np.array([gain(omega) for omega in grid])
    (top,) = local_maxima(values)
    at, height = refine_peak(gain, grid[top - 1], grid[top + 1])
    assert at == pytest.approx(np.sqrt(9.0 - 0.0002), rel=1e-7)
    assert height >= values.max()


@pytest.mark.parametrize("delay_us", [0.0, 150.0])
def test_a_free_body_beside_resonances_is_held_exactly(delay_us: float) -> None:
    """1/(m s²) and a mode far below and far above it, in time: against sums of their own."""
    rng, sampling = np.random.default_rng(3), Sampling(1e4, delay_us)
    bodies, total = [], 0.0
    omega = np.geomspace(1.0, 0.9 * np.pi * sampling.rate_hz, 40)
    for w0 in (0.0, 30.0, 6e3):
        A = np.array([[0.0, 1.0], [-(w0**2), -0.02 * w0]])
        C = np.eye(1, 2) * rng.uniform(1.0, 2.0)
        one = StateSpace(A, np.eye(2, 1, -1), C, np.zeros((1, 1)))
        bodies.append(one)
        total = total + zoh(one, sampling.period, sampling.delay).response(omega)
    A = block_diag(*(one.A for one in bodies))
    T = rng.normal(size=(6, 6))  # states of any kind
    B, C = np.vstack([one.B for one in bodies]), np.hstack([one.C for one in bodies])
    mixed = StateSpace(A, B, C, np.zeros((1, 1)))
    np.testing.assert_allclose(held(mixed, omega, sampling), total, rtol=1e-9)
    np.testing.assert_allclose(mixed.sweep(omega), mixed.response(omega), rtol=1e-9)
    other = StateSpace(np.linalg.solve(T, A @ T), np.linalg.solve(T, B), C @ T, np.zeros((1, 1)))
    np.testing.assert_allclose(held(other, omega, sampling), total, rtol=1e-5)
