"""On the machine: feedforward, limits with back-calculation, a start without a jump, moves."""

import json
import re
from dataclasses import replace
from functools import partial
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few, well_conditioned
from oracles.sampled_simulation import simulate
from oracles.structured_text import run as run_text
from test_deploy_code import of_one_channel, random_controller

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.move import simulate as simulate_move
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward
from ccd_casadi.deployment.on_hardware import (
    BACK,
    Electronics,
    OnHardware,
    SimulationOptions,
    hardware_dict,
    move,
    on_hardware,
)
from ccd_casadi.deployment.realisation import (
    Realisation,
    back_calculation,
    difference_equation,
    takeover,
    with_anti_windup,
)
from ccd_casadi.deployment.source_code import vectors
from ccd_casadi.extensions.formats.code_formats import structured_text
from ccd_casadi.lti.loop import Loop, Sampling, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import FREE, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.reporting.moves import way_words
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import json_values

PERIOD = DELAY = 1e-4
CROSSOVER = 2.0 * np.pi * 40.0
PROFILE = setpoint(MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4))


def stage(inputs: int = 1) -> StateSpace:
    """Two masses, 8 and 2 kg, 335 Hz, hardly held and damped; `inputs` of them side by side."""
    k, c = 2.0 * (2.0 * np.pi * 300.0) ** 2, 0.02 * 2.0 * np.pi * 300.0
    M, tie = np.diag([8.0, 2.0]), np.array([[1.0, -1.0], [-1.0, 1.0]])
    held = 0.01 * np.eye(2)
    A = np.block(
        [
            [np.zeros((2, 2)), np.eye(2)],
            [-np.linalg.solve(M, k * tie) - held, -np.linalg.solve(M, c * tie) - held],
        ]
    )
    eye = np.eye(inputs)
    B, C = np.array([[0.0], [0.0], [1 / 8], [0.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
    return StateSpace(np.kron(eye, A), np.kron(eye, B), np.kron(eye, C), np.zeros((inputs, inputs)))


def pid() -> Realisation:
    """PID with a roll-off, as a motion engineer tunes it, by Tustin's rule."""
    w = CROSSOVER
    factors = (
        ([10.0 * w**2 / 3.0, w**3 / 3.0], [1.0, 0.0]),
        ([3.0 / w, 1.0], [1.0 / (3.0 * w), 1.0]),
        ([1.0], [1.0 / (8.0 * w) ** 2, 1.4 / (8.0 * w), 1.0]),
    )
    K = control.ss(*(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1)))
    for zeros, poles in factors:
        K = K * control.ss(control.tf(zeros, poles))
    found = K.sample(PERIOD, "tustin")
    return of_one_channel(StateSpace(found.A, found.B, found.C, found.D, period=PERIOD))


def test_the_setpoint_at_any_time_is_its_own_integral() -> None:
    t = np.linspace(-0.01, 1.2 * PROFILE.duration, 20001)
    r = PROFILE.at(t)
    for k in range(4):
        middle = 0.5 * (r[k + 1, 1:] + r[k + 1, :-1]) * np.diff(t)
        scale = np.abs(r[k]).max()
        np.testing.assert_allclose(np.diff(r[k]), middle, rtol=0, atol=1e-3 * scale)
    assert r[0, 0] == 0.0
    np.testing.assert_allclose(r[:, -1], [0.01, 0, 0, 0, 0], rtol=1e-12, atol=0)


@few(max_examples=20)
@given(seed=st.integers(0, 10**6), inputs=st.integers(1, 3))
def test_feedforward_inverts_the_plant_to_fifth_order(seed: int, inputs: int) -> None:
    rng = np.random.default_rng(seed)
    G, delay = stage(inputs), rng.uniform(0.0, 3e-4)
    T, mix = well_conditioned(rng, len(G.A)), well_conditioned(rng, inputs)
    G = StateSpace(np.linalg.solve(T, G.A @ T), np.linalg.solve(T, G.B @ mix), G.C @ T, G.D)
    F = feedforward(G, PERIOD, delay)
    misses = []
    sampled = zoh(G, PERIOD, delay)
    for w in (200.0, 400.0):
        s = 1j * w
        g = sampled.response(np.array([w]))[0]
        mean = np.sinh(s * PERIOD / 2) / (s * PERIOD / 2)
        ahead = F[0] + mean * sum(F[k] * s**k for k in range(1, 5))
        misses.append(np.abs(g @ ahead - np.eye(inputs)).max())
    assert misses[1] < 2e-3
    assert misses[0] < misses[1] / 2**2.5  # the next term is of third order against the mass
    np.testing.assert_allclose(mix @ F[2], 10.0 * np.eye(inputs), rtol=0, atol=1e-4)


@few(max_examples=40)
@given(seed=st.integers(0, 10**6), inputs=st.integers(1, 3), held=st.booleans())
def test_a_free_body_needs_no_force_for_its_position_and_velocity(
    seed: int, inputs: int, held: bool
) -> None:
    """Modes up to 10^5 times as fast as the slowest, in units that differ from axis to axis."""
    rng = np.random.default_rng(seed)
    n = inputs + 4
    mix, units = well_conditioned(rng, inputs), 10.0 ** rng.uniform(-3.0, 3.0, inputs)
    B = np.vstack([mix, 0.3 * rng.standard_normal((4, inputs))]) / units
    C = np.hstack([np.eye(inputs), 0.3 * rng.standard_normal((inputs, 4))]) * units[:, None]
    omega = np.append(np.full(inputs, 5.0 * held), 10.0 ** rng.uniform(2.0, 7.0, 4))
    matrices = np.eye(n), np.zeros((n, n)), np.diag(omega**2), B, C
    none: Any = tuple(np.zeros((0, *part.shape)) for part in matrices)
    plant = Mechanics(*matrices, 0.01, none)
    G = scale_plant(modal_plant(plant, FREE), 1.0, bare=True).plant_si()
    F = feedforward(G, PERIOD, DELAY)
    assert F[2].all()
    if held:
        scale = np.outer(units, units)
        stiffness = np.linalg.inv(C @ (B / omega[:, None] ** 2)) * scale
        most = 1e-6 * np.abs(stiffness).max()
        np.testing.assert_allclose(F[0] * scale, stiffness, rtol=0, atol=most)
    else:
        assert not F[0].any()
        assert not F[1].any()


def test_a_plant_that_holds_no_position_has_no_feedforward() -> None:
    G = StateSpace(
        np.diag([-1.0, -2.0]), np.ones((2, 1)), np.array([[1.0, -2.0]]), np.zeros((1, 1))
    )
    with pytest.raises(UserError, match="zero at 0 Hz"):  # 1/(s+1) - 2/(s+2) = -s/(...)
        feedforward(G, PERIOD, DELAY)


@few(max_examples=30)
@given(seed=st.integers(0, 10**6), inputs=st.integers(1, 3), unstable=st.booleans())
def test_states_follow_a_stable_matrix_beyond_the_limit(
    seed: int, inputs: int, unstable: bool
) -> None:
    K = random_controller(seed, 2, 2, inputs)
    if unstable:
        K = replace(K, A=1.002 * K.A / np.abs(np.linalg.eigvals(K.A)).max())
    size = np.abs(K.response(np.array([300.0]))).max()
    for limit in (1e-3 * size, 10.0 * size):
        L = back_calculation(K, limit, 300.0)
        assert np.abs(np.linalg.eigvals(K.A - L @ K.C)).max() < 1.0


def test_nothing_changes_between_the_limits() -> None:
    K = pid()
    e = 1e-6 * np.random.default_rng(0).normal(size=(300, 1))
    u = difference_equation(K, e)
    wide = with_anti_windup(replace(K, saturation=1.01 * float(np.abs(u).max())), CROSSOVER)
    np.testing.assert_array_equal(difference_equation(wide, e), u)
    narrow = with_anti_windup(replace(K, saturation=0.5 * float(np.abs(u).max())), CROSSOVER)
    only_clipped = np.clip(u, -(narrow.saturation or 0.0), narrow.saturation)
    assert np.abs(difference_equation(narrow, e) - only_clipped).max() > 0.0


@few(max_examples=30)
@given(seed=st.integers(0, 10**6), inputs=st.integers(1, 2))
def test_a_takeover_begins_with_the_force_that_was_there(seed: int, inputs: int) -> None:
    K = random_controller(seed, 2, 2, inputs)
    rng = np.random.default_rng(seed)
    e, u = 1e-6 * rng.normal(size=inputs), rng.normal(size=inputs)
    x = takeover(K) @ np.concatenate([e, u])
    np.testing.assert_allclose(K.C @ x + K.D @ e, u, rtol=0, atol=1e-9 * (1 + np.abs(u).max()))


def test_an_integrator_takes_over_for_good() -> None:
    K = pid()
    x = takeover(K.system) @ np.array([0.0, 7.0])
    u = difference_equation(K, np.zeros((500, 1)), start=x.tolist())
    np.testing.assert_allclose(u, 7.0, rtol=1e-9)


@pytest.mark.parametrize("snap", [1e4, 1e12])
@pytest.mark.parametrize("held", [0.0, 1.6e5])
def test_the_deployed_move_is_that_of_solve_and_follows_a_jerk_that_jumps(
    snap: float, held: float
) -> None:
    """One force ahead for both. On an exact plant little is left, also where the jerk jumps between
    two instants: 0.2 nm; by values at the instants 10 mm and more of drift."""
    M, D, K = 10.0, 0.1 * np.sqrt(held * 10.0), held
    G = StateSpace(np.array([[0.0, 1.0], [-K / M, -D / M]]), np.array([[0.0], [1.0 / M]]),
                   np.array([[1.0, 0.0]]), np.zeros((1, 1)))  # fmt: skip
    profile, F = setpoint(MoveLimits(0.01, 0.2, 5.0, 500.0, snap)), feedforward(G, PERIOD, DELAY)
    of_deploy = move(G, pid(), DELAY, profile, forward=F)
    loop = Loop(G, pid().system, Sampling(1.0 / PERIOD, 1e6 * DELAY))
    of_solve = simulate_move(loop, profile, axis=0, forces=F[:, :, 0], window=1e-6,
                             bandwidth_hz=40.0)  # fmt: skip
    count = min(len(of_deploy.time), len(of_solve.time))
    np.testing.assert_allclose(
        of_deploy.error[:count, 0], of_solve.error[:count], rtol=0.0, atol=1e-12
    )
    assert of_deploy.peak_error < 1e-9


def made(K: Realisation, **also: object) -> Move:
    return move(stage(), K, DELAY, PROFILE, **also)  # type: ignore[arg-type]


def test_an_unlimited_move_is_the_linear_loop() -> None:
    K, plant = pid(), zoh(stage(), PERIOD, DELAY)
    found = made(K)
    errors, _ = simulate(plant, K.system, found.position[:, None, None])
    np.testing.assert_allclose(found.error, errors[:, :, 0], rtol=0, atol=1e-9 * 1e-2)
    for delay in (0.0, 0.123 * PERIOD, 1.77 * PERIOD):  # the delay is that which is given
        errors, _ = simulate(zoh(stage(), PERIOD, delay), K.system,
                             found.position[:, None, None])  # fmt: skip
        exact = move(stage(), K, delay, PROFILE).error
        np.testing.assert_allclose(exact, errors[:, :, 0], rtol=0, atol=1e-9 * 1e-2)
    late = made(K, hardware=Electronics(jitter=PERIOD / SimulationOptions().parts))
    np.testing.assert_array_equal(made(K, hardware=Electronics()).error, found.error)
    assert 0.0 < np.abs(late.error - found.error).max() < 1e-2 * found.peak_error


def test_a_limited_move_ends_as_fast_and_without_a_cycle() -> None:
    K, F = pid(), feedforward(stage(), PERIOD, DELAY)
    assert made(K, forward=F).peak_error < 0.01 * made(K).peak_error
    free = made(K)
    limit = 0.9 * float(np.abs(free.force).max())
    clipped = replace(K, saturation=limit)
    held = made(with_anti_windup(clipped, CROSSOVER))
    assert held.saturated > 0.05
    assert held.settled <= 1.2 * free.settled
    assert held.last_error(0.25) < 1e-7  # of a window of 1e-6
    assert held.settled <= made(clipped).settled
    assert np.abs(held.force).max() <= limit


def test_steps_of_sensor_and_force_bound_what_is_left() -> None:
    found = made(pid(), hardware=Electronics(sensor_step=1e-8, force_step=1e-3))
    assert 0.0 < found.last_error(0.25) < 1e-7
    np.testing.assert_allclose(found.force / 1e-3, np.round(found.force / 1e-3), atol=1e-6)


@pytest.mark.parametrize(
    ("pairs", "reals", "inputs", "limit"), [(0, 0, 1, None), (2, 1, 1, 5e-3), (3, 2, 3, 5e-3)]
)
def test_structured_text_is_the_c_code_line_by_line(
    pairs: int, reals: int, inputs: int, limit: float | None
) -> None:
    K = of_one_channel(random_controller(5, pairs, reals, inputs), limit)
    found = with_anti_windup(K, 500.0)
    errors, forwards, first, forces = vectors(found)
    text = structured_text(found, title="x *) y", delay=1e-4, verified=True)
    calls = [
        {"E": list(e), "F": list(f), "U_BEFORE": list(first), "TAKEOVER": k == 0}
        for k, (e, f) in enumerate(zip(errors, forwards, strict=True))
    ]
    got = np.array([answer["U"] for answer in run_text(text, calls)])
    np.testing.assert_array_equal(got, forces)
    rest = run_text(text, [*calls, {"RESET": True, "TAKEOVER": False}])[-1]["U"]
    again = difference_equation(found, errors[-1:], forwards[-1:])[0]
    np.testing.assert_array_equal(rest, again)


@few(max_examples=50)
@given(
    size=st.integers(4, 60), data=st.data(), value=st.sampled_from([np.nan, np.inf, -np.inf]),
    channels=st.integers(1, 2),
)  # fmt: skip
def test_a_simulation_that_is_lost_settles_nowhere(
    size: int, data: st.DataObject, value: float, channels: int
) -> None:
    """At whichever instant; without it the same move has settled from the start."""
    error = np.zeros((size, channels))
    time = np.arange(size, dtype=float)
    made = Move(time, time, error, error, False, 2.0, 1e-6)
    assert made.finite
    assert made.settled == 0.0
    error[data.draw(st.integers(0, size - 1)), data.draw(st.integers(0, channels - 1))] = value
    assert not made.finite
    assert made.settled == np.inf
    assert made.settling == np.inf
    assert "not known" in way_words("a way", [made])


@few(max_examples=60)
@given(period=st.floats(1e-6, 1.0), times=st.floats(0.0, 3.0))
def test_a_jitter_is_at_most_a_period_and_the_message_names_one_that_is_accepted(
    period: float, times: float
) -> None:
    hardware = Electronics(jitter=times * period)
    if hardware.jitter <= period * (1.0 + 1e-9):
        hardware.require_in_order(period)
        return
    with pytest.raises(UserError, match=r"--jitter .*more than a period") as raised:
        hardware.require_in_order(period)
    most = float(re.search(r"at most (\S+) s", str(raised.value))[1])  # type: ignore[index]
    assert 0.99 * period < most
    Electronics(jitter=most).require_in_order(period)


def test_a_move_within_a_limit_settles_fails_or_is_not_known() -> None:
    """The limited move of the loop as it is deployed decides, with the electronics where given."""
    limits = MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4)
    G, K = stage(), pid()
    known = partial(on_hardware, G, delay=DELAY, bandwidth=CROSSOVER, limits=limits, window=1e-4,
                    options=replace(SimulationOptions(), shares=()))  # fmt: skip
    unlimited = known(K)
    assert unlimited.limited_entry is None
    peak = float(unlimited.ways["with feedforward"].peak_force.max())

    def entry(share: float, **more: Any) -> dict[str, Any]:
        found = known(with_anti_windup(replace(K, saturation=share * peak), CROSSOVER), **more)
        assert found.limited_entry is not None
        return found.limited_entry

    wide, narrow = entry(1.1), entry(0.2)
    assert (wide["state"], narrow["state"]) == ("passed", "failed")
    assert wide["settled"] < wide["time"]
    assert narrow["settled"] is None
    assert narrow["left"] > 1e-4
    assert narrow["settles_unlimited"]
    coarse = Electronics(sensor_step=1e-3)  # ten times the window
    assert entry(1.1, hardware=coarse)["state"] == "failed"


def test_a_move_that_leaves_double_precision_is_not_known() -> None:
    """An unstable plant whose limit is too small to hold it."""
    rate = 2000.0
    A = np.array([[rate, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    B, C = np.array([[1.0], [0.0], [1.0]]), np.array([[1.0, 1.0, 0.0]])
    G = StateSpace(A, B, C, np.zeros((1, 1)))
    K = with_anti_windup(replace(pid(), saturation=1e-6), CROSSOVER)
    made = move(G, K, DELAY, PROFILE)
    assert not made.finite
    found = OnHardware(PROFILE, 1e-6, None, {"feedback alone": made, BACK: made}, np.nan, 1e-6)
    entry = found.limited_entry
    assert entry is not None
    assert (entry["state"], entry["left"]) == ("unknown", None)
    assert json.dumps(json_values(entry), allow_nan=False)
    assert json.dumps(json_values(hardware_dict(found)), allow_nan=False)
