"""Sampled loops against brute force: fine steps, dense grids, and a run sample by sample."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few
from oracles.sampled_simulation import measure_set, simulate
from scipy.linalg import expm

from ccd_casadi.analysis.loop_channels import SampledFigures, sampled_figures, worst_figures
from ccd_casadi.deployment.discretise import Conversion, Target, discretise, needed_rate, nice_rate
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop

HZ = 2.0 * np.pi


def stage(channels: int = 1) -> StateSpace:
    """Collocated masses of 1 kg, each with a resonance at 60 Hz."""
    k, w = (HZ * 0.1) ** 2, HZ * 60.0
    A = np.array([[0, 1, 0, 0], [-k, -0.9, 0, 0], [0, 0, 0, 1], [0, 0, -(w**2), -0.02 * w]])
    B, C = np.array([[0.0], [1.0], [0.0], [0.3]]), np.array([[1.0, 0.0, 0.3, 0.0]])
    eye = np.eye(channels)
    return StateSpace(*(np.kron(eye, part) for part in (A, B, C, [[0.0]])))


def lead(channels: int = 1) -> StateSpace:
    """A proper lead around 10 Hz with roll-off: a crossover of some 10 Hz with `stage`."""
    w = HZ * 10.0
    A = np.array([[-3.0 * w, w], [0.0, -6.0 * w]])
    B, C = np.array([[0.0], [6.0 * w]]), w**2 * np.array([[-8.0 / 3.0, 1.0]])
    eye = np.eye(channels)
    return StateSpace(*(np.kron(eye, part) for part in (A, B, C, [[0.0]])))


def loop(period: float, delay: float, channels: int = 1) -> StateSpace:
    K = discretise(lead(channels), Conversion.LEAD, period, delay)
    return closed_loop(zoh(stage(channels), period, delay), K).S


@few(max_examples=25)
@given(
    seed=st.integers(0, 10**6), steps=st.integers(0, 3), part=st.integers(0, 19),
    states=st.integers(1, 4),
)  # fmt: skip
def test_the_sampled_plant_is_the_plant(seed: int, steps: int, part: int, states: int) -> None:
    """Against the same input held and delayed, in steps of T/20."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(states, states))
    B, C = rng.normal(size=(states, 2)), rng.normal(size=(2, states))
    period = 0.3
    delay = period * (steps + part / 20)
    found = zoh(StateSpace(A, B, C, np.zeros((2, 2))), period, delay)
    u = rng.normal(size=(12, 2))
    joint = np.zeros((states + 2, states + 2))
    joint[:states] = np.hstack([A, B])
    fine = expm(joint * period / 20)
    x, expected = np.zeros(states), []
    for i in range(12 * 20):
        if i % 20 == 0:
            expected.append(C @ x)
        k = (i - 20 * steps - part) // 20
        x = fine[:states] @ np.concatenate([x, u[k] if k >= 0 else np.zeros(2)])
    z, y = np.zeros(len(found.A)), []
    for v in u:
        y.append(found.C @ z)
        z = found.A @ z + found.B @ v
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-11 * np.abs(expected).max() + 1e-14)


@pytest.mark.parametrize(("rate", "delay"), [(300.0, 0.0), (500.0, 1.3e-3), (2000.0, 2e-3)])
def test_figures_equal_a_dense_grid(rate: float, delay: float) -> None:
    S = loop(1.0 / rate, delay)
    found = sampled_figures(S)
    assert found.stable
    hz = np.unique(
        np.concatenate([np.geomspace(0.01, rate / 2, 20001), 60 + np.linspace(-3, 3, 4001)])
    )
    hz = hz[hz <= rate / 2]
    gain = np.abs(S.response(HZ * hz)[:, 0, 0])
    assert found.sensitivity_peak == pytest.approx(gain.max(), rel=1e-5)
    assert found.sensitivity_peak >= gain.max() * (1 - 1e-9)
    first = int(np.argmax(gain > 2**-0.5))
    assert hz[first - 1] <= found.bandwidth / HZ <= hz[first]
    at = np.abs(S.response(np.array([found.bandwidth]))[0, 0, 0])
    assert at == pytest.approx(2**-0.5, rel=1e-10)


def test_an_unstable_loop_has_no_figures() -> None:
    found = sampled_figures(loop(1.0 / 50.0, 30e-3))
    assert not found.stable
    assert found.spectral_radius > 1.0
    assert np.isnan(found.bandwidth)
    assert not Target(1e9, 0.05, found.bandwidth, 1e9).met(found)


@pytest.mark.parametrize("channels", [1, 2])
def test_a_simulation_measures_the_same_sensitivity(channels: int) -> None:
    period, delay = 3e-3, 4.2e-3
    conversion = Conversion.TUSTIN
    G = zoh(stage(channels), period, delay)
    K = discretise(lead(channels), conversion, period, delay)
    S = closed_loop(G, K).S
    exact = sampled_figures(S)
    found = measure_set([G], K, exact.bandwidth, seed=3)[0]
    assert found.leftover < 1e-6
    np.testing.assert_allclose(found.gain, np.linalg.norm(S.response(found.omega), 2, axis=(1, 2)),
                               rtol=1e-5)  # fmt: skip
    assert found.bandwidth == pytest.approx(exact.bandwidth, rel=1e-4)
    assert found.sensitivity_peak == pytest.approx(exact.sensitivity_peak, rel=1e-3)


def test_figures_of_loops_side_by_side_are_the_wholes() -> None:
    period, delay = 1e-3, 5e-4
    one = sampled_figures(loop(period, delay))
    both = worst_figures([one, sampled_figures(loop(period, 2.0 * delay))])
    K = discretise(lead(), Conversion.LEAD, period, delay)
    slow = discretise(lead(), Conversion.LEAD, period, 2.0 * delay)
    S1 = closed_loop(zoh(stage(), period, delay), K).S
    S2 = closed_loop(zoh(stage(), period, 2.0 * delay), slow).S
    zero = np.zeros((len(S1.A), len(S2.A)))
    whole = sampled_figures(StateSpace(
        np.block([[S1.A, zero], [zero.T, S2.A]]),
        np.block([[S1.B, 0 * S1.B], [0 * S2.B, S2.B]]),
        np.block([[S1.C, 0 * S2.C], [0 * S1.C, S2.C]]), np.eye(2), period=period,
    ))  # fmt: skip
    assert both.sensitivity_peak == pytest.approx(whole.sensitivity_peak, rel=1e-8)
    assert both.bandwidth == pytest.approx(whole.bandwidth, rel=1e-9)
    gone = SampledFigures(False, 1.1, np.nan, np.nan, np.nan)
    assert not worst_figures([one, gone]).stable


@pytest.mark.parametrize("conversion", list(Conversion))
def test_methods_approach_the_continuous_controller(conversion: Conversion) -> None:
    """At low frequency K(z) is K(s), advanced by αT where the lead is on."""
    K, period, delay = lead(), 1e-4, 1e-4
    omega = HZ * np.array([1.0, 5.0, 20.0])
    found = discretise(K, conversion, period, delay).response(omega)[:, 0, 0]
    s = 1j * omega[:, None, None]
    exact = (K.C @ np.linalg.solve(s * np.eye(2) - K.A, K.B + 0j) + K.D)[:, 0, 0]
    advance = 1.5 * period if conversion is Conversion.LEAD else 0.0
    np.testing.assert_allclose(found, exact * np.exp(1j * omega * advance), rtol=2e-3)


@few(max_examples=40)
@given(edge=st.floats(41.0, 1e4), hole=st.floats(0.01, 0.5))
def test_the_needed_rate_lies_above_every_failure(edge: float, hole: float) -> None:
    """A rate in use that fails, though slower ones pass, moves the answer above itself."""
    failing = edge * 10.0**hole

    def met(rate: float) -> bool:
        return rate >= edge and rate != failing

    alone, found = needed_rate(met, 10.0), needed_rate(met, 10.0, also=[failing])
    assert alone is not None
    assert found is not None
    assert edge <= alone <= edge * 1.0011
    assert failing < found <= failing * 1.3
    assert met(nice_rate(alone))
    assert met(nice_rate(found))


@pytest.mark.parametrize(
    ("met", "found"), [(lambda rate: False, None), (lambda rate: rate >= 1234.0, 1234.0)]
)
def test_needed_rate(met: Callable[[float], bool], found: float | None) -> None:
    assert needed_rate(met, 10.0) == (None if found is None else pytest.approx(found, rel=1e-3))


def test_a_simulation_goes_on_from_its_state() -> None:
    G = zoh(stage(), 1e-3, 1e-3)
    K = discretise(lead(), Conversion.LEAD, 1e-3, 1e-3)
    r = np.random.default_rng(0).normal(size=(60, 1, 1))
    whole, _ = simulate(G, K, r)
    first, state = simulate(G, K, r[:25])
    second, _ = simulate(G, K, r[25:], state)
    np.testing.assert_array_equal(whole, np.concatenate([first, second]))
