"""Several sensors on one actuator, deployed: by formulas of its own wherever it is broken."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from oracles.structured_text import run as run_text
from oracles.two_encoders import DELAY, EXAMPLE, RATE, axis, broken, by_hand, held

from ccd_casadi.analysis import LIMITS
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.analysis.setpoint_feedforward import forward_of, held_setpoint
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.deploy_files import controller_dict
from ccd_casadi.deployment.given_controller import as_it_runs, with_controller
from ccd_casadi.deployment.on_hardware import move, on_hardware
from ccd_casadi.deployment.outcome import DeployedRun, Deployment
from ccd_casadi.deployment.pipeline import deploy
from ccd_casadi.deployment.source_code import COMPILE, write_c
from ccd_casadi.extensions.formats.code_formats import structured_text
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.ports import course
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.robust import Demands
from ccd_casadi.robust.perturbed import judge
from ccd_casadi.robust.study import robustness
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ


@pytest.fixture(scope="module")
def deployed(tmp_path_factory: pytest.TempPathFactory) -> tuple[FinishedRun, Deployment]:
    run = by_hand(tmp_path_factory.mktemp("axis"))
    return run, deploy(run, Timing())


def test_figures_are_those_of_every_place_on_every_plant(
    deployed: tuple[FinishedRun, Deployment],
) -> None:
    found = deployed[1]
    K = found.realisation.system
    omega, S = broken(K, DELAY)
    assert found.sampled.sensitivity_peak == pytest.approx(S.max(), rel=1e-5)
    first = omega[np.argmax(S[1] > np.sqrt(0.5))]
    assert found.sampled.bandwidth == pytest.approx(first, rel=2e-3)
    worst = {shift: broken(K, DELAY, shift)[1].max() for shift in (-0.03, 0.03)}
    for item in found.members:
        if abs(item.at.shift) == 0.03:
            own = worst[item.at.shift]
            assert item.figures.sensitivity_peak == pytest.approx(own, rel=1e-5)
    assert found.passed, found.shortfalls
    assert found.judge is not None
    names = {"S_max of motor", "S_max of table", "S_max of actuator"}
    assert names <= set(found.judge.figures)
    each = np.max([broken(K, DELAY, s)[1].max(axis=1) for s in (-0.03, 0.0, 0.03)], axis=0)
    for name, own in zip(("motor", "table", "actuator"), each, strict=True):
        allowed = 2.1 * (1.0 + found.target.excess)  # of 51 plants, some between these
        assert found.judge.figures[f"S_max of {name}"] >= own / allowed * (1.0 - 1e-5)


def test_a_place_that_exceeds_S_max_alone_fails(tmp_path: Path) -> None:
    run = by_hand(tmp_path, harder=1.2)
    K = deploy(run, Timing()).realisation.system
    peaks = np.max([broken(K, DELAY, s)[1].max(axis=1) for s in (-0.03, 0.0, 0.03)], axis=0)
    others, top = np.sort(peaks)[:2], peaks.max()
    assert peaks[1] < top, "the error's own place is not the highest here"
    lower = by_hand(tmp_path, S_max=float(round(0.5 * (others[-1] + top), 3)), harder=1.2)
    failed = deploy(lower, Timing())
    assert not failed.passed
    assert DeployedRun(lower, failed).check().entry["state"] == "failed"
    assert failed.judge is not None
    over = [name for name, share in failed.judge.figures.items() if share > 1.0 + 1e-5]
    assert over[-1] == f"S_max of {('motor', 'table', 'actuator')[int(peaks.argmax())]}"


@pytest.mark.parametrize(
    ("rate", "delay"), [pytest.param(8000.0, 250e-6, marks=pytest.mark.slow), (12800.0, 20e-6)]
)
def test_at_another_rate_and_delay(tmp_path: Path, rate: float, delay: float) -> None:
    found = deploy(by_hand(tmp_path), Timing(rate, delay))
    S = broken(found.realisation.system, delay)[1]
    assert found.sampled.sensitivity_peak == pytest.approx(S.max(), rel=1e-5)


@pytest.mark.slow
def test_a_continuous_design_gets_a_rate_at_which_every_place_is_kept(tmp_path: Path) -> None:
    table = "[loop]\nrate_hz = 8000.0\ndelay_us = 187.5\n"
    run = by_hand(tmp_path, S_max=1.7, loop=(table, ""))
    A, B = axis()
    s = 1j * np.geomspace(1.0, 1e6, 40_000)
    G = np.linalg.solve(s[:, None, None] * np.eye(4) - A, B + 0j)[:, :2, 0]
    K = run.controller
    gains = (K.C @ np.linalg.solve(s[:, None, None] * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D)[:, 0]
    D = 1.0 + (G * gains).sum(axis=1)
    S = np.abs([(D - G[:, 0] * gains[:, 0]) / D, (D - G[:, 1] * gains[:, 1]) / D, 1.0 / D])
    assert run.figures.sensitivity_peak == pytest.approx(S.max(), rel=1e-5)
    below = s.imag[np.argmax(S[1] > np.sqrt(0.5))]
    assert run.figures.bandwidth == pytest.approx(below, rel=1e-3)
    found = deploy(run, Timing())
    peaks = [broken(found.realisation.system, found.delay, s)[1].max() for s in (-0.03, 0.0, 0.03)]
    assert max(peaks) <= 1.05 * 1.7
    assert found.passed, found.shortfalls


compiled = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@compiled
def test_the_code_is_the_state_space_for_every_sensor(
    deployed: tuple[FinishedRun, Deployment], tmp_path: Path
) -> None:
    """K(z) is Tustin's rule of the sections here; errors of one sensor, of the other, of both."""
    run, found = deployed
    write_c(tmp_path, found.realisation, title="two", delay=DELAY, verified=True)
    made = subprocess.run([*COMPILE.split(), "-Werror"], cwd=tmp_path, capture_output=True,
                          text=True, check=False)  # fmt: skip
    assert made.returncode == 0, made.stderr
    assert subprocess.run([tmp_path / "controller_test"], check=False).returncode == 0
    K, stored = run.controller, controller_dict(found)
    assert np.shape(stored["D"]) == (1, 2)
    one, half = np.eye(len(K.A)), 0.5 / RATE
    E = np.linalg.inv(one - half * K.A)
    A, B, C = E @ (one + half * K.A), E @ K.B / RATE, K.C @ E
    D = K.D + half * C @ K.B
    text = structured_text(found.realisation, title="two", delay=DELAY, verified=True)
    rng = np.random.default_rng(3)
    for sees in ([1.0, 0.0], [0.0, 1.0], [1.0, 1.0]):
        e = 1e-6 * rng.normal(size=(300, 2)) * sees
        x, expected = np.zeros(len(A)), []
        for row in e:
            expected.append(C @ x + D @ row)
            x = A @ x + B @ row
        lines = "\n".join(" ".join(f"{v:.17g}" for v in row) for row in e)
        ran = subprocess.run([tmp_path / "controller_test", "-"], input=lines, text=True,
                             capture_output=True, check=True)  # fmt: skip
        u = np.array(ran.stdout.split(), float)[:, None]
        size = np.abs(expected).max()
        np.testing.assert_allclose(u, expected, rtol=0, atol=1e-9 * size)
        calls = [{"E": row.tolist(), "F": [0.0], "RESET": i == 0} for i, row in enumerate(e)]
        np.testing.assert_allclose([found["U"] for found in run_text(text, calls)], u, rtol=0,
                                   atol=1e-12 * size)  # fmt: skip


def test_a_move_sends_its_setpoint_to_both_encoders(
    deployed: tuple[FinishedRun, Deployment],
) -> None:
    """Against a simulation in the axis' own coordinates; the error is the table's."""
    run, found = deployed
    G, K = run.plant.plant_si(), found.realisation.system
    places = kind_of(run.problem).bounds().places
    np.testing.assert_allclose(course(G, 0, places), [[0.0, 1.0], [1.0, 1.0]], atol=1e-7)
    profile, T = setpoint(LIMITS), 1.0 / RATE
    forward = forward_of(G, T, DELAY, places)
    assert not forward[:, :, 0].any()
    assert forward[2, 0, 1] == pytest.approx(1.0 / (axis()[1][2, 0] ** -1 + 120.0) ** -1, rel=1e-6)
    made = move(G, found.realisation, DELAY, profile, places=places, forward=forward)
    r = held_setpoint(profile, made.time, T)
    F, now, before, d = held(0.0, T, DELAY)
    x, z, sent, errors = np.zeros(4), np.zeros(len(K.A)), [0.0] * (d + 2), []
    for wanted, ahead in zip(r[0], r.T @ forward[:, 0, 1], strict=True):
        e = wanted - x[:2]
        errors.append(e[1])
        sent = [float((K.C @ z + K.D @ e)[0] + ahead), *sent[:-1]]
        z = K.A @ z + K.B @ e
        x = F @ x + now[:, 0] * sent[d] + before[:, 0] * sent[d + 1]
    np.testing.assert_allclose(made.error[:, 0], errors, rtol=0, atol=1e-12)
    loop = Loop(G, run.controller, Sampling(RATE, 1e6 * DELAY), places)
    free = move(G, found.realisation, DELAY, profile, places=places)
    other = simulate(loop, profile, axis=0, forces=None, window=1e-6, bandwidth_hz=100.0)
    count = min(len(free.error), len(other.error))
    np.testing.assert_allclose(other.error[:count], free.error[:count, 0], rtol=0, atol=1e-12)
    held_back = on_hardware(G, found.realisation, DELAY, run.figures.bandwidth, limits=LIMITS,
                            places=places)  # fmt: skip
    assert held_back.ways["with feedforward"].peak_error == pytest.approx(made.peak_error)


def test_sensors_with_a_spring_follow_as_they_are_moved_slowly() -> None:
    """Of a table on a spring the motor goes further, by what the screw yields."""
    m, k, ground = np.array([2.0, 5.0]), 300.0, 40.0
    K = np.array([[k, -k], [-k, k + ground]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K / m[:, None], -0.01 * K / m[:, None]]])
    G = StateSpace(A, np.array([[0.0], [0.0], [0.5], [0.0]]), np.eye(2, 4), np.zeros((2, 1)))
    at = kind_of(problem_of(load_case(EXAMPLE / "case.toml"))).bounds().places
    static = np.linalg.solve(K, [1.0, 0.0])
    np.testing.assert_allclose(course(G, 0, at)[1], static / static[1], rtol=1e-6)


@pytest.mark.slow
def test_robustness_judges_the_deployed_controller_at_every_place(
    deployed: tuple[FinishedRun, Deployment], tmp_path: Path
) -> None:
    run, found = deployed
    (tmp_path / "controller.json").write_text(json.dumps(controller_dict(found)))
    given = with_controller(run, tmp_path / "controller.json")
    K = found.realisation.system
    for one in (given, as_it_runs(run)):
        assert one.figures.sensitivity_peak == pytest.approx(broken(K, DELAY)[1].max(), rel=1e-5)
    off = judge(given, given.modal(Perturbation(0.03)), (0.03,))
    assert off.peak == pytest.approx(broken(K, DELAY, 0.03)[1].max(), rel=1e-5)
    study = robustness(given, Demands(samples=1))
    slow, S = broken(K, DELAY)
    assert study.peaks[0][0] == pytest.approx(S.max(), rel=1e-5)
    least = 1.0 / study.margins.inputs.alpha  # ‖S_u - ½‖∞ is at least ‖S_u‖∞ - ½
    assert least >= S[2].max() - 0.5
    near = int(np.argmin(np.abs(slow - 2.0 * HZ)))
    A, B = axis()
    G = np.linalg.solve(1j * slow[near] * np.eye(4) - A, B + 0j)[1, 0]
    assert study.statics.low == pytest.approx(S[2, near] * abs(G), rel=5e-3)


def test_an_unstable_or_tighter_case_is_named(tmp_path: Path) -> None:
    tight = by_hand(tmp_path, own=("outputs = [1, 0]", "outputs = [1, 0]\nS_max = 1.9"))
    with pytest.raises(UserError, match="leave out the rate"):
        deploy(tight, Timing(16_000.0))
    lost = deploy(by_hand(tmp_path, harder=4.0), Timing())
    assert not lost.stable
    assert not lost.passed
