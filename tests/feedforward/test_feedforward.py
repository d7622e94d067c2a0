"""Feedforward for a set: against simulations written apart, other coefficients, the C code."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward, held_setpoint
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.extensions.feedforward.coefficients import (
    ForceLimits,
    LeastTimeOptions,
    MoveResponses,
    Shape,
    contraction,
    learn,
    learning_gain,
    least_error,
    least_time,
    responses_of,
)
from ccd_casadi.extensions.feedforward.feedforward_files import (
    OF_DESIGN,
    improve,
    read_error,
    write_code,
)
from ccd_casadi.extensions.feedforward.set_feedforward import FeedforwardSetOptions, _shapes
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

SAMPLING = Sampling(1000.0, 500.0)
MOVE = setpoint(MoveLimits(0.01, 0.5, 10.0, 1e4, 1e7))
ORDERS = (2, 3, 4)
WINDOW, SAMPLES = 1e-5, 700


def plant(mass: float = 10.0, hz: float = 60.0, damping: float = 0.01) -> StateSpace:
    """A free body, and a mode that the force and the sensor meet with opposite signs."""
    w = 2.0 * np.pi * hz
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[3, 2:] = -w * w, -2.0 * damping * w
    B = np.array([[0.0], [1.0 / mass], [0.0], [1.0 / mass]])
    C = np.array([[1.0, 0.0, -0.3, 0.0]])
    return StateSpace(A, B, C, np.zeros((1, 1)))


def controller(hz: float = 5.0, mass: float = 10.0) -> StateSpace:
    """PD of a mass behind a roll-off."""
    w = 2.0 * np.pi * hz
    A, B = np.array([[-12.0 * w]]), np.array([[1.0]])
    slope = mass * w * 12.0 * w  # of the lead
    return StateSpace(A, B, np.array([[-slope * 11.0 * w]]), np.array([[slope]]))


def loop(**of: float) -> Loop:
    return Loop(plant(**of), controller(), SAMPLING)


LOOPS = [loop(), *(loop(hz=hz, damping=z) for hz in (57.0, 63.0) for z in (0.006, 0.015))]


def responses(some: list[Loop] = LOOPS) -> list[MoveResponses]:
    return [responses_of(one, MOVE, ORDERS, axis=0, samples=SAMPLES) for one in some]


def inverse(shape: Shape) -> Array:
    F = feedforward(plant(), SAMPLING.period, SAMPLING.delay)[:, :, 0]
    return shape.join(np.ones(1), F[None])


def test_one_tap_is_the_move_that_simulate_makes() -> None:
    shape = Shape(ORDERS, 1)
    x = inverse(shape)
    F = shape.split(x)[1][0]
    made = simulate(LOOPS[1], MOVE, axis=0, forces=F, window=WINDOW, bandwidth_hz=5.0)
    (found,) = responses(LOOPS[1:2])
    count = min(len(made.time), SAMPLES)
    r = held_setpoint(MOVE, made.time[:count], SAMPLING.period)[0]
    np.testing.assert_allclose(
        r - (found.reached @ x)[:count, 0], made.error[:count], rtol=0.0, atol=1e-12
    )
    np.testing.assert_allclose((found.force @ x)[:count], made.force[:count], rtol=0.0, atol=1e-8)
    assert found.peak(x) == pytest.approx(float(made.peak_force.max()))


def test_taps_delay_and_sum() -> None:
    """Each tap alone is the response of the first, later by its samples."""
    shape, (found,) = Shape(ORDERS, 1, 3, 7), responses(LOOPS[:1])
    shaped = found.with_taps(shape)
    rng = np.random.default_rng(0)
    h, F = rng.random(3), rng.random((3, 5, 1))
    whole = shaped.reached @ shape.join(h, F)
    one, by_hand = Shape(ORDERS, 1), np.zeros_like(whole)
    for i in range(3):
        part = found.reached @ one.join(h[i : i + 1], F[i : i + 1])
        by_hand[7 * i :] += part[: len(part) - 7 * i]
    np.testing.assert_allclose(whole, by_hand, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("shape", [Shape(ORDERS, 1), Shape(ORDERS, 1, 2, 8)])
def test_it_is_the_least_time_within_the_inverses_forces(shape: Shape) -> None:
    plants, x = responses(), inverse(Shape(ORDERS, 1))
    limits = ForceLimits(max(p.peak(x) for p in plants), max(p.heat(x) for p in plants))
    before = max(p.settling_time(x, WINDOW) for p in plants)
    found = least_time(plants, shape, WINDOW, limits, before, inverse(shape))
    assert found is not None
    shaped = [one.with_taps(shape) for one in plants]
    latest = max(one.settling_time(found.x, WINDOW) for one in shaped)
    assert latest <= found.time + 1e-12 < before
    assert max(one.peak(found.x) for one in shaped) <= limits.peak * 1.002
    assert max(one.heat(found.x) for one in shaped) <= limits.heat * 1.003
    h, _ = shape.split(found.x)
    assert h.sum() == pytest.approx(1.0)
    assert h.min() >= -1e-12
    # no coefficients beside them leave less from that time on: it is a convex optimum
    first = round(found.time / SAMPLING.period)
    left = max(float(np.abs(one.error(found.x)[first:]).max()) for one in shaped) / WINDOW
    assert left == pytest.approx(found.left, rel=1e-2)
    rng = np.random.default_rng(1)
    for size in np.geomspace(1e-6, 1e-2, 60):
        x = found.x * (1.0 + size * rng.standard_normal(shape.count))
        x[: shape.taps] = np.maximum(x[: shape.taps], 0.0) / np.maximum(x[: shape.taps], 0.0).sum()
        if max(one.peak(x) for one in shaped) > limits.peak or any(
            one.heat(x) > limits.heat for one in shaped
        ):
            continue
        error = max(float(np.abs(one.error(x)[first:]).max()) for one in shaped)
        assert error >= WINDOW * found.left * (1.0 - 5e-3)


def test_a_shaper_settles_earlier_where_a_mode_rings() -> None:
    plants, x = responses(), inverse(Shape(ORDERS, 1))
    limits = ForceLimits(max(p.peak(x) for p in plants), max(p.heat(x) for p in plants))
    times = []
    for shape in (Shape(ORDERS, 1), Shape(ORDERS, 1, 2, 8)):
        found = least_time(plants, shape, WINDOW, limits, 0.001 * SAMPLES, inverse(shape))
        assert found is not None
        times.append(found.time)
    assert times[1] < times[0]


@pytest.mark.parametrize("some", [LOOPS[:1], LOOPS])
def test_the_inverse_is_a_solution_once_it_is_within_the_window_less_the_margin(
    some: list[Loop],
) -> None:
    """Also where no coefficients are earlier: where the search ends there is one."""
    plants, x, shape = responses(some), inverse(Shape(ORDERS, 1)), Shape(ORDERS, 1)
    limits = ForceLimits(max(p.peak(x) for p in plants), max(p.heat(x) for p in plants))
    for window in np.geomspace(1e-6, 1e-3, 7):
        margin = LeastTimeOptions().margin
        latest = max(p.settling_time(x, (1.0 - margin) * window) for p in plants)
        if np.isfinite(latest):
            found = least_time(plants, shape, float(window), limits, latest, x)
            assert found is not None
            assert found.time <= latest + SAMPLING.period


def test_a_time_that_is_too_early_is_refused() -> None:
    plants, shape = responses(), Shape(ORDERS, 1)
    limits = ForceLimits(1e3, 1e6)
    assert least_time(plants, shape, WINDOW, limits, 0.25 * MOVE.duration, inverse(shape)) is None


@hypothesis_settings(max_examples=8)
@given(st.floats(0.95, 1.05), st.floats(0.95, 1.05), st.booleans())
def test_three_learned_moves_end_near_their_floor(mass: float, hz: float, shaped: bool) -> None:
    """A plant whose mass and mode are wrong by 5 %: 10 % above the least error at most."""
    shape = Shape(ORDERS, 1, 2, 8) if shaped else Shape(ORDERS, 1)
    true = responses([loop(mass=10.0 * mass, hz=60.0 * hz)])[0].with_taps(shape)
    model = responses(LOOPS[:1])[0].with_taps(shape)
    gain, x = learning_gain(model, shape), inverse(shape)
    for _ in range(3):
        x = learn(x, true.tracking(x, shape), gain, shape)
    rms = float(np.sqrt(np.mean(true.tracking(x, shape) ** 2)))
    assert rms <= 1.1 * least_error(true, x, shape)
    assert contraction([true], gain, shape) < 1.0


def test_the_code_gives_what_is_designed(tmp_path: Path) -> None:
    """The C code drives a simulation of plant and controller written apart, sample by sample."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    shape = Shape(ORDERS, 1, 3, 5)
    rng = np.random.default_rng(3)
    h = rng.dirichlet(np.ones(3))
    F = shape.split(inverse(shape))[1] * rng.uniform(0.2, 1.0, (3, 5, 1)) + 0.01 * h[:, None, None]
    F[:, :2] = 0.0
    answer = {"shaper": h.tolist(), "forces": F.tolist(), "spacing": 5,
              "period": SAMPLING.period}  # fmt: skip
    write_code(tmp_path, answer)
    library = tmp_path / "feedforward.so"
    warnings = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run([compiler, *warnings, "-shared", "-fPIC", "-o", library,
                    tmp_path / "feedforward.c"], check=True)  # fmt: skip
    code = ctypes.CDLL(str(library))
    five = ctypes.c_double * 5
    state, wanted, force = (ctypes.c_double * 200)(), ctypes.c_double(), (ctypes.c_double * 1)()
    code.feedforward_reset(state)
    own = loop(hz=57.0)
    G, K = own.as_run
    x, z, y, u = np.zeros(len(G.A)), np.zeros(len(K.A)), [], []
    r = held_setpoint(MOVE, np.arange(300) * SAMPLING.period, SAMPLING.period)
    for k in range(300):
        code.feedforward_step(state, five(*r[:, k]), ctypes.byref(wanted), force)
        y.append((G.C @ x)[0])
        e = np.array([wanted.value]) - G.C @ x
        u.append((K.C @ z + K.D @ e)[0] + force[0])
        z = K.A @ z + K.B @ e
        x = G.A @ x + G.B[:, 0] * u[-1]
    found = responses([own])[0].with_taps(shape)
    design = shape.join(h, F)
    np.testing.assert_allclose(y, (found.reached @ design)[:300, 0], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(u, (found.force @ design)[:300, 0], rtol=0.0, atol=1e-8)


def test_what_is_no_log_is_refused_by_name(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    with pytest.raises(UserError, match="no such file"):
        read_error(log, 1.0)
    log.write_text("time,position\n0,1\n")
    with pytest.raises(UserError, match="no column `error`"):
        read_error(log, 1.0)
    log.write_text("time,error\n0,1e-6\n1,\n")
    with pytest.raises(UserError, match="line 3"):
        read_error(log, 1.0)
    log.write_text("time,error1,error2\n0,1e-6,2e-6\n1,3e-6,4e-6\n")
    np.testing.assert_allclose(read_error(log, 1.0), [[1e-6, 2e-6], [3e-6, 4e-6]])
    log.write_text("error2,error1\n2e-6,1e-6\n4e-6,3e-6\n")
    np.testing.assert_allclose(read_error(log, 1.0), [[1e-6, 2e-6], [3e-6, 4e-6]])
    log.write_text("time,error_um\n0,1\n1,2\n")
    with pytest.raises(UserError, match=r"error_um.*in m"):
        read_error(log, 1.0)
    log.write_text("")
    with pytest.raises(UserError, match="is empty"):
        read_error(log, 1.0)


@pytest.mark.parametrize("times", [
    np.arange(8.0) / 4000.0,  # of another rate
    np.arange(8.0) / 8.0,  # in ms
    np.delete(np.arange(9.0), 4) / 8000.0,  # a sample is lost
    np.array([0.0, 1.0, np.nan]) / 8000.0,
])  # fmt: skip
def test_times_of_another_rate_are_refused(tmp_path: Path, times: Array) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,error\n" + "".join(f"{t!r},1e-6\n" for t in times.tolist()))
    with pytest.raises(UserError, match=r"line \d.*'time'.*0\.000125 s"):
        read_error(log, 1.0 / 8000.0)
    # those of the controller, from any first one on, in the digits that a log has
    log.write_text("time,error\n" + "".join(f"{7 + i / 8000.0:.5f},1e-6\n" for i in range(8)))
    assert read_error(log, 1.0 / 8000.0).shape == (8, 1)


def test_what_is_learned_is_not_called_judged() -> None:
    """Figures of the coefficients before are unknown of those after; µm for m are refused."""
    shape, run = Shape(ORDERS, 1), cast(FinishedRun, SimpleNamespace(loop=loop()))
    h, F = shape.split(inverse(shape))
    before = {
        "axis": 1, "orders": list(ORDERS), "taps": 1, "spacing": 1, "samples": SAMPLES,
        "shaper": h.tolist(), "forces": F.tolist(), "contraction": 0.1, "learned": 0,
        "setpoint": {"durations": MOVE.durations.tolist(), "snaps": MOVE.snaps.tolist()},
        **dict.fromkeys(OF_DESIGN, 1.0),
    }  # fmt: skip
    error = 1e-6 * np.sin(np.arange(float(SAMPLES)))[:, None]
    after, words = improve(run, Path("feedforward.json"), before, error)
    assert after["learned"] == 1
    assert after["forces"] != before["forces"]
    assert all(after[name] is None for name in OF_DESIGN)
    assert any("unknown" in line for line in words)
    with pytest.raises(UserError, match="give the error in m"):
        improve(run, Path("feedforward.json"), before, 1e6 * error)


def test_a_loop_that_is_continuous_or_unstable_is_refused() -> None:
    with pytest.raises(UserError, match="sampled"):
        responses([Loop(plant(), controller())])
    with pytest.raises(UserError, match="not stable"):
        responses([Loop(plant(), controller(hz=60.0), SAMPLING)])


def test_a_margin_of_the_window_is_kept() -> None:
    plants, shape, limits = responses(), Shape(ORDERS, 1), ForceLimits(1e6, 1e9)
    found = [
        least_time(plants, shape, WINDOW, limits, 0.001 * SAMPLES, inverse(shape),
                   LeastTimeOptions(margin=margin))
        for margin in (0.0, 0.5)
    ]  # fmt: skip
    assert found[0] is not None
    assert found[1] is not None
    assert found[0].time <= found[1].time
    assert found[1].left <= 0.5 * 1.001


@pytest.mark.parametrize(("samples", "count"), [(1000, True), (5, False)])
def test_taps_are_of_resonances_and_within_the_move(samples: int, count: bool) -> None:
    """A real pole of a plant of first order, which is slow, has no period."""
    modal = SimpleNamespace(K=np.diag([100.0**2, 0.01]), numbered=np.array([0]), rigid=np.zeros(2))
    sampling = Sampling(1000.0, 0.0)
    run = SimpleNamespace(modal=lambda: modal, loop=SimpleNamespace(sampling=sampling), folder="")
    shapes = _shapes(cast(FinishedRun, run), Shape((2,), 1), 4, samples, FeedforwardSetOptions())
    assert (len(shapes) > 1) == count
    period = 2.0 * np.pi / 100.0 * sampling.rate_hz
    assert all(one.last <= 1.1 * max(FeedforwardSetOptions().spreads) * period for one in shapes)
    assert all(one.last < samples for one in shapes)
