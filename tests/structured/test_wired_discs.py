"""Enclosures of modes behind actuators and sensors against the matrices of the whole chain."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve

from ccd_casadi.fixed_structure.boxes import Boxes, Chart, axis_of
from ccd_casadi.fixed_structure.discs import discs_of
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.lti.wiring import Filters, Wiring
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.plant import Mechanics

HZ = 2.0 * np.pi
WIRING = Wiring(Filters((200.0,), (500.0,), (0.7,)), Filters((300.0,), (800.0,), (0.3,)))
RUNS = (None, Sampling(2000.0, 0.0), Sampling(2000.0, 600.0))
UNIT = 1000.0


def two_masses(ground: float) -> Mechanics:
    """3 kg driven, 1 kg on a spring; `ground` in N/m holds or drives away the former."""
    k = 2e5
    K = np.array([[k + ground, -k], [-k, k]])
    D = 1e-4 * k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    M, B, C = np.diag([3.0, 1.0]), np.array([[1.0], [0.0]]), np.array([[1.0, 0.3]])
    none = tuple(np.zeros((0, *part.shape)) for part in (M, D, K, B, C))
    if ground:
        return Mechanics(M, 0.0 * D, K, B, C, 0.01, none, WIRING)
    return Mechanics(M, D, K, B, C, None, none, WIRING)


def held(G: StateSpace, run: Sampling, omega: float) -> complex:
    """The response of hold, delay and plant at e^{jωT} by matrix exponentials."""
    T, n = run.period, len(G.A)
    whole = int(run.delay / T + 1e-9)
    rest = run.delay - whole * T
    A, B = np.block([[G.A, G.B], [np.zeros((1, n + 1))]]), np.zeros((n, 1))
    z = np.exp(1j * omega * T)
    first, late = expm(A * (T - rest)), expm(A * rest)[:n, n:]
    B = first[:n, n:] / z**whole + first[:n, :n] @ late / z ** (whole + 1)
    return complex((G.C @ solve(z * np.eye(n) - expm(G.A * T), B))[0, 0])


def plain(G: StateSpace, omega: float) -> complex:
    return complex((G.C @ solve(1j * omega * np.eye(len(G.A)) - G.A, G.B + 0j))[0, 0])


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("ground", [5e4, 0.0, -5e4])
def test_discs_hold_the_plant_behind_its_wiring(ground: float, run: Sampling | None) -> None:
    """Points of boxes lie in the sum of the discs; of a box that is one point these are small."""
    uncertain = UncertainPlant((two_masses(ground),), 1e5, resonance_shift=0.05, gain=0.1)
    modes, rng = modal_sum(uncertain, 0, UNIT), np.random.default_rng(5)
    assert modes is not None
    low_pass = tuple((WIRING.poles(1, 1) / UNIT).tolist())
    assert len(low_pass) == 6
    period, delay = (None, 0.0) if run is None else (UNIT * run.period, UNIT * run.delay)
    count, scale = 40, modes.drive[:, 0] * modes.reading[:, 0]
    for width in (0.0, 0.002, 0.03):
        w = np.geomspace(1e-2, 0.99 * (np.pi if run else 1.0), count)
        middle = rng.uniform(-0.04, 0.04, (2, count))
        low, high = (np.array([w * (1.0 + width * up), *(middle + width * 0.1 * (up - 0.5))])
                     for up in (0.0, 1.0))  # fmt: skip
        chart = Chart.LOW if run is None else Chart.SAMPLED
        axis = axis_of(Boxes(np.full(count, chart), low, high), period, delay, low_pass=low_pass)
        loop, free, _ = discs_of(modes, uncertain.names, low[1:], high[1:], axis, True)
        at = low + rng.uniform(0.0, 1.0, low.shape) * (high - low)
        for k in range(count):
            omega = at[0, k] * (UNIT if run is None else 1.0 / run.period)
            (G,) = uncertain.as_written([(0, at[1:, k])])
            exact = plain(G, omega) if run is None else held(G, run, omega)
            moved = (1.0 + at[2, k]) * plain(G.mechanics, omega)  # of a force, that is held as u
            for discs, value in ((loop, exact), (free, moved)):
                off = abs(value - discs.middle[:, k] @ scale)
                radius = discs.radius[:, k] @ np.abs(scale)
                assert off <= radius * (1.0 + 1e-9) + 1e-9 * abs(value)
                if width == 0.0:
                    assert radius <= 1e-6 * abs(value) + 1e-13


@pytest.mark.parametrize("run", RUNS)
def test_free_bodies_at_rest_are_enclosed_times_y_squared(run: Sampling | None) -> None:
    uncertain = UncertainPlant((two_masses(0.0),), 1e5, gain=0.1)
    modes = modal_sum(uncertain, 0, UNIT)
    assert modes is not None
    (body,) = np.flatnonzero(modes.rigid)
    low_pass = tuple((WIRING.poles(1, 1) / UNIT).tolist())
    period, delay = (None, 0.0) if run is None else (UNIT * run.period, UNIT * run.delay)
    w = np.geomspace(1e-3, 0.1, 20)
    boxes = Boxes(np.full(20, Chart.LOW if run is None else Chart.SAMPLED), w[None], w[None])
    axis = axis_of(boxes, period, delay, True, low_pass)
    none = np.zeros((0, 20))
    loop, free, _ = discs_of(modes, (), none, none, axis, True)
    mechanics = Mechanics(*(np.array([[x]]) for x in (1.0, 0.0, 0.0, 1.0, 1.0)), None,
                          tuple(np.zeros((0, 1, 1)) for _ in range(5)), WIRING)  # fmt: skip
    G = as_written(mechanics)
    for k in range(20):
        omega = w[k] * (UNIT if run is None else 1.0 / run.period)
        y = 1j * w[k] if period is None else 2j / period * np.sin(w[k] / 2.0)
        exact = plain(G, omega) if run is None else held(G, run, omega)
        for discs, value in ((loop, exact), (free, plain(G.mechanics, omega))):
            value = value * (y * UNIT) ** 2
            assert abs(discs.middle[body, k] - value) <= discs.radius[body, k] + 1e-9
            assert discs.radius[body, k] < 1e-6


def test_channels_that_differ_have_no_common_poles() -> None:
    assert Wiring(Filters((200.0, 300.0))).poles(2, 2) is None
    assert Wiring(Filters((200.0, 200.0))).poles(2, 2) is not None
    assert replace(WIRING, sensor=Filters()).poles(1, 1) is not None
