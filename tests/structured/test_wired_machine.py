"""Moves, budgets and compliance behind an amplifier and before a filter, by own matrices."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.codesign.result_entries import move_entry
from ccd_casadi.codesign.survival import loops_of, survival
from ccd_casadi.deployment.on_hardware import move
from ccd_casadi.deployment.realisation import realise_blocks
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import ProofOutcome, prove
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import constraints, to_theta
from ccd_casadi.fixed_structure.loop_problem import RowPlaces
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.kinds import design_loops, loop_budget
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.kernels.sections import LoopCurve
from ccd_casadi.lti.loop import Sampling, tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.lti.wiring import Filters, Wiring
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.text import HZ

RATE, DELAY, M0, M1, SPRING, ZETA = 10_000.0, 130e-6, 2.0, 0.4, 3e5, 0.03
PLANT = f'''
def stage(theta, ports=False):
    """A table, its tool on a spring; `ports`: forces act at the tool, and its position counts."""
    k = {SPRING}
    found = {{"mass": [[theta["m"], 0], [0, {M1}]], "stiffness": [[k, -k], [-k, k]],
             "damping_ratio": {ZETA}, "input": [1, 0], "output": [[1, 0]],
             "hardware_cost": theta["m"]}}
    if ports:
        found |= {{"disturbance": [0, 1], "performance": [[0, 1]]}}
    return found
'''
CASE = """
[plant]
function = "plant.py:stage"
OPTIONS
[theta.m]
lower = 1.5
upper = 2.5
start = 2.0
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
LOOP
[actuator]
second_order_hz = 2000.0
damping = 0.7
[sensor]
lag_hz = 5000.0
[move]
distance = 0.02
velocity = 0.3
acceleration = 8.0
jerk = 2000.0
settle_band = 1e-8
[budget.force]
unit = "N^2/Hz"
level = 1e-3
poles_hz = [20.0]
[budget.sensor_noise]
unit = "nm/rtHz"
level = 0.5
poles_hz = [800.0]
"""
SAMPLED = f"[loop]\nrate_hz = {RATE}\ndelay_us = {1e6 * DELAY}\n"


OF_FULL_ORDER = """"h_infinity"
[weights]
M_S = 2.0
A_S = 1e-3
c_K = 1e3
omega_K_hz = 300.0
M_K = 1e6
A_l = 1.0
A_u = 1e-2
[inner]
omega_S_hz = [1.0, 50.0]
omega_T_hz = [100.0, 1000.0]
compliance_max = 1e-4"""


def problem_in(folder: Path, loop: str = SAMPLED, options: str = "") -> CoDesignProblem:
    (folder / "plant.py").write_text(PLANT)
    (folder / "case.toml").write_text(CASE.replace("LOOP", loop).replace("OPTIONS", options))
    return problem_of(load_case(folder / "case.toml"))


def controller() -> StateSpace:
    """PID of 100 Hz with a roll-off, by its own matrices."""
    w = HZ * 100.0
    A = np.array([[0.0, 0, 0], [0.0, 0, 1.0], [0.0, -((8.0 * w) ** 2), -1.4 * 8.0 * w]])
    gain = 0.4 * (M0 + M1) * w**2 * (8.0 * w) ** 2
    row = np.array([[0.2 * w / (8.0 * w) ** 2, 1.0, 3.0 / w]])
    return StateSpace(A, np.array([[1.0], [0.0], [1.0]]), gain * row, np.zeros((1, 1)))


def machine() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, of u, of forces at table and tool; rows: sensor, table, tool, force of the amplifier."""
    M, K = np.diag([M0, M1]), SPRING * np.array([[1.0, -1.0], [-1.0, 1.0]])
    root = np.sqrt(np.diag(M))
    squares, V = np.linalg.eigh(K / np.outer(root, root))
    omega = np.sqrt(np.maximum(squares, 0.0))
    D = (root[:, None] * V) @ np.diag(2.0 * ZETA * omega) @ (root[:, None] * V).T
    a, s = HZ * 2000.0, HZ * 5000.0
    A, Bu, Bd, C = np.zeros((7, 7)), np.zeros((7, 1)), np.zeros((7, 2)), np.zeros((4, 7))
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2], A[2:4, 2:4] = -np.linalg.solve(M, K), -np.linalg.solve(M, D)
    A[2, 4] = 1.0 / M0  # the amplifier's force
    A[4, 5], A[5, 4], A[5, 5], Bu[5] = 1.0, -(a**2), -1.4 * a, a**2
    A[6, 0], A[6, 6] = s, -s
    Bd[2:4] = np.linalg.inv(M)
    C[0, 6] = C[1, 0] = C[2, 1] = C[3, 4] = 1.0
    return A, Bu, Bd, C


def held(T: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """x⁺ = Φ x + Σ gains_i u_{k-i}, of a force that is constant over a period."""
    A, Bu, *_ = machine()

    def over(t: float) -> tuple[np.ndarray, np.ndarray]:
        whole = expm(np.block([[A, Bu], [np.zeros((1, 8))]]) * t)
        return whole[:7, :7], whole[:7, 7]

    late = int(delay / T + 1e-9)
    rest = delay - late * T
    (Phi, now), (_, early) = over(T - rest), over(rest)
    return over(T)[0], np.array([*np.zeros((late, 7)), now, Phi @ early])


def responses(omega: np.ndarray, K: StateSpace, run: Sampling | None) -> dict[str, np.ndarray]:
    """Every row of the machine per force at table and tool, and per sensor noise, (k, 4, ·); S."""
    A, Bu, Bd, C = machine()
    one = np.eye(7)
    d = C @ np.linalg.solve(1j * omega[:, None, None] * one - A, Bd + 0j)
    if run is None:
        u = C @ np.linalg.solve(1j * omega[:, None, None] * one - A, Bu + 0j)
        k = K.at(1j * omega)
    else:
        Phi, gains = held(run.period, run.delay)
        z = np.exp(1j * omega * run.period)
        B = (gains.T * z[:, None, None] ** -np.arange(len(gains))).sum(axis=2)
        u = C @ np.linalg.solve(z[:, None, None] * one - Phi, B[..., None])
        k = tustin(K, run.period).at(z)
    S = 1.0 / (1.0 + u[:, :1] * k)
    return {"d": d - u * k * S * d[:, :1], "n": -u * k * S, "S": S[:, 0, 0], "free": d}


@pytest.mark.parametrize("ports", [False, True])
@pytest.mark.parametrize("run", [None, Sampling(RATE, 1e6 * DELAY)])
def test_compliance_and_budget_are_those_of_the_machine(
    tmp_path: Path, run: Sampling | None, ports: bool
) -> None:
    """A force acts behind the amplifier, what counts is before the filter; noise is behind it."""
    options = "ports = true" if ports else ""
    problem, K = problem_in(tmp_path, SAMPLED if run else "", options), controller()
    (loop,) = design_loops(problem, problem.start, K)[:1]
    at = 1 if ports else 0
    omega = np.geomspace(1.0, 0.99 * np.pi * RATE, 3000)
    own = responses(omega, K, run)["d"][:, 1 + at, at]
    atol = 1e-6 * abs(own).max()
    np.testing.assert_allclose(loop.force_responses(omega)[:, 0, 0], own, rtol=0, atol=atol)
    assert loop.compliance == pytest.approx(abs(own).max(), rel=1e-3)
    found = loop_budget(problem, problem.start, K)
    assert found is not None
    assert found.model is not None
    hz = np.geomspace(1e-3, 30.0 * RATE, 60_000)
    own_at = responses(HZ * hz, K, run)
    d, n = own_at["d"][:, :, at], own_at["n"][:, :, 0]
    levels = [level / np.abs(1.0 + 1j * hz / pole) ** 2
              for level, pole in ((1e-3, 20.0), (0.25e-18, 800.0))]  # fmt: skip
    turn = responses(HZ * np.linspace(0.5, RATE - 0.5, 20_000), K, run)["n"][:, :, 0]
    beyond = np.mean(np.abs(turn) ** 2, axis=0) * levels[1][-1] * hz[-1] if run else np.zeros(4)
    for item, H, level in zip(found.model.sources, (d, n), levels, strict=True):
        for value, row in ((item.error, 1 + at), (item.force, 3)):
            density = np.abs(H[:, row]) ** 2 * level
            whole = np.trapezoid(density * hz, np.log(hz)) + density[0] * hz[0]
            whole += beyond[row] if H is n else 0.0  # all aliases beyond the last frequency
            assert value**2 == pytest.approx(whole, rel=2e-4), item.source.name
        assert item.disagreement < 1e-4


def simulated(
    K: StateSpace, setpoint: np.ndarray, ahead: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The table's error, the amplifier's force and the command, instant by instant."""
    (Phi, gains), C = held(1.0 / RATE, DELAY), machine()[3]
    x, z, sent = np.zeros(7), np.zeros(3), np.zeros(len(gains))
    found = []
    for wanted, extra in zip(setpoint, ahead, strict=True):
        y, table, _, force = C @ x
        e = wanted - y
        sent = np.roll(sent, 1)
        sent[0] = float((K.C @ z + K.D @ [e])[0] + extra)
        found.append((wanted - table, force, sent[0]))
        z = K.A @ z + K.B @ [e]
        x = Phi @ x + sent @ gains
    error, force, command = np.array(found).T
    return error, force, command


def test_a_move_has_the_amplifiers_force_and_its_command(tmp_path: Path) -> None:
    problem, K = problem_in(tmp_path), controller()
    found, Kz = move_entry(problem, problem.start, K)["move"], tustin(K, 1.0 / RATE)
    profile, T = motion_of(problem, problem.start).cycle.profile, 1.0 / RATE
    F = found["feedforward"]
    late = DELAY + 0.5 * T + 1.4 / (HZ * 2000.0) + 1.0 / (HZ * 5000.0)
    assert np.array(F)[2:4, 0] == pytest.approx([M0 + M1, (M0 + M1) * late], rel=1e-6)
    time = np.arange(4000) * T
    r = profile.at(time)
    steps = [(profile.at(time + T / 2)[i] - profile.at(time - T / 2)[i]) / T for i in range(4)]
    error, force, command = simulated(Kz, r[0], np.vstack([r[:1], steps]).T @ np.array(F)[:, 0])
    needed = max(np.abs(force).max(), found["peak_force"])
    assert found["needed_force"] == pytest.approx(needed, rel=1e-6)
    commanded = max(np.abs(command).max(), found["feedforward_force"])
    assert found["needed_command"] == pytest.approx(commanded, rel=1e-9)
    assert abs(found["needed_command"] / found["needed_force"] - 1.0) > 0.01
    count = int(np.ceil(profile.duration / T))  # there and back without a dwell, by the amplifier
    heat = np.append(force[:count], force[count : 2 * count] - force[:count])
    assert found["needed_rms_force"] == pytest.approx(np.mean(heat**2) ** 0.5, rel=1e-6)
    outside = np.flatnonzero(np.abs(error) > found["window"])
    assert found["settled"] == pytest.approx(time[outside[-1] + 1], abs=1.01 * T)
    (loop,) = design_loops(problem, problem.start, K)[:1]
    made = move(loop.plant, realise_blocks(Kz), DELAY, profile, ports=loop.ports)
    own = simulated(Kz, profile.at(made.time)[0], np.zeros(len(made.time)))
    for value, exact in zip((made.error, made.force, made.command), own, strict=True):
        np.testing.assert_allclose(value[:, 0], exact, rtol=0, atol=1e-7 * np.abs(exact).max())
    rest = survival(loops_of(problem, problem.start, K), S_max=3.0, bandwidth=600.0, omega_low=HZ)
    low = responses(np.array([HZ]), K, Sampling(RATE, 1e6 * DELAY))["d"][0, 1, 0]
    assert rest.statics.low == pytest.approx(abs(low), rel=1e-2)  # hold and delay left out there


def system(t: float = 0.0) -> Mechanics:
    """The machine as a plant; t moves its masses, spring, force and reading."""

    def matrices(t: float) -> tuple[np.ndarray, ...]:
        M, K = np.diag([M0 + t, M1]), SPRING * np.array([[1.0, -1.0], [-1.0, 1.0]])
        K *= 1.0 + 0.2 * t
        B, C = np.array([[1.0 + 0.3 * t], [0.0]]), np.array([[1.0, 0.1 * t]])
        return M, 0.0 * K, K, B, C

    h = 1e-6
    ends = zip(matrices(t + h), matrices(t - h), strict=True)
    slopes = tuple(((a - b) / (2.0 * h))[None] for a, b in ends)
    wiring = Wiring(Filters((), (2000.0,), (0.7,)), Filters((5000.0,)))
    return Mechanics(*matrices(t), ZETA, slopes, wiring)  # type: ignore[arg-type]


@pytest.mark.parametrize("run", [None, Sampling(RATE, 1e6 * DELAY)])
def test_compliance_is_bounded_judged_and_proven_as_the_machines(run: Sampling | None) -> None:
    bounds = Bounds(S_max=2.0, S_low=0.3, omega_low=2.0 * HZ, shape=4.0, compliance_max=3e-5)
    box = UncertainPlant((system(),), 1e6, gain=0.002)
    plants = box.plants(box.corners())
    design = synthesise_sections(plants, Structure(biquads=0), bounds, sampling=run, starts=1)
    assert design.certified
    assert design.controller is not None
    omega = np.geomspace(1.0, 0.999 * np.pi * RATE, 20_000)
    own = responses(omega, design.controller, run)
    moved = np.abs(own["d"][:, 1, 0]).max()
    for judged in (design.certificate, certify(box.as_written(box.corners()), design.controller,
                                               bounds, run)):  # fmt: skip
        assert judged is not None
        assert pytest.approx(moved, rel=1e-4) == judged.plants[0].GS
        assert "GS" in judged.grid_only
        assert judged.worst["GS"] == pytest.approx(1.0, abs=2e-3)  # it binds
    of = (design.structure, design.kappa, design.bandwidth, bounds, run)
    proof = prove(box, *of, slack=1e-2)
    assert proof.outcome is ProofOutcome.PROVEN, proof
    loose = replace(bounds, compliance_max=0.9 * bounds.compliance_max)  # type: ignore[operator]
    assert prove(box, *of[:3], loose, run, slack=1e-2).outcome is ProofOutcome.REFUTED


@pytest.mark.parametrize("run", [None, Sampling(RATE, 1e6 * DELAY)])
def test_slopes_of_the_compliance_are_its_differences(run: Sampling | None) -> None:
    bounds = Bounds(S_max=2.0, S_low=0.3, omega_low=2.0 * HZ, shape=4.0, compliance_max=3e-5)
    structure = Structure(biquads=0)
    box = UncertainPlant((system(),), 1e6)
    plants = box.plants(box.corners())
    design = synthesise_sections(plants, structure, bounds, sampling=run, starts=1)

    def at(t: float) -> tuple[float, np.ndarray]:
        plant = UncertainPlant((system(t),), 1e6).plants([(0, np.zeros(0))])[0]
        problem = problem_for([plant], structure, bounds, run)
        P = problem.plants
        inside = structure.in_units(design.kappa, 1.0 / P.omega_0, 1.0 / P.force)
        v = P.variable(np.array([HZ * 60.0 / P.omega_0]))
        rows = constraints(problem, inside, 0.0, RowPlaces(
            np.array([LoopCurve.GS]), np.zeros(1, int), v))  # fmt: skip
        return float(rows.value[0]) - problem.margin, to_theta(problem, inside, rows)[0]

    h = 1e-4
    slope = (at(h)[0] - at(-h)[0]) / (2.0 * h)
    assert at(0.0)[1][0] == pytest.approx(slope, rel=1e-5)
    (own,) = np.abs(responses(np.array([HZ * 60.0]), design.controller, run)["d"][:, 1, 0])
    assert at(0.0)[0] == pytest.approx(np.log(own / 3e-5), abs=1e-7)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("S_max", 'minimise = "rms_error"\nS_max', "inner.minimise"),
        ('"sections"\n[inner]', OF_FULL_ORDER, "compliance_max"),
        ("lag_hz = 5000.0", "lag_hz = [5000.0, 600.0]", "sensor.lag_hz"),
    ],
)
def test_what_is_not_known_behind_an_amplifier_is_named(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    text = CASE.replace("OPTIONS", "").replace("LOOP", "" if "h_inf" in new else SAMPLED)
    if "lag" in new:
        text = text.replace("S_max", "compliance_max = 1e-4\nS_max")
    (tmp_path / "plant.py").write_text(PLANT)
    (tmp_path / "case.toml").write_text(text.replace(old, new))
    with pytest.raises(CaseError, match=words):
        load_case(tmp_path / "case.toml")


def test_of_two_sensors_the_position_of_the_one_that_counts_is_moved(tmp_path: Path) -> None:
    """Table and tool are read through filters that differ; the table's error counts."""
    options = "[controller.channel.1]\nS_max = 2.0\n"
    (tmp_path / "plant.py").write_text(PLANT.replace("[[1, 0]],", "[[1, 0], [0, 1]],"))
    text = CASE.replace("OPTIONS", "").replace("LOOP", SAMPLED)
    text = text.replace('"sections"', f'"sections"\nbandwidth_of = "1"\n{options}')
    text = text.replace("lag_hz = 5000.0", "lag_hz = [5000.0, 700.0]")
    (tmp_path / "case.toml").write_text(text)
    problem, one = problem_of(load_case(tmp_path / "case.toml")), controller()
    K = replace(one, B=one.B @ np.array([[1.0, 0.2]]), D=np.zeros((1, 2)))
    (loop,) = design_loops(problem, problem.start, K)[:1]
    A, Bu, Bd, C = (np.pad(part, pad) for part, pad in zip(
        machine(), ([(0, 1), (0, 1)], [(0, 1), (0, 0)], [(0, 1), (0, 0)], [(0, 1), (0, 1)]),
        strict=True))  # fmt: skip
    s = HZ * 700.0
    A[7, 1], A[7, 7], C[4, 7] = s, -s, 1.0
    whole = expm(np.block([[A, Bu], [np.zeros((1, 9))]]) / RATE)
    omega = np.geomspace(1.0, 0.99 * np.pi * RATE, 400)
    loop = replace(loop, sampling=Sampling(RATE))  # no delay
    z = np.exp(1j * omega / RATE)[:, None, None]
    u = C @ np.linalg.solve(z * np.eye(8) - whole[:8, :8], whole[:8, 8:] + 0j)
    d = C @ np.linalg.solve(1j * omega[:, None, None] * np.eye(8) - A, Bd[:, :1] + 0j)
    k = tustin(K, 1.0 / RATE).at(z[:, 0, 0])
    sensors = [0, 4]
    sent = np.linalg.solve(np.eye(1) + k @ u[:, sensors], k @ d[:, sensors])
    own = (d[:, [1]] - u[:, [1]] @ sent)[:, 0, 0]
    atol = 1e-6 * abs(own).max()
    np.testing.assert_allclose(loop.force_responses(omega)[:, 0, 0], own, rtol=0, atol=atol)
    assert loop.ports.wanted == pytest.approx(np.ones((1, 1)), abs=1e-8)
    late = DELAY + 0.5 / RATE + 1.4 / (HZ * 2000.0) + 1.0 / (HZ * 5000.0)  # of the table's filter
    forward = motion_of(problem, problem.start).forward
    assert forward[2:4, 0] == pytest.approx([M0 + M1, (M0 + M1) * late], rel=1e-6)
