"""Motor and move: against analysis, against a simulation of its own, and against differences."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import casadi as ca
import numpy as np
import pytest
import scipy
from oracles import random_moves as moves
from oracles.case_documents import TWO_MASS
from oracles.differences import slopes

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.analysis.driven_plant import DrivenMechanics, MotionAt, with_motion
from ccd_casadi.analysis.motor import Motion, MotionOptions, Motor, cycle_of
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.move_time import _Crossing
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.result_entries import move_entry
from ccd_casadi.fixed_structure.uncertainty import modal_sum, unmoved_words
from ccd_casadi.inner_problem.controller_problem import MOVE_TIME
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of, structured_value
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.inner_problem.structured_search import least_from, prepare_search
from ccd_casadi.lti.loop import Loop, Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import (
    build_plant,
    constraint_values,
    hardware_cost,
    hardware_slopes,
    mechanics,
)
from ccd_casadi.reporting.concerns import current_concern, heat_concern
from ccd_casadi.reporting.decision import advice
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers

EXAMPLE = Path(__file__).parents[2] / "examples" / "linear_motor_axis" / "case.toml"
BANG = MoveLimits(0.1, 1e3, np.inf, 1e9, 1e16)  # no velocity, jerk or snap that a motor reaches
MOTOR = Motor((30.0,), (4.0,), (10.0,), (2.0,), 50.0)


def moving(motor: Motor, limits: MoveLimits = BANG, dwell: float = 0.0) -> Motion:
    return Motion(limits, 1e-6, dwell, motor=motor)


# ---- analysis -----------------------------------------------------------------------------------


def test_a_rigid_body_moves_bang_bang() -> None:
    """T = 2 √(d m/F) at peak force, and P = R (F/k)² without a dwell."""
    mass, F = 5.0, 300.0
    found = cycle_of(moving(replace(MOTOR, rms_power=None)), np.array([mass]))
    assert found.profile.duration == pytest.approx(2.0 * np.sqrt(0.1 * mass / F), rel=1e-4)
    assert found.peak_force == pytest.approx(F)
    assert found.rms_force == pytest.approx(F, rel=1e-4)
    assert found.power == pytest.approx(4.0 * (F / 30.0) ** 2, rel=1e-4)
    assert "peak force" in found.limits
    hot = cycle_of(moving(MOTOR), np.array([mass]))
    a = np.sqrt(50.0 / 4.0) * 30.0 / mass
    assert hot.profile.duration == pytest.approx(2.0 * np.sqrt(0.1 / a), rel=1e-4)
    assert hot.power == pytest.approx(50.0, rel=1e-10)
    assert "heat" in hot.limits


def test_a_longer_motor_gives_force_as_the_root_of_mass_and_power() -> None:
    one, four = (replace(MOTOR, size="m", peak_current=(Motor.unlimited,)) for _ in range(2))
    forces = [
        cycle_of(moving(motor), np.array([5.0]), mass).rms_force
        for motor, mass in ((one, 2.0), (four, 8.0))
    ]
    assert forces[1] == pytest.approx(2.0 * forces[0], rel=1e-3)


def test_one_mode_has_the_residual_vibration_of_a_bang_bang_move() -> None:
    """(F/k) 4 sin²(ωT/4) once the force has gone, and (1/ζω) ln of it over the window to settle."""
    mass, omega, zeta = 3.0, 2.0 * np.pi * 40.0, 3e-4
    A = np.array([[0.0, 1.0], [-(omega**2), -2.0 * zeta * omega]])
    plant = StateSpace(A, np.array([[0.0], [1.0 / mass]]), np.eye(2)[:1], np.zeros((1, 1)))
    none = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)))
    hold = Sampling(50e3)
    motion = moving(replace(MOTOR, rms_power=None))
    profile = cycle_of(motion, np.array([mass])).profile
    forward = np.zeros((5, 1))
    forward[2] = mass
    move = simulate(Loop(plant, none, hold), profile, axis=0, forces=forward, window=1e-6,
                    bandwidth_hz=10.0)  # fmt: skip
    after = move.time > profile.duration + 1e-4
    y = move.position[after] - move.error[after]
    amplitude = profile.acceleration / omega**2 * 4.0 * np.sin(omega * profile.duration / 4.0) ** 2
    assert np.abs(y[: int(50e3 / 40.0)]).max() == pytest.approx(amplitude, rel=5e-3)
    T = hold.period
    count = int(np.ceil(profile.duration / T)) + 2
    r = np.append(profile.at(np.arange(count - 1) * T)[0], 0.1)
    f = move.force[:count]
    found = _Crossing(zoh(plant, T, 0.0), tustin(none, T), r, f, 1e-6, T)
    expected = profile.duration + np.log(amplitude / 1e-6) / (zeta * omega)
    assert found.time == pytest.approx(expected, rel=5e-3)


# ---- the time of a move -------------------------------------------------------------------------


def test_random_moves_settle_at_the_sample_of_another_simulation() -> None:
    """And the smooth time is none too early; all hundred by oracles/random_moves."""
    rng = np.random.default_rng(7)
    for number in range(6):
        apart, error, exact, smooth = moves.compared(moves.drawn(rng), number % 2)
        assert abs(apart) < 0.5
        assert error < 1e-5  # of the window: 3e-8 was met
        assert smooth >= exact * (1.0 - 1e-9)


class Backwards(Workers):
    """This process, which does the last task first; `tasks` counts them."""

    tasks = 0

    def map_unordered(self, function: Callable, tasks: Sequence) -> Generator:
        self.tasks += len(tasks)
        yield from map(function, reversed(tasks))


@pytest.mark.parametrize("factor", [1.0, 1e3])
def test_workers_share_its_plants_and_change_no_bit(factor: float) -> None:
    case, workers = moves.drawn(np.random.default_rng(5)), Backwards(1)
    goal = replace(case.goal(), plants=case.goal().plants * 20)
    kappa = case.kappa + np.log([factor, *np.ones(len(case.kappa) - 1)])
    there, here = goal.at(kappa, workers), goal.at(kappa)
    assert workers.tasks > 1
    assert there[0] == here[0]
    assert np.isfinite(here[0]) == (factor == 1.0)  # no loop is stable with such a gain
    np.testing.assert_array_equal(there[1], here[1])


@pytest.mark.parametrize("seed", range(3))
def test_its_derivatives(seed: int) -> None:
    case = moves.drawn(np.random.default_rng(seed))
    # a narrower window is nearer to the rounding of a position, which differences magnify
    case = replace(case, motion=replace(case.motion, window=1e-6))
    goal = case.goal()
    value, to_kappa = goal.at(case.kappa)
    assert value >= np.log(goal.motion.cycle.profile.duration)
    numeric = slopes(lambda kappa: np.array([goal.at(kappa)[0]]), case.kappa, 5e-5)[0]
    assert to_kappa == pytest.approx(numeric, abs=3e-7)  # 1.2e-7 was met
    fixed = replace(case.motion.limits, acceleration=5.0)
    still = replace(case, motion=replace(case.motion, limits=fixed, motor=None))
    for one, step, known in ((still, 1e-4, 1e-6), (case, 1e-6, 1e-4)):
        # where the motor sets the acceleration the setpoint's switches pass samples: small kinks
        slope = one.goal().to_theta(case.kappa) * case.theta
        numeric = slopes(
            lambda s, one=one: np.array([one.goal(s * case.theta).at(case.kappa)[0]]),
            np.ones(2), step,
        )[0]  # fmt: skip
        assert slope == pytest.approx(numeric, abs=known)
    slope = case.at(case.theta).slopes(lambda cycle: cycle.profile.durations.sum()) * case.theta
    numeric = slopes(
        lambda s: np.array([case.at(s * case.theta).cycle.profile.duration]), np.ones(2), 1e-3
    )[0]
    assert slope == pytest.approx(numeric, abs=1e-6)


def test_an_unstable_loop_has_no_time() -> None:
    case = moves.drawn(np.random.default_rng(0))
    assert case.goal().at(case.kappa + np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]))[0] == np.inf


# ---- the plant with its motor -------------------------------------------------------------------


def test_the_motor_on_the_plant() -> None:
    """Its mass where the force enters, its limits as λ(θ); all slopes."""
    motor = replace(MOTOR, size="m")
    limits = replace(BANG, acceleration=20.0, jerk=1e3, snap=1e5)
    motion = moving(motor, limits, 0.1)
    plant = build_plant(moves.axis, moves.NAMES, {})
    names = ("carriage", "m", "stiffness")
    driven, theta = with_motion(plant, motion, names, {}), np.array([4.0, 2.5, 1e6])
    M = mechanics(driven, theta).M
    assert np.diag(M) == pytest.approx([6.5, 3.0])
    assert driven.constraint_names == ("peak force", "motor power")
    values = constraint_values(driven, theta)
    mass, k = 9.5, 30.0 * 2.5 / 2.0
    assert values[0] == pytest.approx(mass * 20.0 / (10.0 * k) - 1.0, rel=1e-9)
    assert hardware_cost(driven, theta) == pytest.approx(4.0)
    df, dlam = hardware_slopes(driven, theta)
    for row, f in zip((df, *dlam), (
        lambda s: hardware_cost(driven, s * theta), *(
            lambda s, i=i: constraint_values(driven, s * theta)[i] for i in range(2)
        )), strict=True):  # fmt: skip
        numeric = slopes(lambda s, f=f: np.array([f(s)]), np.ones(3), 1e-4)[0]
        assert row * theta == pytest.approx(numeric, abs=1e-7)
    dM = mechanics(driven, theta).derivatives[0]
    numeric = slopes(lambda s: mechanics(driven, s * theta).M.ravel(), np.ones(3), 1e-3)
    assert (dM.reshape(3, -1).T * theta) == pytest.approx(numeric, abs=1e-9)


@pytest.mark.parametrize(("stiffness", "viscous"), [(4e3, 0.0), (50.0, 30.0), (-3e3, 60.0)])
def test_the_force_that_holds_an_output_counts_in_its_cycle(
    stiffness: float, viscous: float
) -> None:
    """There and back over a spring or magnet and a damper, against sums over 200,000 instants."""
    limits, mass, dwell = MoveLimits(0.01, 0.2, 5.0, 1e3, 1e6), 3.0, 0.05
    h, g = np.array([[stiffness], [viscous]]), np.array([mass])
    found = cycle_of(moving(MOTOR, limits, dwell), g, 0.0, h)
    T = found.profile.duration
    t = np.linspace(0.0, T, 200001)
    r = found.profile.at(t)
    there, back = (stiffness * x + viscous * v + mass * a for x, v, a in
                   ((r[0], r[1], r[2]), (limits.stroke - r[0], -r[1], -r[2])))  # fmt: skip
    rest = dwell * (stiffness * limits.stroke) ** 2
    mean = (np.trapezoid(there**2 + back**2, t) + rest) / (2.0 * (T + dwell))
    most = max(np.abs(there).max(), np.abs(back).max(), abs(stiffness * limits.stroke))
    assert found.peak_force == pytest.approx(most, rel=1e-7)
    assert found.rms_force == pytest.approx(np.sqrt(mean), rel=1e-7)
    assert found.power == pytest.approx(4.0 / 30.0**2 * mean, rel=1e-7)
    with pytest.raises(UserError, match="acceleration"):
        cycle_of(moving(MOTOR), g, 0.0, h)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_held_plant_has_its_motor_limits_with_slopes(sign: float) -> None:
    """A table on leaf springs, or over a magnet, with a damper: F = k r + d v + m a, and slopes
    by differences."""
    damper = 8.0  # N s/m, to ground

    def model(theta: dict[str, ca.SX]) -> dict[str, ca.SX]:
        m, k = theta["m"], sign * theta["k"]
        stiffness = ca.blockcat([[k + 4e7, -4e7], [-4e7, 4e7]])
        return {"mass": ca.diag(ca.vertcat(m, 0.2)), "stiffness": stiffness,
                "damping": ca.diag(ca.vertcat(damper * m / 1.5, 0.0)), "input": ca.DM([1, 0]),
                "output": ca.DM([[0, 1]]), "hardware_cost": m}  # fmt: skip

    plant = build_plant(model, ("m", "k"), {})
    motion = moving(MOTOR, MoveLimits(0.002, 0.2, 10.0, 2e3, 1e7), 0.05)
    motion = replace(motion, motor=replace(MOTOR, moving_mass=(0.0,), rms_power=20.0))
    held, theta = with_motion(plant, motion, ["m", "k"], {}), np.array([1.5, 2e4])
    value = constraint_values(held, theta)
    profile = setpoint(motion.limits)
    r = profile.at(np.linspace(0.0, profile.duration, 20001))
    forces = [sign * 2e4 * r[0] + way * damper * r[1] + 1.7 * r[2] for way in (1.0, -1.0)]
    most = max(np.abs(forces).max(), 2e4 * 0.002)
    assert value[0] == pytest.approx(most / 300.0 - 1.0, abs=1e-4)  # the spring gives 5e-5
    late = cast(DrivenMechanics, held.evaluate).at(tuple(theta), Sampling(4000.0, 500.0))
    shares = late.cycle.peak_share, late.cycle.heat_share  # of the machine, whatever hold and delay
    assert np.subtract(shares, 1.0) == pytest.approx(value, rel=1e-9)
    for row, number in zip(hardware_slopes(held, theta)[1], range(2), strict=True):
        numeric = slopes(
            lambda s, i=number: constraint_values(held, s * theta)[[i]], np.ones(2), 1e-4
        )
        assert row * theta == pytest.approx(numeric[0], abs=1e-6)


def test_a_catalogue_is_met_at_its_motors() -> None:
    motor = Motor((20.0, 34.0), (3.0, 5.0), (9.0, 9.0), (0.4, 0.6), 50.0, "m")
    assert motor.at(0.4) == pytest.approx((20.0, 3.0, 9.0))
    assert motor.at(0.6) == pytest.approx((34.0, 5.0, 9.0))
    step = MotionOptions().complex_step
    k, _, _ = motor.at(0.5 + 1j * step)
    assert (k.real, k.imag / step) == pytest.approx((27.0, 70.0))


# ---- as a figure of the inner problem -----------------------------------------------------------


def small() -> CoDesignProblem:
    """The example with one plant beside the model's, and a PID."""
    problem = problem_of(load_case(EXAMPLE))
    sections = structured_of(problem)
    structure = replace(sections.structure, biquads=1)
    uncertainty = replace(sections.uncertainty, resonance_shift=0.0)
    few = replace(sections, structure=structure, uncertainty=uncertainty, starts=2)
    return replace(problem, controller=few, start=(0.015, 0.8))


def test_the_example_is_a_case_of_move_time() -> None:
    problem = small()
    assert problem.figure is MOVE_TIME
    motion = motion_of(problem, problem.start)
    forces = motion.forward[2]
    own = mechanics(plant_of(problem), problem.start)
    assert forces[0] == pytest.approx(own.M.sum(), rel=1e-6)  # the mass, the motor's in it
    assert {"peak force", "heat"} & set(motion.cycle.limits)
    own = problem.source.motion
    assert own is not None
    assert own.motor is not None
    cooler = replace(own, motor=replace(own.motor, rms_power=1.0))
    lighter = replace(problem.source, motion=cooler)
    assert replace(problem, source=lighter).identity() != problem.identity()


@pytest.mark.slow
def test_the_envelope_gradient_is_the_slope_of_the_least_time() -> None:
    problem, made, _ = prepare_search(small())
    problem, made, _ = least_from(problem, problem.start, made)
    assert made.certified
    theta = np.array([0.0155, 0.85])
    value = structured_value(problem, theta)
    assert value.feasible
    for i, h in enumerate((2e-6, 1e-4)):
        ends = [structured_value(problem, theta + sign * h * np.eye(2)[i]) for sign in (1.0, -1.0)]
        numeric = (ends[0].value - ends[1].value) / (2.0 * h)
        assert value.gradient[i] == pytest.approx(numeric, rel=5e-3)


MOTOR_OF = "[motor]\nforce_constant = {}\nresistance = {}\nrms_power = 5.0\n"
MOVE = "[move]\ndistance = 0.01\nvelocity = 0.2\njerk = 1e3\nsettle_band = 1e-7\n"
SECTIONS = '[controller]\nstructure = "sections"\n'


@pytest.mark.parametrize(
    ("inner", "added", "words"),
    [
        ('minimise = "move_time"', SECTIONS, "move: is missing"),
        ("", "[motor]\nforce_constant = 20.0\n", "move: is missing"),
        ("", "[move]\ndistance = 0.01\n", "move.velocity: is missing"),
        ("", MOVE, "move.acceleration: is missing"),
        ('minimise = "move_time"', SECTIONS + MOVE + "acceleration = 2.0\n", "loop.rate_hz"),
        ("", MOVE + "acceleration = 2.0\n[motor]\nforce_constant = 20.0\n", "motor.resistance"),
        ("", MOVE + MOTOR_OF.format([2.0, 3.0], [1.0, 2.0]), "motor: force_constant, or of a list"),
        ("", MOVE + MOTOR_OF.format(2.0, 1.0) + 'size = "m"', "theta.m: is missing"),
        ("", MOVE + MOTOR_OF.format(2.0, [1.0, 2.0]), "motor.resistance: has not as many"),
    ],
)  # fmt: skip
def test_mistakes_in_the_case(tmp_path: Path, inner: str, added: str, words: str) -> None:
    path = tmp_path / "case.toml"
    text = TWO_MASS.read_text().replace("[inner]", f"[inner]\n{inner}")
    path.write_text(text.replace("w2 = -0.9950", "w2 = 1.0") if inner else text)
    path.write_text(path.read_text() + "\n" + added)
    with pytest.raises(CaseError) as caught:
        load_case(path)
    assert words in str(caught.value)


def test_a_required_acceleration_binds_any_kind_of_controller(tmp_path: Path) -> None:
    path = tmp_path / "case.toml"
    motor = "[motor]\nforce_constant = 20.0\nresistance = 2.0\npeak_current = 12.0\n"
    path.write_text(f"{TWO_MASS.read_text()}\n{MOVE}acceleration = 2.0\n{motor}")
    problem = problem_of(load_case(path))
    plant = plant_of(problem)
    assert plant.constraint_names == ("peak force",)
    masses = np.array([57.0, 61.0])
    assert constraint_values(plant, masses)[0] == pytest.approx(118.0 * 2.0 / 240.0 - 1.0, rel=1e-6)
    assert hardware_slopes(plant, masses)[1][0] == pytest.approx([2.0 / 240.0] * 2, rel=1e-6)


@pytest.mark.parametrize("held", [True, False])
def test_the_force_that_is_printed_is_that_of_all_terms_of_the_feedforward(held: bool) -> None:
    """Two tied inertias with 0.8 N m of the rigid body, and 1.02 of the snap that jerk makes."""
    limits = MoveLimits(0.35, 2.0, 40.0, 4000.0, 1e7)
    forces = np.array([[0.0], [0.0], [0.02], [8e-6], [-2.0622e-8]])
    cycle = cycle_of(moving(MOTOR, limits), forces[2])
    at = MotionAt(moving(MOTOR, limits), 0.0, cycle, (), forces, np.zeros((1, 5, 1)), forces[2])
    found = at.forward_force(Sampling(25000.0, 0.0) if held else None)
    t = np.linspace(0.0, cycle.profile.duration, 200001)
    truth = np.abs(cycle.profile.at(t).T @ forces).max()
    assert found == pytest.approx(truth, rel=1e-6 if not held else 0.05)
    assert found > 1.1 * cycle.peak_force
    rigid = replace(at, forward=forces * np.array([[0], [0], [1], [0], [0]]))
    assert rigid.forward_force(Sampling(2500.0, 0.0)) == pytest.approx(cycle.peak_force, rel=1e-6)


def test_a_run_counts_what_feedforward_and_feedback_need_of_the_current() -> None:
    """By a simulation of the loop; the decision names what exceeds the motor."""
    problem = small()
    motion = motion_of(problem, problem.start)
    w, mass = 2.0 * np.pi * 25.0, float(motion.forward[2, 0])  # a lead about w
    one, gain = np.eye(1), mass * w**2 / 3.0 * 9.0
    K = StateSpace(-3.0 * w * one, one, -gain * 3.0 * w * (8.0 / 9.0) * one, gain * one)
    entry = move_entry(problem, problem.start, K)["move"]
    assert motion.motion.motor is not None
    _, _, most = motion.motion.motor.at(motion.mass)
    loops = [Loop(one.plant_si(), K, problem.sampling)
             for one in kind_of(problem).plants(problem.start)]  # fmt: skip
    runs = [simulate(loop, motion.cycle.profile, axis=0, forces=motion.forward, window=1e-6,
                     bandwidth_hz=50.0) for loop in loops]  # fmt: skip
    assert entry["needed_current"] >= entry["peak_current"]
    assert entry["needed_share"] == pytest.approx(entry["needed_current"] / most)
    assert np.isfinite(runs[0].settled)
    needed = max(entry["feedforward_force"], *(run.peak_force.max() for run in runs))
    assert entry["needed_force"] == pytest.approx(max(needed, entry["peak_force"]), rel=1e-3)
    short = {"status": "verified", "move": entry | {"needed_share": 1.2, "needed_current": 12.0}}
    worst = f" on the worst of {entry['plants']} plants ({entry['needed_force_plant']})"
    worst = worst if entry["needed_force_plant"] else ""
    assert [one.words for one in current_concern(short)] == [
        f"the move needs 12 A with feedforward and feedback{worst}, and peak_current is 10 A"
    ]
    assert "a larger peak_current" in advice(short)
    assert not current_concern({"move": entry | {"needed_share": 1.0}})
    assert not current_concern({"move": {"peak_share": 0.8}})  # of an older run


HOT = """
[plant]
function = "plant.py:slide"
stiffness = {k}
[theta.m]
lower = 3.0
upper = 5.0
start = 4.0
unit = "kg"
[theta.load]
lower = 0.0
upper = 2.0
start = 1.0
unit = "kg"
varies = true
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
acceleration = 10.0
jerk = 4000.0
settle_band = 1e-3
dwell = 0.1
[motor]
force_constant = 20.0
resistance = 2.0
peak_current = 50.0
rms_power = {power}
"""
SLIDE = """
def slide(theta, stiffness):
    m = theta["m"] + theta["load"]
    return {"mass": [[m]], "stiffness": [[stiffness]], "damping": [[0.0]], "input": [1],
            "output": [[1]], "hardware_cost": theta["m"]}
"""


@pytest.mark.parametrize("size", ["moving_mass = 0.7", 'moving_mass = 0.7\nsize = "engine"'])
def test_a_motor_leaves_the_expressions_of_a_plant_that_varies(tmp_path: Path, size: str) -> None:
    """Of which a proof over what varies is made; another plant's is refused with a reason."""
    own = """"mass": ca.diag(ca.vertcat(m, 1)), "stiffness": ca.DM([[9e4, -9e4], [-9e4, 9e4]]),
            "damping_ratio": 0.02, "input": [1, 0], "output": [[1, 0]], "hardware_cost": m}"""
    (tmp_path / "plant.py").write_text(
        "import casadi as ca\n" + SLIDE.partition('"mass"')[0].replace(", stiffness", "") + own
    )
    text = HOT.format(k=0, power=2000.0).replace("stiffness = 0\n", "") + size
    if "engine" in size:
        text += '\n[theta.engine]\nlower = 0.5\nupper = 1.0\nstart = 0.8\nunit = "kg"\n'
    (tmp_path / "case.toml").write_text(text)
    problem = problem_of(load_case(tmp_path / "case.toml"))
    box = uncertain_plant(problem, problem.start)
    graph = box.graph(0)
    assert graph is not None
    for load in (0.0, 0.3, 2.0):
        there = box.along(0, np.array([load]))
        for name, found in zip("MDKBC", graph(load), strict=True):
            if name != "D":  # which the ratio replaces
                assert np.array(found) == pytest.approx(getattr(there, name), rel=1e-14), name
    assert modal_sum(box, 0, 1.0) is not None
    assert "expressions" in unmoved_words(replace(box, graph=lambda option: None))
    matrix = replace(box.options[0], damping_ratio=None)
    assert "damping ratio" in unmoved_words(replace(box, options=(matrix,)))


@pytest.mark.parametrize("stiffness", [0.0, 3e4])
def test_the_heat_of_a_move_is_that_of_the_hottest_plant(tmp_path: Path, stiffness: float) -> None:
    """Against an own recursion there and back; free, it is the heavy slide whose motor is weak."""
    (tmp_path / "plant.py").write_text(SLIDE)

    def problem_with(power: float) -> CoDesignProblem:
        (tmp_path / "case.toml").write_text(HOT.format(k=stiffness, power=power))
        return problem_of(load_case(tmp_path / "case.toml"))

    problem = problem_with(2000.0)
    T, w, one = 1.0 / 4000.0, 2.0 * np.pi * 40.0, np.eye(1)
    gain, rest = 5.0 * w**2 / 3.0, np.zeros((2, 1))
    A = np.array([[0.0, 0.0], [0.0, -4.0 * w]])  # an integral, and a lead with its lag
    C = gain * np.array([[0.2 * w, -1.0]])
    K = StateSpace(A, np.array([[1.0], [11.0 * 4.0 * w]]), C, 12.0 * gain * one)
    found = move_entry(problem, problem.start, K)["move"]
    motion = motion_of(problem, problem.start)
    profile, count = motion.cycle.profile, int(np.ceil((motion.cycle.profile.duration + 0.1) / T))
    time = np.arange(2 * count) * T

    def there_and_back(t: np.ndarray) -> np.ndarray:
        return np.asarray(profile.at(t) - profile.at(t - count * T))

    r = there_and_back(time)
    ends = [there_and_back(time + side * T / 2) for side in (-1, 1)]
    r[1:] = (ends[1][:4] - ends[0][:4]) / T
    ahead, Kz = r.T @ motion.forward[:, 0], tustin(K, T)
    squares = {}
    for load in (0.0, 2.0):
        for factor in (0.9, 1.1):
            mass, name = 4.0 + load, f"gain {100.0 * (factor - 1.0):+.3g} %, load = {load:g}"
            whole = np.zeros((3, 3))
            whole[0, 1], whole[1, 0], whole[1, 2] = 1.0, -stiffness / mass, factor / mass
            step, x, z, sent, total = scipy.linalg.expm(whole * T), np.zeros(2), rest, 0.0, 0.0
            for wanted, extra in zip(r[0], ahead, strict=True):
                e = wanted - x[0]
                u = float((Kz.C @ z + Kz.D * e)[0, 0]) + extra
                x, z, sent = step[:2, :2] @ x + step[:2, 2] * sent, Kz.A @ z + Kz.B * e, u
                total += u**2
            squares[name] = total / len(r[0])
    hottest = max(squares, key=lambda name: squares[name])
    assert stiffness or hottest == "gain -10 %, load = 2"
    assert found["needed_heat_plant"] == hottest
    assert found["needed_rms_force"] == pytest.approx(squares[hottest] ** 0.5, rel=1e-6)
    assert found["needed_power"] == pytest.approx(2.0 / 20.0**2 * squares[hottest], rel=1e-6)
    assert found["needed_heat_share"] == pytest.approx(found["needed_power"] / 2000.0)
    assert not heat_concern({"move": found})
    hot = problem_with(found["needed_power"] / 1.04)
    entry = move_entry(hot, hot.start, K)
    assert entry["move"]["needed_heat_share"] > 1.0
    # the constraint is of the heavy slide with the weak motor, beyond which is the feedback; what a
    # spring takes at rest the feedback has not found by then
    assert stiffness or entry["move"]["heat_share"] < 1.0
    (concern,) = heat_concern(entry)
    assert f"on the worst of 5 plants ({hottest})" in concern.words
    assert f"rms_power is {hot.source.motion.motor.rms_power:.4g} W" in concern.words
    assert "a larger rms_power" in advice({"status": "verified", **entry})
    assert not heat_concern({"move": {"heat_share": 1.0}})  # of an older run
