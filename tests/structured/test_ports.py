"""Forces where they act, errors where they count: against the dynamic stiffness of the loop."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from ccd_casadi.analysis.loop_figures import compliance_of, force_response, largest_force_step
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.codesign.result_entries import move_entry
from ccd_casadi.codesign.survival import loops_of, survival
from ccd_casadi.deployment.on_hardware import move
from ccd_casadi.deployment.realisation import realise_blocks
from ccd_casadi.drive import main as drive
from ccd_casadi.explore import main as explore
from ccd_casadi.extensions.feedforward.feedforward_files import place_words
from ccd_casadi.inner_problem.kinds import design_loops, loop_budget, member_loops
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.lti.loop import Loop, tustin
from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.robust.margins import noise
from ccd_casadi.support.command_line import ExitCode
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.statics import statics

RATE, DELAY = 4000.0, 100e-6
PLANT = '''
import casadi as ca

M0, M1, M2 = 8.0, 1.5, 0.9

def stage(theta, ports=True, numbers=False, both=False):
    """A carriage with a tool on a soft arm and, on a like arm, a balance that the encoder at the
    carriage cannot tell from it."""
    m, k = theta["m"], 2e5
    if numbers:
        m = float(m)
    K = [[2 * k, -k, -k], [-k, k, 0], [-k, 0, k]]
    found = {
        "mass": [[M0, 0, 0], [0, m, 0], [0, 0, M1]] if numbers else
                ca.diag(ca.vertcat(M0, m, M1)),
        "stiffness": K, "damping_ratio": 0.03, "input": [1, 0, 0],
        "output": [[1, 0, 0], [0, 0, 1]] if both else [[1, 0, 0]], "hardware_cost": m}
    if ports:
        found["disturbance"] = [[0, 0], [1, 0], [0, 1]]
        found["performance"] = [[0, 1, 0]]
    return found
'''
CASE = """
[plant]
function = "plant.py:stage"
OPTIONS
[theta.m]
lower = 1.0
upper = 2.0
start = 1.5
unit = "kg"
[objective]
w1 = 1.0
w2 = -0.05
[controller]
structure = "sections"
BANDWIDTH
[inner]
S_max = 2.5
S_low = 0.5
omega_low_hz = 1.0
omega_S_hz = [1.0, 50.0]
omega_T_hz = [100.0, 1000.0]
[weights]
M_S = 2.0
A_S = 1e-3
c_K = 1e3
omega_K_hz = 300.0
M_K = 1e6
A_l = 1.0
A_u = 1e-2
LOOP
[move]
distance = 0.02
velocity = 0.3
acceleration = 5.0
jerk = 400.0
settle_band = 1e-7
[motor]
force_constant = 20.0
resistance = 2.0
peak_current = 40.0
moving_mass = 0.5
[budget.force]
unit = "N^2/Hz"
level = 0.1
poles_hz = [60.0]
[budget.sensor_noise]
unit = "m^2/Hz"
level = 1e-18
poles_hz = [500.0]
"""
SAMPLED = f"[loop]\nrate_hz = {RATE}\ndelay_us = {1e6 * DELAY}\n"
M, KS = np.diag([8.5, 1.5, 1.5]), 2e5 * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]])
E, F = np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0.0, 1.0, 0.0]])


def damping() -> np.ndarray:
    """D of a ratio of 0.03 in every mode."""
    root = np.sqrt(np.diag(M))
    squares, V = np.linalg.eigh(KS / np.outer(root, root))
    omega = np.sqrt(np.maximum(squares, 0.0))
    return (root[:, None] * V) @ np.diag(2.0 * 0.03 * omega) @ (root[:, None] * V).T


def controller(inputs: int = 1) -> StateSpace:
    """A lead around 15 Hz and an integrator on the carriage, and little on the balance's sensor."""
    w = HZ * 15.0
    A = np.array([[-3.0 * w, w, 0.0], [0.0, -6.0 * w, 0.0], [0.0, 0.0, 0.0]])
    B, C = np.array([[0.0], [6.0 * w], [1.0]]), 11.0 * w**2 * np.array([[-8.0 / 3.0, 1.0, 2.0]])
    if inputs == 2:
        B = np.hstack([B, 0.1 * np.array([[0.0], [6.0 * w], [0.0]])])
    return StateSpace(A, B, C, np.zeros((1, inputs)))


def problem_in(
    folder: Path, loop: str = "", options: str = "", bandwidth: str = "", **changes: str
) -> CoDesignProblem:
    (folder / "plant.py").write_text(PLANT)
    text = CASE.replace("LOOP", loop).replace("OPTIONS", options).replace("BANDWIDTH", bandwidth)
    for old, new in changes.values():  # type: ignore[misc]
        assert old in text
        text = text.replace(old, new)
    (folder / "case.toml").write_text(text)
    return problem_of(load_case(folder / "case.toml"))


def closed(s: np.ndarray, K: StateSpace, C: np.ndarray) -> np.ndarray:
    """(M s² + D s + K + B K(s) C)⁻¹ (k, 3, 3)."""
    B = np.array([[1.0], [0.0], [0.0]])
    Z = M * (s**2)[:, None, None] + damping() * s[:, None, None] + KS
    return np.linalg.inv(Z + B @ K.at(s) @ C)


def test_a_force_that_the_sensor_sees_moves_nothing_at_rest(tmp_path: Path) -> None:
    """An integrator holds what it measures, wherever a force acts; what is left is rounding."""
    problem, K = problem_in(tmp_path), controller()
    (loop,) = member_loops(problem, problem.start, K)[:1]
    ports = replace(loop.ports, counted=loop.plant.C, beyond=None)
    found = statics(loop.plant, K, bandwidth=100.0, omega_low=HZ, ports=ports)
    assert found.compliance == 0.0
    assert "does not move the stage" in found.words
    elsewhere = statics(loop.plant, K, bandwidth=100.0, omega_low=HZ, ports=loop.ports)
    assert "beyond the sensors" in elsewhere.words


@pytest.mark.parametrize("sensors", [1, 2])
@pytest.mark.parametrize("options", ["", "numbers = true"])
def test_compliance_is_that_of_the_dynamic_stiffness(
    tmp_path: Path, sensors: int, options: str
) -> None:
    """The arms against each other is a mode that the carriage neither moves nor sees."""
    bandwidth = 'bandwidth_of = "1"' if sensors == 2 else ""
    both = f"{options}\nboth = true" if sensors == 2 else options
    problem, K = problem_in(tmp_path, "", both, bandwidth), controller(sensors)
    assert plant_of(problem).ports == ("disturbance", "performance")
    notes = " ".join(plant_of(problem).notes(problem.start))
    assert "`disturbance`" in notes
    assert ("numbers only" in notes) == ("numbers" in options)
    (loop,) = member_loops(problem, problem.start, K)[:1]
    C = np.array([[1.0, 0, 0], [0, 0, 1.0]])[:sensors]
    s = 1j * np.geomspace(0.1, 1e5, 40_000)
    own = F @ closed(s, K, C) @ E
    atol = 1e-7 * np.abs(own).max()
    np.testing.assert_allclose(loop.force_responses(s.imag), own, rtol=0, atol=atol)
    most, rest, low, hz = compliance_of([loop], HZ)
    assert most == pytest.approx(sigma_max(own).max(), rel=1e-5)
    at = sigma_max(F @ closed(1j * np.array([1e-6 * HZ, HZ]), K, C) @ E)
    np.testing.assert_allclose([rest, low], at, rtol=1e-6)
    assert hz == pytest.approx(1.0)
    found = statics(loop.plant, K, bandwidth=100.0, omega_low=HZ, places=loop.at, ports=loop.ports)
    np.testing.assert_allclose([found.compliance, found.low], [rest, low], rtol=1e-6)
    omega = s.imag[::100]
    np.testing.assert_allclose(loop.curves(omega)["GS"], loop.force_responses(omega))
    assert loop.closed.GS.D.shape == (1, 2)
    np.testing.assert_allclose(loop.closed.GS.response(s.imag[::100]), own[::100], rtol=0,
                               atol=1e-7 * np.abs(own).max())  # fmt: skip


def test_a_step_of_force_at_the_tool_moves_the_tool(tmp_path: Path) -> None:
    problem, K = problem_in(tmp_path), controller()
    (loop,) = member_loops(problem, problem.start, K)[:1]
    times, y = force_response(loop, 100.0, 0.2)
    assert y.shape[:2] == (2, 1)
    n, C = 3, np.array([[1.0, 0, 0]])
    A = np.block([
        [np.zeros((n, n)), np.eye(n), np.zeros((n, 3))],
        [-np.linalg.solve(M, KS), -np.linalg.solve(M, damping()),
         np.linalg.solve(M, np.array([[1.0], [0], [0]]) @ K.C)],
        [-K.B @ C, np.zeros((3, n)), K.A],
    ])  # fmt: skip
    d = np.concatenate([np.zeros(n), np.linalg.solve(M, E[:, 0]), np.zeros(3), [0.0]])
    whole = np.zeros((10, 10))
    whole[:9, :9], whole[:9, 9] = A, d[:9]
    for k in (1, len(times) // 2, len(times) - 1):
        x = expm(whole * times[k])[:9, 9]
        assert y[0, 0, k] == pytest.approx(x[1], rel=1e-6, abs=1e-12)


def test_the_budget_is_of_the_tool(tmp_path: Path) -> None:
    problem, K = problem_in(tmp_path), controller()
    found = loop_budget(problem, problem.start, K)
    assert found is not None
    assert found.model is not None
    hz = np.geomspace(1e-3, 1e5, 200_000)
    s, C = 2j * np.pi * hz, np.array([[1.0, 0, 0]])
    inverse = closed(s, K, C)
    force = (np.abs(F @ inverse @ E) ** 2).sum((1, 2)) * 0.1 / np.abs(1.0 + 1j * hz / 60.0) ** 2
    seen = F @ inverse @ np.array([[1.0], [0], [0]]) @ K.at(s)
    noise = (np.abs(seen) ** 2).sum((1, 2)) * 1e-18 / np.abs(1.0 + 1j * hz / 500.0) ** 2
    for item, own in zip(found.model.sources, (force, noise), strict=True):
        whole = np.trapezoid(own * hz, np.log(hz)) + own[0] * hz[0]
        assert item.error**2 == pytest.approx(whole, rel=1e-5), item.source.name
        assert item.disagreement < 1e-4  # by Lyapunov and by the integral; measured 1e-7


def mechanics() -> tuple[np.ndarray, np.ndarray]:
    A = np.block([[np.zeros((3, 3)), np.eye(3)],
                  [-np.linalg.solve(M, KS), -np.linalg.solve(M, damping())]])  # fmt: skip
    return A, np.vstack([np.zeros((3, 1)), np.linalg.solve(M, np.array([[1.0], [0], [0]]))])


def held() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x⁺ = Φ x + now u_k + before u_{k-1} of a delay below a period."""
    (A, B), T = mechanics(), 1.0 / RATE

    def over(t: float) -> tuple[np.ndarray, np.ndarray]:
        whole = expm(np.block([[A, B], [np.zeros((1, 7))]]) * t)
        return whole[:6, :6], whole[:6, 6:]

    (late, now), (_, early) = over(T - DELAY), over(DELAY)
    return over(T)[0], now, late @ early


def test_a_sampled_move_and_its_noise_are_the_tools(tmp_path: Path) -> None:
    problem, K = problem_in(tmp_path, SAMPLED), controller()
    found = move_entry(problem, problem.start, K)["move"]
    mass = M.sum()
    assert found["feedforward"][2] == pytest.approx([mass], rel=1e-9)  # of the motor, no mass at E
    profile, Kz = motion_of(problem, problem.start).cycle.profile, tustin(K, 1.0 / RATE)
    T = Kz.period
    time = np.arange(6000) * T
    r = profile.at(time)
    half = [(profile.at(time + T / 2)[i] - profile.at(time - T / 2)[i]) / T for i in range(4)]
    ahead = np.vstack([r[:1], half]).T @ np.array(found["feedforward"])[:, 0]
    Phi, now, before = held()
    errors = simulated(Kz, r[0], ahead)
    late = np.flatnonzero(np.abs(errors) > found["window"])
    assert found["settled"] == pytest.approx(time[late[-1] + 1], abs=1.01 * T)
    n = 6 + 1 + 3  # x, the last u, K's states
    X, enters = np.zeros((n, n)), np.zeros((n, 1))
    X[:6, :6], X[:6, 6:7] = Phi, before
    X[6, :1], X[6, 7:], enters[6] = -Kz.D[0], Kz.C[0], -Kz.D[0]
    X[7:, :1], X[7:, 7:], enters[7:] = -Kz.B, Kz.A, -Kz.B
    X[:6] += now @ X[6:7]
    enters[:6] += now * enters[6]
    (loop,) = design_loops(problem, problem.start, K)[:1]
    made = move(loop.plant, realise_blocks(Kz), DELAY, profile, ports=loop.ports)
    own = simulated(Kz, profile.at(made.time)[0], np.zeros(len(made.time)))
    np.testing.assert_allclose(made.error[:, 0], own, rtol=0, atol=1e-11)  # measured 2e-12
    white = loop_noise(loop)
    P = solve_discrete_lyapunov(X, enters @ enters.T / (2.0 * T))
    assert white == pytest.approx(np.sqrt(P[1, 1]), rel=1e-5)


def simulated(K: StateSpace, setpoint: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """The tool's error of a sampled loop, a setpoint and forces beside K's."""
    Phi, now, before = held()
    x, z, last, errors = np.zeros(6), np.zeros(3), 0.0, []
    for wanted, extra in zip(setpoint, ahead, strict=True):
        e = wanted - x[0]
        errors.append(wanted - x[1])
        u = float((K.C @ z + K.D @ [e])[0] + extra)
        z = K.A @ z + K.B @ [e]
        x, last = Phi @ x + now[:, 0] * u + before[:, 0] * last, u
    return np.array(errors)


def loop_noise(loop: Loop) -> float:
    (found,) = noise(loop, 1.0, 1.0).position_by_noise
    return float(found)


def test_a_plant_without_ports_is_as_it_was(tmp_path: Path) -> None:
    plain = problem_in(tmp_path, options="ports = false")
    (loop,) = design_loops(plain, plain.start, controller())[:1]
    assert not loop.ported
    s = 1j * np.geomspace(1.0, 1e4, 300)
    own = closed(s, controller(), np.array([[1.0, 0, 0]]))[:, :1, :1]
    np.testing.assert_allclose(loop.force_responses(s.imag), own, rtol=1e-6)
    np.testing.assert_allclose(loop.curves(s.imag)["GS"], own, rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "S_max = 2.5",
            'S_max = 2.5\nminimise = "rms_error"',
            "the error of .budget. with them",
        ),
        ("S_max = 2.5", 'S_max = 2.5\nminimise = "move_time"', "time of .move. with them"),
        ('structure = "sections"', 'structure = "h_infinity"', "full order"),
    ],
)
def test_what_does_not_know_them_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    first = "[budget" if "move_time" in new else "[move]"
    budget = CASE[CASE.index(first) : CASE.index("[budget.force]")]
    with pytest.raises(CaseError, match=words):
        problem_in(tmp_path, "" if "h_inf" in new else SAMPLED, own=(old, new), move=(budget, ""))


def test_a_feedforward_for_the_sensor_is_called_that(tmp_path: Path) -> None:
    """Where the error counts elsewhere, and nowhere else."""
    assert "not of `performance`" in place_words(SimpleNamespace(problem=problem_in(tmp_path)))
    plain = problem_in(tmp_path, options="ports = false")
    assert place_words(SimpleNamespace(problem=plain)) == ""


def test_commands_that_do_not_know_them_say_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem_in(tmp_path, SAMPLED)
    case = tmp_path / "case.toml"
    assert explore([str(case), "--no-open"]) == ExitCode.BAD_INPUT
    assert "not known to explore" in capsys.readouterr().err
    case.write_text(case.read_text() + '[drive]\nname = "generic"\n')
    assert drive([str(case)]) == ExitCode.BAD_INPUT
    assert "not known to [drive]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[[0, 0], [1, 0], [0, 1]]", "[[1, 0, 0]]", "disturbance is .* transpose"),
        ("[[0, 1, 0]]", "[0, 1, 0, 0]", "performance is"),
        ("[[0, 1, 0]]", "[[0, 0, 0]]", "performance has no entry but 0"),
        ("[[0, 1, 0]]", "ca.DM(0, 3)", "performance has no entry but 0"),
        ("[[0, 1, 0]]", "ca.horzcat(0, m, float('nan'))", "performance is not finite"),
        ("[[0, 0], [1, 0], [0, 1]]", "[0, 0, 0]", "disturbance has no entry but 0"),
        ("[[0, 0], [1, 0], [0, 1]]", "[0, float('inf'), 0]", "disturbance is not finite"),
    ],
)
def test_what_is_no_port_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    problem_in(tmp_path)
    (tmp_path / "plant.py").write_text(PLANT.replace(old, new))
    with pytest.raises(CaseError, match=words):
        problem_of(load_case(tmp_path / "case.toml"))


def test_the_loop_at_rest_in_the_verdict_is_the_tools(tmp_path: Path) -> None:
    """An integrator holds the carriage; the arm between it and the tool yields by 1/k."""
    problem, K = problem_in(tmp_path), controller()
    found = survival(loops_of(problem, problem.start, K), S_max=3.0, bandwidth=100.0, omega_low=HZ)
    assert np.isinf(found.statics.stiffness)
    assert found.statics.compliance == pytest.approx(1.0 / 2e5, rel=1e-6)


def test_a_step_of_force_names_the_channel_that_counts(tmp_path: Path) -> None:
    both, counts = "ports = false\nboth = true", 'bandwidth_of = "2"'
    problem = problem_in(tmp_path, options=both, bandwidth=counts)
    loops = member_loops(problem, problem.start, controller(2))[:1]
    found = largest_force_step(loops, 100.0)
    assert found.pair == "channel 2 by actuator 1"


def test_where_no_force_moves_what_counts_its_compliance_is_0(tmp_path: Path) -> None:
    problem = problem_in(tmp_path)
    (loop,) = member_loops(problem, problem.start, controller())[:1]
    assert loop.counted is not None
    assert replace(loop, counted=0.0 * loop.counted).compliance == 0.0
