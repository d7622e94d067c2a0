"""The motor on every corner of the set: F = M a of plants that are put together here."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.differences import slopes

from ccd_casadi.analysis.driven_plant import motion_at
from ccd_casadi.analysis.motor import Motion
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.inner_problem.structured_problem import Uncertainty, with_structured
from ccd_casadi.plants.modal import FREE, modal_plant, without_hidden_rigid_modes
from ccd_casadi.plants.plant import constraint_values, hardware_slopes, mechanics
from ccd_casadi.plants.scaling import scale_plant

CASE = """
[plant]
function = "plant.py:{plant}"
{options}
[theta.m]
lower = 3.0
upper = 5.0
start = 4.0
unit = "kg"
[theta.load]
lower = 0.0
upper = 2.0
start = 0.5
unit = "kg"
varies = true
[theta.at]
lower = -0.4
upper = 0.3
start = 0.1
unit = "m"
varies = true
[theta.motor]
lower = 0.5
upper = 1.5
start = 1.0
unit = "kg"
[objective]
w1 = 1.0
w2 = -0.01
[controller]
structure = "sections"
[inner]
S_max = 2.0
S_low = 0.1
omega_low_hz = 2.0
[loop]
rate_hz = 4000.0
delay_us = 250.0
[robust]
gain = 0.1
[move]
distance = 0.02
velocity = 0.5
jerk = 4000.0
settle_band = 1e-3
dwell = 0.1
{move}
[motor]
size = "motor"
moving_mass = 1.0
force_constant = 20.0
resistance = 2.0
peak_current = 5.0
rms_power = {power}
"""
PLANTS = """
def beam(theta):
    m, at = theta["m"], theta["at"]
    load = theta["load"] * m / 4.0  # a heavy beam carries more: slopes differ from corner to corner
    return {"mass": [[m + load, load * at], [load * at, 0.1 * m + load * at**2]],
            "stiffness": [[0.0, 0.0], [0.0, 0.0]], "damping": [[0.0, 0.0], [0.0, 0.0]],
            "input": [[1, 1], [-0.5, 0.5]], "output": [[1, -0.5], [1, 0.5]], "hardware_cost": m}


def spring(theta, k=3e3, extra=0.0):
    m = theta["m"] * (1.0 + theta["load"] / 4.0) + 0.0 * theta["at"] + extra
    return {"mass": [[m]], "stiffness": [[k * (1 + theta["at"])]], "damping": [[8.0]],
            "input": [1], "output": [1], "hardware_cost": theta["m"]}


def middle(theta):
    m = theta["m"] + 2.0 - (theta["load"] - 0.5)**2 - (theta["at"] - 0.1)**2
    return {"mass": [[m]], "stiffness": [[0.0]], "damping": [[0.0]],
            "input": [1], "output": [1], "hardware_cost": theta["m"]}


def between(theta):
    m = theta["m"] + 2.0 - (theta["load"] - 1.0)**2 - (theta["at"] + 0.05)**2
    return {"mass": [[m]], "stiffness": [[0.0]], "damping": [[0.0]],
            "input": [1], "output": [1], "hardware_cost": theta["m"]}
"""
FREE_MOVES = [("beam", 500.0, "peak force"), ("beam", 8.0, "heat")]
GIVEN = "acceleration = 12.0"


def problem_with(
    folder: Path, plant: str, power: float = 500.0, move: str = "", options: str = ""
) -> CoDesignProblem:
    (folder / "plant.py").write_text(PLANTS)
    text = CASE.format(plant=plant, power=power, move=move, options=options)
    (folder / "case.toml").write_text(text)
    return problem_of(load_case(folder / "case.toml"))


def shares_by_hand(problem: CoDesignProblem, theta: np.ndarray) -> Iterator[tuple[float, float]]:
    """Peak and heat over what is allowed on each corner and on the model, of the beam, by sums."""
    m, motor = theta
    profile = motion_of(problem, theta).cycle.profile
    time = np.linspace(0.0, profile.duration, 20001)
    a, k, R = profile.at(time)[2].real, 20.0 * motor, 2.0 * motor
    assert problem.source.motion is not None
    assert problem.source.motion.motor is not None
    allowed = problem.source.motion.motor.rms_power or np.inf
    B, C = np.array([[1.0, 1.0], [-0.5, 0.5]]), np.array([[1.0, -0.5], [1.0, 0.5]])
    for share, at in [*itertools.product((0.0, 2.0), (-0.4, 0.3)), (0.5, 0.1)]:
        load = share * m / 4.0
        M = np.array([[m + load, load * at], [load * at, 0.1 * m + load * at**2]])
        M = M + motor * B @ B.T
        F = np.outer(a, np.linalg.solve(B, M @ np.linalg.solve(C, [1.0, 0.0]))) / 0.9
        mean = np.trapezoid((F**2).sum(axis=1), time) / (profile.duration + 0.1)
        yield float(np.abs(F).max() / (k * 5.0)), float(R / k**2 * mean / allowed)


@pytest.mark.parametrize(("plant", "power", "limit"), FREE_MOVES)
def test_the_fastest_setpoint_is_one_that_the_motors_can_make_on_every_corner(
    tmp_path: Path, plant: str, power: float, limit: str
) -> None:
    """Of two motors and a load beside the middle; on one corner nothing is left."""
    problem = problem_with(tmp_path, plant, power)
    found = motion_of(problem, problem.start)
    peaks, heats = zip(*shares_by_hand(problem, np.array(problem.start)), strict=True)
    assert limit in found.cycle.limits
    assert max(*peaks, *heats) == pytest.approx(1.0, abs=1e-5)
    assert found.cycle.peak_share == pytest.approx(max(peaks), rel=1e-5)
    assert found.cycle.heat_share == pytest.approx(max(heats), rel=1e-5)
    assert max(peaks) > 1.2 * peaks[-1]  # of the model
    r = found.cycle.profile.at(np.linspace(0.0, found.cycle.profile.duration, 20001))
    F, seconds = found.body_forces(r.real), found.cycle.profile.duration
    mean = (F**2).sum(axis=1).mean() * seconds / (seconds + 0.1)
    assert 2.0 / 20.0**2 * mean == pytest.approx(found.cycle.power, rel=1e-3)


def test_its_duration_has_slopes(tmp_path: Path) -> None:
    for _, power, _ in FREE_MOVES:
        problem = problem_with(tmp_path, "beam", power)
        theta = np.array([4.1, 0.9])
        slope = motion_of(problem, theta).slopes(lambda cycle: cycle.profile.durations.sum())
        numeric = slopes(
            lambda s, problem=problem, theta=theta: np.array(
                [motion_of(problem, s * theta).cycle.profile.duration]), np.ones(2), 1e-4,
        )[0]  # fmt: skip
        assert slope * theta == pytest.approx(numeric, rel=1e-5)


@pytest.mark.parametrize("plant", ["beam", "spring"])
def test_with_an_acceleration_the_worst_corner_is_what_is_constrained(
    tmp_path: Path, plant: str
) -> None:
    """With slopes to θ; where a spring holds the output, whose stiffness varies too."""
    problem, theta = problem_with(tmp_path, plant, 20.0, GIVEN), np.array([4.1, 0.9])
    driven = plant_of(problem)
    value = constraint_values(driven, theta)
    if plant == "beam":
        worst = np.max([*shares_by_hand(problem, theta)], axis=0)
    else:
        profile = motion_of(problem, theta).cycle.profile
        r, k = profile.at(np.linspace(0.0, profile.duration, 20001)).real, 20.0 * 0.9
        worst = np.zeros(2)
        for load, at in itertools.product((0.0, 2.0), (-0.4, 0.3)):
            h, g = 3e3 * (1.0 + at), 4.1 * (1.0 + load / 4.0) + 0.9
            ways = [(h * r[0] + way * 8.0 * r[1] + g * r[2]) / 0.9 for way in (1.0, -1.0)]
            mean = np.mean([(F**2).mean() for F in ways]) * profile.duration
            mean += 0.5 * 0.1 * (h * 0.02 / 0.9) ** 2
            heat = 2.0 * 0.9 / k**2 * mean / (profile.duration + 0.1) / 20.0
            worst = np.maximum(worst, [np.abs(ways).max() / (k * 5.0), heat])
    assert value + 1.0 == pytest.approx(worst, rel=1e-3)
    cycle = motion_of(problem, theta).cycle
    assert [cycle.peak_share, cycle.heat_share] == pytest.approx(value + 1.0)
    for number, row in enumerate(hardware_slopes(driven, theta)[1]):
        numeric = slopes(
            lambda s, i=number: constraint_values(driven, s * theta)[[i]], np.ones(2), 1e-4
        )[0]
        assert row * theta == pytest.approx(numeric, rel=1e-5)


def test_a_weak_motor_is_one_of_less_force_constant(tmp_path: Path) -> None:
    """Behind amplifiers too, and for the model alone."""
    for text in ("", "[actuator]\nlag_hz = 300.0\n"):
        problem = problem_with(tmp_path, "spring", 8.0, options="k = 0.0\n" + text)
        weak = with_structured(problem, uncertainty=Uncertainty(gain=0.1))
        alone = with_structured(problem, uncertainty=Uncertainty())
        motion = problem.source.motion
        assert motion is not None
        assert motion.motor is not None
        less = replace(motion, motor=replace(motion.motor, force_constant=(18.0,)))
        alike = replace(alone, source=replace(alone.source, motion=less))
        found, other = (motion_of(one, one.start) for one in (weak, alike))
        assert found.cycle.profile.duration == pytest.approx(other.cycle.profile.duration)
        assert found.cycle.peak_force == pytest.approx(other.cycle.peak_force / 0.9)
        np.testing.assert_array_equal(found.forward, other.forward)  # which stays the model's
        assert found.cycle.profile.duration > motion_of(alone, alone.start).cycle.profile.duration


def test_a_model_that_is_the_heaviest_of_its_range_moves_as_without_it(tmp_path: Path) -> None:
    problem = problem_with(tmp_path, "middle", 8.0)
    wide = with_structured(problem, uncertainty=replace(
        problem.controller.uncertainty, gain=0.0))  # fmt: skip
    alone = with_structured(problem, uncertainty=Uncertainty())
    found, other = (motion_of(one, one.start).cycle for one in (wide, alone))
    assert found.profile.duration == pytest.approx(other.profile.duration, rel=1e-12)
    assert found.power == pytest.approx(other.power, rel=1e-12)


def test_a_load_that_is_heaviest_inside_its_range_counts(tmp_path: Path) -> None:
    """In the middle of the first one it is 6.0 - 0.0225 kg, at the start 5.73, less at corners."""
    problem = problem_with(tmp_path, "between", 500.0, GIVEN)
    theta = np.array([4.0, 1.0])
    peak = constraint_values(plant_of(problem), theta)[0] + 1.0
    a = motion_of(problem, theta).cycle.profile.acceleration.real
    assert peak == pytest.approx((6.0 - 0.15**2 + 1.0) * a / 0.9 / (20.0 * 5.0), rel=1e-6)


def test_an_option_of_the_plant_is_a_load(tmp_path: Path) -> None:
    problem = problem_with(tmp_path, "spring", 8.0, options="k = 0.0")
    listed = with_structured(problem, uncertainty=Uncertainty(options=((("extra", 3.0),),)))
    heavy = with_structured(problem, uncertainty=Uncertainty())
    extra = (("extra", 3.0), *heavy.source.options)
    heavy = replace(heavy, source=replace(heavy.source, options=extra))
    found, other = (motion_of(one, one.start).cycle for one in (listed, heavy))
    assert found.profile.duration == pytest.approx(other.profile.duration, rel=1e-12)
    assert found.peak_force == pytest.approx(other.peak_force, rel=1e-12)


def test_a_motor_that_moves_its_model_alone_moves_as_ever(tmp_path: Path) -> None:
    """To the last bit; and stored samples of it are known, those of a set are not."""
    problem = problem_with(tmp_path, "beam", 8.0)
    alone = with_structured(problem, uncertainty=Uncertainty(resonance_shift=0.02))
    found, own = motion_of(alone, alone.start), alone.source.motion
    assert isinstance(own, Motion)
    system = mechanics(plant_of(alone), alone.start)
    bare = scale_plant(without_hidden_rigid_modes(modal_plant(system, FREE)), 1.0, bare=True)
    other = motion_at(own, bare, alone.start[1], 1, alone.sampling)
    assert vars(found.cycle.profile)["durations"].tolist() == other.cycle.profile.durations.tolist()
    assert (found.cycle.power, found.cycle.peak_force) == (other.cycle.power,
                                                           other.cycle.peak_force)  # fmt: skip
    assert alone.identity()["plant"] == alone.source.identity()
    assert problem.identity()["plant"] != problem.source.identity()
