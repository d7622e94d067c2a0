"""The fourth-order setpoint, and the loop in a real move, against other ways to them."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import control
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import few, random_plant

from ccd_casadi.analysis import LIMITS, MoveLimits
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward_of
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.discretise import Conversion, discretise
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.robust import move_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "linear_motor_axis" / "case.toml"

# ---- the setpoint -------------------------------------------------------------------------------


def flown(profile: Setpoint) -> tuple[np.ndarray, np.ndarray]:
    """Times, and (position, velocity, acceleration, jerk) there, by the intervals' polynomials."""
    state, now = np.zeros(4), 0.0
    times, states = [0.0], [state]
    for span, snap in zip(profile.durations, profile.snaps, strict=True):
        for t in np.linspace(0.0, span, 9)[1:]:
            p, v, a, j = state
            states.append(
                np.array([
                    p + v * t + a * t**2 / 2 + j * t**3 / 6 + snap * t**4 / 24,
                    v + a * t + j * t**2 / 2 + snap * t**3 / 6,
                    a + j * t + snap * t**2 / 2,
                    j + snap * t,
                ])
            )  # fmt: skip
            times.append(now + t)
        state, now = states[-1], now + span
    return np.array(times), np.array(states)


positive = st.floats(1e-3, 1e3)


@given(positive, positive, positive, positive, positive)
@example(stroke=577.0, v=0.004, a=1.0, j=343.0, s=848.0)  # 40 hours at one velocity
@few(max_examples=100)
def test_a_setpoint_arrives_at_rest_within_its_bounds(
    stroke: float, v: float, a: float, j: float, s: float
) -> None:
    limits = MoveLimits(stroke, v, a, j, s)
    profile = setpoint(limits)
    assert (profile.durations >= 0.0).all()
    _, states = flown(profile)
    bounds = np.array([stroke, v, a, j])
    # a last digit of acceleration, integrated over the whole move: 0.8 of it was met
    T, digit = profile.duration, 2.0 * np.finfo(float).eps
    drift = digit * np.array([profile.acceleration * T**2, profile.acceleration * T, 0.0, 0.0])
    assert (np.abs(states) <= bounds * (1.0 + 1e-9) + drift).all()
    reached = np.abs(states).max(axis=0)
    end = np.array([stroke, 0.0, 0.0, 0.0])
    assert (np.abs(states[-1] - end) <= 1e-8 * max(1.0, *reached) + drift).all()
    met = np.array([profile.velocity, profile.acceleration, profile.jerk])
    assert (np.abs(reached[1:] - met) <= 1e-9 * met + drift[1:]).all()


@given(st.tuples(positive, positive, positive, positive, positive), st.integers(1, 4))
@few(max_examples=50)
def test_more_room_never_takes_longer(values: Sequence[float], which: int) -> None:
    wider = list(values)
    wider[which] *= 1.5
    before, after = setpoint(MoveLimits(*values)), setpoint(MoveLimits(*wider))
    assert after.duration <= before.duration * (1.0 + 1e-9)


def test_a_setpoint_by_hand() -> None:
    """100 m/s³ in 10 ms of snap, 2 m/s² after 10 ms more, 0.1 m/s after 20 ms more, 0.01 m."""
    profile = setpoint(MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4))
    assert profile.durations[:8] == pytest.approx(
        [0.01, 0.01, 0.01, 0.02, 0.01, 0.01, 0.01, 0.02], rel=1e-9
    )
    assert profile.duration == pytest.approx(0.18, rel=1e-9)


def test_the_shortest_of_moves_has_snap_alone() -> None:
    """8 s t⁴ = stroke: eight equal pieces."""
    profile = setpoint(MoveLimits(1e-6, 1e3, 1e3, 1e3, 1.0))
    t = (1e-6 / 8.0) ** 0.25
    assert profile.durations[profile.durations > 1e-12] == pytest.approx([t] * 8, rel=1e-6)


# ---- the move ------------------------------------------------------------------------------------


def rigid_loop(mass: float, gain: float, zeta: float) -> tuple[StateSpace, StateSpace]:
    """A free mass, and a lead with roll-off that holds it."""
    plant = StateSpace(
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.array([[0.0], [1.0 / mass]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
    )
    lead = control.ss(control.tf([2 * zeta * np.sqrt(gain * mass), gain], [1.0 / 600.0, 1.0]))
    return plant, StateSpace(lead.A, lead.B, lead.C, lead.D)


def test_a_mass_driven_by_its_own_feedforward_has_no_error() -> None:
    plant, controller = rigid_loop(3.0, 3e4, 0.7)
    loop = Loop(plant, controller)
    profile = setpoint(MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4))
    ahead = feedforward_of(loop, 0)
    move = simulate(loop, profile, axis=0, forces=ahead, window=1e-9, bandwidth_hz=15.0)
    assert move.peak_error < 1e-13
    assert move.settling == 0.0
    assert move.peak_force[0] == pytest.approx(3.0 * profile.acceleration, rel=1e-3)
    assert move.duration == pytest.approx(profile.duration)


def test_a_move_against_python_control() -> None:
    """forced_response on a fine grid, the setpoint held linear between its points."""
    plant, controller = rigid_loop(3.0, 3e4, 0.7)
    loop = Loop(plant, controller)
    profile = setpoint(MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4))
    move = simulate(loop, profile, axis=0, forces=None, window=1e-7, bandwidth_hz=15.0)
    dense = np.linspace(0.0, 0.36, 20001)
    times, states = flown(profile)
    r = np.interp(dense, times, states[:, 0])
    fine = np.interp(dense, move.time, move.position)  # of the same setpoint, closer points
    assert r == pytest.approx(fine, abs=3e-6)
    system = control.ss(loop.closed.A, loop.closed.B_r, -loop.closed.C_y, np.ones((1, 1)))
    error = control.forced_response(system, dense, fine).outputs
    assert np.interp(dense, move.time, move.error) == pytest.approx(error, abs=2e-7)
    inside = np.abs(move.error) <= 1e-7
    at = move.duration + move.settling
    first = int(np.argmin(np.abs(move.time - at)))
    assert move.time[first] == pytest.approx(at, rel=1e-12)
    assert inside[first:].all()  # from the first instant within the window on
    assert not inside[first - 1]


def test_a_sampled_move_tends_to_the_continuous_one() -> None:
    """The difference, of hold and delay alone, halves with the period."""
    plant, controller = rigid_loop(3.0, 3e4, 0.7)
    profile = setpoint(MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4))
    loop = Loop(plant, controller)
    move = simulate(loop, profile, axis=0, forces=None, window=1e-7, bandwidth_hz=15.0)
    apart = []
    for rate in (4e3, 8e3):
        period = 1.0 / rate
        tustin = Conversion.TUSTIN
        K = discretise(controller, tustin, period, 0.5 * period)
        found = simulate(Loop(plant, K, Sampling(rate, 0.5e6 * period)), profile, axis=0,
                         forces=None, window=1e-7, bandwidth_hz=15.0)  # fmt: skip
        there = np.interp(found.time, move.time, move.error)[found.time <= move.duration]
        apart.append(np.abs(found.error[: len(there)] - there).max() / move.peak_error)
    assert apart[0] < 0.05
    assert apart[1] == pytest.approx(0.5 * apart[0], rel=0.1)


def test_positions_and_accelerations_at_any_time() -> None:
    profile = setpoint(MoveLimits(0.01, 0.1, 2.0, 100.0, 1e4))
    times, states = flown(profile)
    place, _, rate, _, _ = profile.at(np.append(times, 1.0))
    assert place == pytest.approx(np.append(states[:, 0], 0.01), abs=1e-12)
    assert rate == pytest.approx(np.append(states[:, 2], 0.0), abs=1e-10)


NONE = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))


def test_feedforward_of_a_stage_with_several_inputs() -> None:
    """It moves the axis and no other one, also with more inputs than outputs: the rest is of the
    third order against the mass. Fewer inputs do not."""
    for inputs, outputs in ((3, 3), (4, 2)):
        plant = random_plant(11, rigid=2, flexible=2, inputs=inputs, outputs=outputs)
        modal = modal_plant(mechanics(plant, (0.4, 0.5)), Suspension(0.0, 0.0))
        G = scale_plant(modal, 1.0, bare=True).plant_si()
        for axis in range(outputs):
            forces = feedforward_of(Loop(G, NONE), axis)
            assert forces is not None
            left = []
            for omega in (1.0, 2.0):
                ahead = forces.T @ (1j * omega) ** np.arange(5)
                moved = G.response(np.array([omega]))[0] @ ahead
                left.append(np.abs(moved - np.eye(outputs)[axis]).max())
            assert left[1] < 1e-5
            assert left[0] < 0.2 * left[1]
    assert feedforward_of(Loop(replace(G, B=G.B[:, :1], D=G.D[:, :1]), NONE), 0) is None


def test_a_command_makes_the_move_of_its_case_unless_options_change_it() -> None:
    """[move] of the case, with the acceleration that the motor allows, of the first output."""
    problem = problem_of(load_case(EXAMPLE))
    run = SimpleNamespace(problem=problem, theta=problem.start)
    nothing = dict.fromkeys(("stroke", "velocity", "acceleration", "jerk", "snap", "window"))

    def of(axis: int = 0, **given: float) -> tuple[MoveLimits, float]:
        return move_of(argparse.Namespace(**nothing | given), cast(FinishedRun, run), axis)

    motion, (limits, window) = motion_of(problem, problem.start), of()
    ours, own = setpoint(limits), motion.cycle.profile
    assert ours.durations == pytest.approx(own.durations.real, rel=1e-9)
    assert ours.snaps == pytest.approx(np.real(own.snaps))
    assert window == motion.motion.window
    other, wider = of(stroke=0.02, window=1e-3)
    assert (other.stroke, wider) == (0.02, 1e-3)
    assert replace(other, stroke=limits.stroke) == limits
    assert of(axis=1) == (LIMITS, LIMITS.window)
