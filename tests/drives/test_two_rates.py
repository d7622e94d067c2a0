"""Cascades whose position loop is slower: lifting against a simulation of every instant."""

from collections.abc import Callable
from dataclasses import replace

import control
import numpy as np
import pytest
from bench import RATE, SLOW, bounds, cascade, uncertain
from oracles import drive_simulation as oracle

from ccd_casadi.extensions.drives.cascade_rows import SearchOptions
from ccd_casadi.extensions.drives.drive_design import DriveOptions, design_drive
from ccd_casadi.extensions.drives.two_rates import judge_two_rates, lift
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.norms import hinf_norm

PLANT = uncertain().plant(np.array([0.01])).plant_si()
SYSTEM = zoh(PLANT, RATE.period, RATE.delay)
HELD = control.c2d(control.ss(PLANT.A, PLANT.B, PLANT.C, PLANT.D), RATE.period, "zoh")


def simulated(
    values: np.ndarray, slower: int, count: int, position: Callable[[int], float],
    motor: Callable[[int], float] = lambda k: 0.0, x0: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Signals behind both sensors (count, 2), disturbed there; the plant is three calls late."""
    made = [oracle.float_filter([float(c) for c in oracle.coefficients(tuple(one[:2]),
            tuple(one[2:]), RATE.rate_hz)]) for one in values[3:].reshape(-1, 4)]  # fmt: skip
    step = oracle.controller(tuple(values[:3]), made[1:], made[:1], RATE.rate_hz, float, slower)
    x, queue, found = np.full((4, 1), x0), [0.0] * 3, []
    for k in range(count):
        y = (HELD.C @ x)[:, 0] + [motor(k), position(k)]
        found.append(y)
        queue.append(step(0.0, y[1], y[0]))
        x = HELD.A @ x + HELD.B * queue.pop(0)
    return np.array(found)


def drawn(seed: int) -> tuple[np.ndarray, int]:
    rng = np.random.default_rng(seed)
    spread = np.exp(rng.uniform(-0.5, 2.2, 3))
    values = SLOW * np.concatenate([spread, np.exp(rng.uniform(-0.3, 0.3, len(SLOW) - 3))])
    return values, int(rng.integers(2, 9))


@pytest.mark.parametrize("seed", range(10))
def test_a_loop_is_stable_as_its_simulation_is(seed: int) -> None:
    for number in range(5 * seed, 5 * seed + 5):
        values, slower = drawn(number)
        loop = lift(replace(cascade(), slower=slower), values, SYSTEM)
        count = 2400
        if abs(np.log(loop.radius)) * count < 2.0:  # neither is clear
            continue
        y = np.abs(simulated(values, slower, 2 * count, lambda k: 0.0, x0=1e-3)).max(axis=1)
        first, last = y[:count].max(), y[count:].max()
        assert (last < first) == (loop.radius < 1.0), (number, loop.radius)


@pytest.mark.parametrize("seed", range(4))
def test_S_is_what_a_sine_of_the_simulation_becomes(seed: int) -> None:
    slower = seed + 2
    own = replace(cascade(), slower=slower)
    loop = lift(own, SLOW, SYSTEM)
    assert loop.radius < 1.0
    turns, count = 40, 4000 * slower
    omega = 2.0 * np.pi * turns / (count * RATE.period)
    wave = np.exp(1j * omega * RATE.period * np.arange(2 * count))
    y = simulated(SLOW, slower, 2 * count, lambda k: wave.real[k])[count:, 1]
    read = slice(0, None, slower)  # the position's sensor counts where it is read
    found = 2.0 * (y * wave[count:].conj())[read].mean()
    np.testing.assert_allclose(found, loop.fundamental(1, np.array([omega]))[0], rtol=1e-6)
    y = simulated(SLOW, slower, 2 * count, lambda k: 0.0, lambda k: wave.real[k])[count:, 0]
    found = 2.0 * (y * wave[count:].conj()).mean()
    np.testing.assert_allclose(found, loop.fundamental(0, np.array([omega]))[0], rtol=1e-6)


@pytest.mark.parametrize("place", [0, None])
def test_a_factor_within_the_margin_keeps_the_loop_stable(place: int | None) -> None:
    """|1 + f λ(L)| > 0 for |f - 1| < 1/|S|: real f at the actuator is one of Kp."""
    own = replace(cascade(), slower=4)
    loop = lift(own, SLOW, SYSTEM)
    S = loop.sensitivity(place, np.linspace(1.0, np.pi / RATE.period, 4000)).max()
    for f in np.linspace(1.0 - 1.0 / S, 1.0 + 1.0 / S, 9)[1:-1]:
        into = SYSTEM.B * f if place is None else SYSTEM.B
        out = SYSTEM.C * (np.array([[f], [1.0]]) if place == 0 else 1.0)
        assert lift(own, SLOW, replace(SYSTEM, B=into, C=out)).radius < 1.0
    far = SYSTEM.B * 40.0
    assert lift(own, SLOW, replace(SYSTEM, B=far)).radius > 1.0


@pytest.mark.parametrize("slower", [2, 5])
def test_no_course_is_raised_by_more_than_the_norm(slower: int) -> None:
    loop = lift(replace(cascade(), slower=slower), SLOW, SYSTEM)
    norm, _ = hinf_norm(loop.places[0])
    rng = np.random.default_rng(slower)
    for tone in (0.02, 0.1, 0.4):
        count = 1200
        d = np.zeros(4 * count)
        k = np.arange(count)
        alias = np.sin((2.0 * np.pi / slower - tone) * k)
        d[:count] = rng.standard_normal() * np.sin(tone * k) + alias
        y = simulated(SLOW, slower, 4 * count, lambda k: 0.0, lambda k, d=d: d[k])[:, 0]
        assert np.linalg.norm(y) <= norm * np.linalg.norm(d) * (1.0 + 1e-9)


def test_of_one_rate_it_is_the_loop_that_does_not_change() -> None:
    own, omega = cascade(), np.geomspace(10.0, 3000.0, 30)
    loop = lift(own, SLOW, SYSTEM)
    L = SYSTEM.sweep(omega)[:, :, 0].T * own.state_space(SLOW).sweep(omega)[:, 0].T
    for place, above in ((0, 1.0 + L[1]), (1, 1.0 + L[0]), (None, 1.0)):
        np.testing.assert_allclose(loop.fundamental(place, omega), above / (1.0 + L.sum(axis=0)),
                                   rtol=1e-7)  # fmt: skip


def test_of_one_sensor_both_paths_are_broken() -> None:
    own, omega = replace(cascade(), position=0, velocity=0, sensors=1), np.geomspace(10.0, 3e3, 20)
    system = replace(SYSTEM, C=SYSTEM.C[:1], D=SYSTEM.D[:1])
    L = system.sweep(omega)[:, 0, 0] * own.state_space(SLOW).sweep(omega)[:, 0, 0]
    one = lift(own, SLOW, system).fundamental(0, omega)
    np.testing.assert_allclose(one, 1.0 / (1.0 + L), rtol=1e-7)
    slower = lift(replace(own, slower=2), SLOW, system).fundamental(0, omega[:5])
    np.testing.assert_allclose(slower, one[:5], rtol=0.2)  # half a period of 125 µs at 10 to 33 Hz


def test_of_one_sensor_S_low_is_of_the_sine_and_not_of_its_aliases() -> None:
    own = replace(cascade(), position=0, velocity=0, sensors=1, slower=2)
    plant = replace(PLANT, C=PLANT.C[:1], D=PLANT.D[:1])
    limits = bounds(4.0, S_low=0.3, channels=(), error=None)
    found = judge_two_rates(own, SLOW, [plant], limits, RATE)
    system = zoh(plant, RATE.period, RATE.delay)
    fast = lift(replace(own, slower=1), SLOW, system).fundamental(0, np.array([limits.omega_low]))
    assert found.worst["S_LOW"] == pytest.approx(abs(fast[0]) / 0.3, rel=0.1)


def test_what_is_exceeded_is_named() -> None:
    own = replace(cascade(), slower=4)
    good = judge_two_rates(own, SLOW, [PLANT], bounds(4.0, S_low=0.9), RATE)
    assert good.passed, good.words
    assert good.bandwidth > 0.0
    tight = judge_two_rates(own, SLOW, [PLANT], bounds(1.05, S_low=0.9), RATE)
    assert not tight.passed
    assert "S_MAX" in tight.words
    fast = SLOW * np.where(np.arange(len(SLOW)) == 1, 30.0, 1.0)
    assert "unstable" in judge_two_rates(own, fast, [PLANT], bounds(4.0), RATE).words


@pytest.mark.slow
def test_a_design_of_two_rates_keeps_its_bounds_on_every_plant() -> None:
    few = DriveOptions(search=SearchOptions(starts=1, stages=((0.4, 20),)), draws=20)
    own = replace(cascade("sinamics_s120"), slower=4)
    found = design_drive(own, uncertain(), bounds(), RATE, options=few)
    assert found.certificate.passed, found.certificate.words
    assert found.proof.unproven  # of a set there is no proof
    assert found.bandwidth > 0.0
