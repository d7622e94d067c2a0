"""S between the samples: against a simulation, and by what is known of it at both ends."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.norms import held_between, peak_between, sensitivity_between
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace, strictly_proper


def plant(frequency: float, damping: float = 0.02, sensors: int = 1) -> StateSpace:
    """Two masses of 1 kg with a spring, free; the force and the first sensor on the first."""
    k = 0.5 * (2 * np.pi * frequency) ** 2
    c = 2.0 * damping * np.sqrt(0.5 * k)
    stiffness, losses = (g * np.array([[-1.0, 1.0], [1.0, -1.0]]) for g in (k, c))
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [stiffness, losses]])
    return strictly_proper(A, np.array([[0.0], [0.0], [1.0], [0.0]]), np.eye(4)[:sensors])


def lead(bandwidth: float, sensors: int = 1) -> StateSpace:
    """K = 2 ω² (1/3 + 2 s/(s + 6 ω)), ω = 2π bandwidth, of the mean of the sensors."""
    w, one = 2 * np.pi * bandwidth, np.ones((1, sensors)) / sensors
    C = np.array([[-24.0 * w**3]])
    return StateSpace(np.array([[-6.0 * w]]), one, C, 14.0 / 3.0 * w**2 * one)


@settings(max_examples=15, deadline=None)
@given(
    frequency=st.floats(30.0, 900.0),
    delay=st.floats(0.0, 2500.0),
    times=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=3),
)
def test_the_held_plant_between_the_samples_is_that_of_a_simulation(
    frequency: float, delay: float, times: list[float]
) -> None:
    T, G = 1e-3, plant(frequency)
    system = held_between(G, T, 1e-6 * delay, [T * share for share in times])
    u = np.random.default_rng(0).normal(size=6)
    x, found = np.zeros(len(system.A)), []
    for force in u:
        found.append(system.C @ x + system.D[:, 0] * force)
        x = system.A @ x + system.B[:, 0] * force

    def slope(t: float, y: np.ndarray, force: float) -> np.ndarray:
        return np.asarray(G.A @ y + G.B[:, 0] * force)

    changes = T * np.arange(len(u)) + 1e-6 * delay
    for k, values in enumerate(found):
        for share, value in zip(times, values, strict=True):
            end, y = T * (k + share), np.zeros(4)
            for force, a, b in zip(u, changes, [*changes[1:], np.inf], strict=True):
                if a < end:
                    y = solve_ivp(slope, (a, min(b, end)), y, "DOP853", args=(force,),
                                  rtol=1e-10, atol=1e-14).y[:, -1]  # fmt: skip
            assert value == pytest.approx(float(y[0]), rel=1e-6, abs=1e-12)


@settings(max_examples=20, deadline=None)
@given(frequency=st.floats(60.0, 2000.0), rate=st.floats(400.0, 4000.0), late=st.floats(0.0, 0.9))
def test_s_between_begins_and_ends_a_period_with_s_of_the_instants(
    frequency: float, rate: float, late: float
) -> None:
    loop = Loop(plant(frequency), lead(12.0), Sampling(rate, 1e6 * late / rate))
    omega = np.geomspace(1.0, 0.99 * np.pi * rate, 40)
    S = loop.sensitivity(omega)
    assert np.allclose(sensitivity_between(loop, omega)[0], S, rtol=1e-6, atol=1e-9)
    T = 1.0 / rate
    end = held_between(loop.plant, T, late * T, [0.0, T]).response(omega)
    assert np.allclose(end[:, 1, 0], np.exp(1j * omega * T) * end[:, 0, 0], rtol=1e-6, atol=0.0)


def test_what_the_hold_does_between_the_samples_fades_as_the_rate_grows() -> None:
    """At eight samples in a period of ω_b it is a thousandth of S, at 1,600 nothing."""
    slow = Loop(plant(120.0, 1e-3), lead(12.0), Sampling(100.0, 100.0))
    fast = Loop(plant(120.0, 1e-3), lead(12.0), Sampling(20000.0, 100.0))
    found, close = peak_between(slow), peak_between(fast)
    assert slow.stable
    assert found.at_instants == pytest.approx(slow.peak, rel=1e-5)
    assert found.peak > 1.001 * found.at_instants
    assert 0.0 < found.share < 1.0
    assert fast.stable
    assert close.peak == pytest.approx(close.at_instants, rel=1e-6)


def test_of_two_sensors_the_one_that_counts_is_read() -> None:
    loop = Loop(plant(200.0, sensors=2), lead(12.0, sensors=2), Sampling(2000.0, 300.0))
    at = BreakPoint("first", (1.0, 0.0), (1.0, 0.0))
    own = Loop(loop.plant, loop.controller, loop.sampling, at=(at,))
    omega = np.geomspace(1.0, 6000.0, 30)
    found = sensitivity_between(own, omega, at)
    assert found.shape == (8, 30, 1, 1)
    assert np.allclose(found[0], own.sensitivity(omega), rtol=1e-6)
    assert peak_between(own).at_instants == pytest.approx(own.peak, rel=1e-4)
