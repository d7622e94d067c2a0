"""Budget and move of several sensors on one actuator, by formulas of its own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.two_encoders import DELAY, RATE, THETA, axis, by_hand, held
from scipy.linalg import expm, matrix_balance, solve_discrete_lyapunov

from ccd_casadi.budget.evaluation import evaluate_budget
from ccd_casadi.budget.sources import (
    ErrorBudget,
    ErrorSource,
    ShapedSpectrum,
    SourceKind,
    TabulatedSpectrum,
)
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.result_entries import budget_entry, move_entry
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.lti.loop import Loop, tustin
from ccd_casadi.support.text import HZ

LOOP = "[loop]\nrate_hz = 8000.0\ndelay_us = 187.5\n"
KINDS = (SourceKind.FORCE, SourceKind.SENSOR_NOISE, SourceKind.SETPOINT)


def some(suite: SourceKind) -> list[Any]:
    """All kinds, of which the suite has one."""
    return [kind if kind is suite else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS]
MOVE = """[move]
distance = 0.05
velocity = 0.5
acceleration = 4.0
jerk = 200.0
snap = 2e4
settle_band = 2e-9
[budget.force]
unit = "N^2/Hz"
level = 4.0
poles_hz = [50.0]
[budget.sensor_noise]
unit = "m^2/Hz"
level = 1e-20
[loop]"""


def loop_of(run: FinishedRun) -> Loop:
    return run.loop_on(run.plant.plant_si())


def gains(K: object, z: np.ndarray) -> np.ndarray:
    """K (k, 2) at points of its plane."""
    A, B, C, D = (np.asarray(getattr(K, name)) for name in "ABCD")
    return (C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B + 0j) + D)[:, 0]


def error_of(kind: SourceKind, free: np.ndarray, G: np.ndarray, K: np.ndarray) -> np.ndarray:
    """‖H_e‖² (k,) of the table; `free` of a disturbing force, G of the actuator's, (k, 2)."""
    D = 1.0 + (G * K).sum(1)
    if kind is SourceKind.FORCE:  # y = free d + G u, u = -K y
        table = free[:, 1] - G[:, 1] * (K * free).sum(1) / D
        return np.abs(table) ** 2
    if kind is SourceKind.SENSOR_NOISE:  # independent ones
        return (np.abs(G[:, 1:] * K / D[:, None]) ** 2).sum(1)
    return np.abs(1.0 - G[:, 1] * K.sum(1) / D) ** 2


def response(s: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return np.linalg.solve(s[:, None, None] * np.eye(4) - A, B + 0j)[:, :2, 0]


@pytest.mark.parametrize("kind", some(SourceKind.SENSOR_NOISE))
def test_a_continuous_budget_is_the_integral_of_its_fractions(
    tmp_path: Path, kind: SourceKind
) -> None:
    loop = loop_of(by_hand(tmp_path, loop=(LOOP, "")))
    source = ErrorSource("own", kind, ShapedSpectrum(2.0, poles=((30.0,), (400.0,))))
    found = evaluate_budget(loop, ErrorBudget((source,)))
    assert found is not None
    assert found.disagreement < 1e-6
    hz = np.geomspace(1e-3, 1e5, 400_000)
    s, (A, B) = 1j * HZ * hz, axis()
    G, K = response(s, A, B), gains(loop.controller, s)
    density = 2.0 / np.abs((1.0 + 1j * hz / 30.0) * (1.0 + 1j * hz / 400.0)) ** 2
    parts = error_of(kind, G, G, K) * density
    own = np.trapezoid(parts * hz, np.log(hz)) + parts[0] * hz[0]  # and below the grid
    assert found.error**2 == pytest.approx(own, rel=1e-5)


@pytest.mark.parametrize("kind", some(SourceKind.FORCE))
def test_a_table_in_a_sampled_loop_is_the_integral_of_its_fractions(
    tmp_path: Path, kind: SourceKind
) -> None:
    loop = loop_of(by_hand(tmp_path))
    source = ErrorSource("own", kind, TabulatedSpectrum((1.0, 3000.0), (5.0, 5.0)))
    found = evaluate_budget(loop, ErrorBudget((source,)))
    assert found is not None
    hz = np.geomspace(1.0, 3000.0, 200_000)
    z, (A, B) = np.exp(1j * HZ * hz / RATE), axis()
    F, now, before, d = held(0.0, 1.0 / RATE, DELAY)
    drive = now[None] * (z**-d)[:, None, None] + before[None] * (z ** -(d + 1))[:, None, None]
    G = np.linalg.solve(z[:, None, None] * np.eye(4) - F, drive)[:, :2, 0]
    K = gains(tustin(loop.controller, 1.0 / RATE), z)
    own = np.trapezoid(5.0 * error_of(kind, response(1j * HZ * hz, A, B), G, K) * hz, np.log(hz))
    assert found.error**2 == pytest.approx(own, rel=1e-5)


@pytest.mark.parametrize("kind", KINDS[:2])
def test_white_noise_in_a_sampled_loop_has_its_covariance(tmp_path: Path, kind: SourceKind) -> None:
    loop, T = loop_of(by_hand(tmp_path)), 1.0 / RATE
    source = ErrorSource("own", kind, ShapedSpectrum(3.0))
    found = evaluate_budget(loop, ErrorBudget((source,)))
    assert found is not None
    F, now, before, d = held(0.0, T, DELAY)
    K = tustin(loop.controller, T)
    k = len(K.A)
    n = 4 + d + 1 + k  # x, u of the last d + 1 periods, K's states
    X, enters = np.zeros((n, n)), np.zeros((n, 2))
    X[:4, :4], X[:4, 4 + d : 5 + d] = F, before
    X[:4, 3 + d : 4 + d] += now  # u_{k-d}, d > 0 here
    X[5 : 5 + d, 4 : 4 + d] = np.eye(d)
    X[4, :2], X[4, 5 + d :] = -K.D[0], K.C[0]
    X[5 + d :, :2], X[5 + d :, 5 + d :] = -K.B, K.A
    enters[4], enters[5 + d :] = -K.D[0], -K.B
    Q = 3.0 / (2.0 * T) * enters @ enters.T  # of samples
    if kind is SourceKind.FORCE:
        A, B = axis()
        t, weight = np.polynomial.legendre.leggauss(40)
        parts = [expm(A * T * 0.5 * (1.0 + x)) @ B for x in t]
        Q = np.zeros((n, n))
        for w, part in zip(weight, parts, strict=True):
            Q[:4, :4] += 3.0 / 2.0 * 0.5 * T * w * part @ part.T
    even, (scale, _) = matrix_balance(X, permute=False, separate=True)
    P = solve_discrete_lyapunov(even, Q / np.outer(scale, scale)) * np.outer(scale, scale)
    assert found.error**2 == pytest.approx(P[1, 1], rel=1e-6)
    assert found.force**2 == pytest.approx(
        float(X[4] @ P @ X[4] + (Q[4, 4] if kind is SourceKind.SENSOR_NOISE else 0.0)), rel=1e-6
    )


def test_a_case_with_move_and_budget_reports_both(tmp_path: Path) -> None:
    run = by_hand(tmp_path, move=("[loop]", MOVE))
    found = move_entry(run.problem, THETA, run.controller)["move"]
    budget = budget_entry(run.problem, THETA, run.controller)["budget"]
    motor = 1.0 / axis()[1][2, 0]
    assert found["feedforward"][2] == pytest.approx([motor + 120.0], rel=1e-9)
    assert found["reached"]["acceleration"] == pytest.approx(4.0)
    assert found["peak_force"] == pytest.approx(4.0 * (motor + 120.0), rel=1e-9)
    assert {one["kind"] for one in budget["sources"]} == {"force", "sensor_noise"}
    whole = evaluate_budget(loop_of(run), run.problem.budget)
    assert whole is not None
    assert budget["error_rms"] == pytest.approx(whole.error)
    assert budget["error_rms_largest"] >= budget["error_rms"]
    profile = motion_of(run.problem, THETA).cycle.profile
    T, K = 1.0 / RATE, tustin(run.controller, 1.0 / RATE)
    time = np.arange(4000) * T
    r = profile.at(time)
    half = [(profile.at(time + T / 2)[i] - profile.at(time - T / 2)[i]) / T for i in range(4)]
    ahead = np.vstack([r[:1], half]).T @ np.array(found["feedforward"])[:, 0]
    F, now, before, d = held(0.0, T, DELAY)
    x, z, sent, errors = np.zeros(4), np.zeros(len(K.A)), [0.0] * (d + 2), []
    for wanted, extra in zip(r[0], ahead, strict=True):
        e = wanted - x[:2]
        errors.append(abs(e[1]))
        sent = [float((K.C @ z + K.D @ e)[0] + extra), *sent[:-1]]
        z = K.A @ z + K.B @ e
        x = F @ x + now[:, 0] * sent[d] + before[:, 0] * sent[d + 1]
    late = np.flatnonzero(np.array(errors) > found["window"])
    assert len(late), "the error leaves its window"
    settled = max(time[late[-1] + 1], found["duration"])
    assert found["settled"] == pytest.approx(settled, abs=1.01 * T)


def test_the_moves_force_follows_the_hardware(tmp_path: Path) -> None:
    """The slope of the peak force to θ, which constraints of motors have, by differences."""
    run = by_hand(tmp_path, move=("[loop]", MOVE))
    at = motion_of(run.problem, THETA)
    slope = at.slopes(lambda cycle: cycle.peak_force)
    for i, step in enumerate((1e-4, 1e-4)):
        moved = np.array(THETA)
        values = []
        for sign in (1.0, -1.0):
            moved = np.array(THETA)
            moved[i] += sign * step
            values.append(float(np.real(motion_of(run.problem, moved).cycle.peak_force)))
        assert slope[i] == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=1e-5)
