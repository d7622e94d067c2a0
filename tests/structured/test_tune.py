"""One call from a plant that exists to a controller, and the same as a command."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import control
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from oracles import random_tunes
from oracles.helpers import few
from scipy.io import savemat
from scipy.signal import cont2discrete
from test_measured import two_by_two

import ccd_casadi as ccd
from ccd_casadi import report
from ccd_casadi.extensions.measured import main, tuned_plants, tuning
from ccd_casadi.extensions.measured.line_problem import line_problem
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.judgement import judge_lines, judge_loops
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.interchange import from_control
from surrogates.lazy_names import from_stub

s = control.tf("s")
LAGS = 1.0 / (s + 1.0) ** 3


def judged(plant: object, K: object, rate: float, delay: int = 0) -> float:
    """‖S‖∞ on a fine grid by SciPy and python-control; infinite where a pole is unstable."""
    G = control.ss(plant)
    A, B, C, D, _ = cont2discrete((G.A, G.B, G.C, G.D), 1.0 / rate)
    late = control.ss(control.tf([1], [1] + [0] * delay, 1.0 / rate))
    held = control.ss(A, B, C, D, 1.0 / rate) * late
    k = control.ss(*cont2discrete((K.A, K.B, K.C, K.D), 1.0 / rate, "bilinear")[:4], 1.0 / rate)  # type: ignore[attr-defined]
    S = control.feedback(1, held * k)
    if np.abs(S.poles()).max() >= 1.0:
        return float(np.inf)
    return float(np.abs(response_at(S, np.linspace(1e-4, np.pi, 20000))).max())


def response_at(S: control.StateSpace, angle: np.ndarray) -> np.ndarray:
    """C (z - A)⁻¹ B + D at z = exp(j·angle), by dense solves: python-control loops over points."""
    z = np.exp(1j * angle)[:, None, None]
    found = S.C @ np.linalg.solve(z * np.eye(len(S.A)) - S.A, S.B.astype(complex)) + S.D
    return found[:, 0, 0]


@pytest.mark.parametrize(
    ("plant", "rate", "delay"),
    [
        (LAGS, 20.0, 0),
        (1.0 / (s**2 * (s + 10.0)), 200.0, 1),
        (1.0 / (s - 1.0), 50.0, 0),
        ([1.0 / (s**2 + 0.1 * s + a) for a in (1.0, 1.3)], 50.0, 2),
        ((1.0 - s) / (s + 1.0) ** 3, 20.0, 0),
    ],
)
def test_models_are_tuned_and_judged_apart(plant: object, rate: float, delay: int) -> None:
    """Integrating, unstable, resonant and non-minimum-phase ones, by other libraries alone."""
    found = ccd.tune(plant, rate_hz=rate, delay=delay / rate, starts=4)
    assert found.design.usable, found.design.words
    for one, norm in zip(plant if isinstance(plant, list) else [plant], found.norms, strict=True):
        S = judged(one, found.controller, rate, delay)
        assert norm is not None
        assert S <= norm * (1.0 + 1e-6) <= 1.8 * (1.0 + 1e-6)
        assert norm == pytest.approx(S, rel=1e-3)


@pytest.mark.parametrize("seed", [1053])
def test_lines_are_added_until_the_model_agrees(seed: int) -> None:
    """Light resonances make |S| between two lines exceed S_max: these plants were refused."""
    found = random_tunes.run(seed, 2)
    assert found["usable"], found["words"]
    assert found["S_over_S_max"] <= 1.0
    assert found["bandwidth_over_crossing"] <= 1.0 + 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_a_controller_of_steep_leads_keeps_the_digits_of_S(seed: int) -> None:
    """|S| by the matrices of the closed loop, and by 1/(1 + GK): 1e-8, where the states of a
    cascade, twenty decades apart, keep 1e-6 or nothing."""
    rng = np.random.default_rng(seed)
    structure = ccd.Structure(lead=3, biquads=1, roll_off=1)
    period, omega, middle = 5e-4, HZ * np.geomspace(1.0, 900.0, 40), HZ * np.array([30.0])
    kappa = np.log(HZ * 10.0 ** rng.uniform(0.0, 2.0, len(structure.names)))
    for i, name in enumerate(structure.names):
        if name.startswith("lead") and name.endswith("zero"):
            kappa[i] = np.log(10.0 ** rng.uniform(-3.0, 0.0))
        elif name.endswith("pole") or name.startswith("roll-off"):
            kappa[i] = np.log(rng.uniform(1e3, 3e4))
        elif "damping" in name:
            kappa[i] = np.log(rng.uniform(0.1, 1.0))
    G = StateSpace(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]),
                   np.array([[1.0, 0.0]]), np.zeros((1, 1)))  # fmt: skip
    held = zoh(G, period, 0.0)
    first = tustin(structure.state_space(kappa).balance(), period)
    kappa[0] -= np.log(np.abs((held.response(middle) * first.response(middle)).item()))
    K = tustin(structure.state_space(kappa).balance(), period)
    by_product = 1.0 / (1.0 + held.response(omega) * K.response(omega))[:, 0, 0]
    by_matrices = closed_loop(held, K).S.response(omega)[:, 0, 0]
    np.testing.assert_allclose(by_matrices, by_product, rtol=1e-7)


def test_every_form_of_a_plant_is_the_same_plant(tmp_path: Path) -> None:
    """A state space, a sampled one, its response and its matrices in a file: one bandwidth."""
    sampled = control.sample_system(control.ss(LAGS), 0.1)
    omega = np.geomspace(1e-2, 0.98 * np.pi / 0.1, 400)
    lines = control.FRD(sampled(np.exp(0.1j * omega)), omega)
    plants = (LAGS, control.ss(LAGS), sampled, lines)
    found = [ccd.tune(plant, rate_hz=10.0, starts=4).design for plant in plants]
    savemat(tmp_path / "plant.mat", {part: getattr(control.ss(LAGS), part) for part in "ABCD"})
    found.append(ccd.tune(tmp_path / "plant.mat", rate_hz=10.0, starts=4).design)
    assert all(design.usable for design in found)
    np.testing.assert_allclose([d.bandwidth / found[0].bandwidth for d in found], 1.0, rtol=1e-2)


@pytest.mark.parametrize(("place", "wrong"), [(tuned_plants, "zoh"), (tuning, "realise_blocks")])
def test_what_a_search_gets_wrong_the_judge_refutes(
    monkeypatch: pytest.MonkeyPatch, place: ModuleType, wrong: str
) -> None:
    """A plant with a third of its gain, and code with a third of the controller's."""
    right = getattr(place, wrong)

    def third(system: StateSpace, *others: float) -> object:
        return right(replace(system, C=system.C / 3.0, D=system.D / 3.0), *others)

    monkeypatch.setattr(place, wrong, third)
    found = ccd.tune(1.0 / (s**2 * (s + 10.0)), rate_hz=200.0, starts=4)
    assert found.judge.passed is False
    assert not found.design.usable
    assert "does not confirm it" in found.design.words


def test_a_judge_without_an_answer_has_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*of: object, **others: object) -> None:
        raise np.linalg.LinAlgError("no eigenvalues")

    monkeypatch.setattr(tuning.judgement, "judge_loops", fails)
    found = ccd.tune(LAGS, rate_hz=20.0, starts=2)
    assert found.judge.passed is None
    assert not found.design.usable


@pytest.mark.slow
@few(max_examples=25)
@given(st.integers(0, 10**6), st.floats(0.05, 20.0), st.integers(0, 2), st.booleans())
def test_lines_are_judged_as_the_poles_of_the_loop_are(
    seed: int, harder: float, integrators: int, unstable: bool
) -> None:
    """A plant of two channels under PI control: stability, the peak on the lines, the bandwidth."""
    rng = np.random.default_rng(seed)
    lag = control.tf([1.0], [0.1, 1.0]) if not unstable else control.tf([1.0], [0.5, -1.0])
    free = control.tf([1.0], [1.0, 0.0]) ** integrators
    mode = control.tf([1.0], [1e-2, 0.02 * rng.uniform(0.5, 5.0), 1.0])
    one = control.ss(lag * free * mode)
    mix = np.eye(2) + 0.3 * rng.standard_normal((2, 2))
    G = control.append(one, one) * mix
    pid = control.ss(harder * control.tf([1.0, 0.2], [1.0, 0.0]))
    if integrators:
        pid = pid * control.tf([2.0, 1.0], [0.02, 1.0]) ** integrators
    K = control.append(pid, pid) * np.linalg.inv(mix)
    loop = control.feedback(control.ss([], [], [], np.eye(2)), G * K)
    poles = loop.poles()
    assume(np.abs(poles.real / np.abs(poles)).min() > 1e-3)
    hz = np.geomspace(1e-3, 1e3, 4000) / HZ
    matrix = np.moveaxis(G(2j * np.pi * hz), -1, 0)
    lines = MeasuredResponse(hz, matrix, 2 * unstable, integrators)
    S = np.linalg.norm(np.moveaxis(loop(2j * np.pi * hz), -1, 0), 2, axis=(1, 2))
    crossing = HZ * hz[np.argmax(np.sqrt(0.5) < S)] * 0.99
    bounds = Bounds(1.001 * max(S.max(), 1.001), 2.0, HZ * hz[0])
    system = StateSpace(K.A, K.B, K.C, K.D)
    found = judge_lines(lines, system, bounds, 0.0, crossing, True)
    stable = bool((poles.real < 0.0).all())
    assert found.passed is stable, found.words
    if stable:
        assert not judge_lines(lines, system, bounds, 0.0, 1.1 * crossing, True).passed
        less = replace(bounds, S_max=1.0 + 0.99 * (bounds.S_max / 1.001 - 1.0))
        assert not judge_lines(lines, system, less, 0.0, crossing, True).passed


def test_effort_bounds_the_controller_and_costs_bandwidth() -> None:
    free, less = (ccd.tune(LAGS, rate_hz=20.0, starts=4, effort=e).design for e in (None, 5.0))
    assert free.figures is not None
    assert less.figures is not None
    assert less.bandwidth < free.bandwidth
    omega = less.bandwidth * np.geomspace(0.5, 2.0, 200)
    mean = np.exp(np.log(np.abs(LAGS(1j * omega))).mean())
    assert less.figures.KS <= 5.0 / mean * 1.1 < free.figures.KS


def test_the_bound_of_effort_has_its_slope() -> None:
    bounds = ccd.Bounds(1.8, 1.8, ccd.HZ, 1.1)
    problem = line_problem([two_by_two(1.0).entry(np.eye(2)[0], np.eye(2)[0], 600)],
                           ccd.Structure(biquads=0), bounds, effort=20.0)  # fmt: skip
    for tau in (-3.0, -1.3, -0.2):
        ends = [problem.ceiling(tau + h)[0] for h in (1e-6, -1e-6)]
        assert problem.ceiling(tau)[1] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-4)


@pytest.mark.parametrize(
    ("plant", "how", "words"),
    [
        ([], {}, "no plant"),
        (LAGS, {}, "rate_hz is missing"),
        (s / (s + 1.0) ** 2, {"rate_hz": 10.0}, "a zero at 0"),
        ((s + 2.0) / (s + 1.0), {"rate_hz": 10.0}, "feedthrough"),
        (control.sample_system(LAGS, 0.1), {"rate_hz": 20.0},
         "plant is sampled at 10 Hz and the controller at 20 Hz; give the plant's rate"),
        (control.sample_system(LAGS, 0.1), {"delay": 0.05},
         "the delay is 0.05 s, 0.5 periods of 0.1 s, and the plant is sampled; give whole periods"),
        ("none.csv", {}, "cannot be read"),
        (LAGS, {"rate_hz": 2e3, "delay": 300.0},
         "delay 300 s is 600000 samples at 2000 Hz: is it in microseconds"),
        (LAGS, {"rate_hz": 2e3, "delay": -0.1}, "delay: is -0.1; give it in s, 0 or more"),
        (LAGS, {"rate_hz": 2e3, "delay": np.nan}, "delay: is nan"),
        (MeasuredResponse(np.arange(1.0, 9.0), 1.0 / (1.0 + 1j * np.arange(1.0, 9.0))),
         {"delay": 300.0}, "delay 300 s is 4800 samples at 16 Hz"),
        (LAGS, {"rate_hz": 10.0, "S_max": 1.0}, "S_max: is 1; no loop has less than 1"),
        (LAGS, {"rate_hz": 10.0, "S_max": np.nan}, "S_max: is nan"),
        (LAGS, {"rate_hz": 10.0, "shape": 0.9}, "shape: is 0.9; give 1 or more"),
        (LAGS, {"rate_hz": -10.0}, "rate_hz: is -10; give a number above 0"),
    ],
)  # fmt: skip
def test_what_is_no_plant_is_said(plant: object, how: dict, words: str) -> None:
    with pytest.raises(UserError, match=words):
        ccd.tune(plant, **how)


@pytest.mark.slow
def test_what_no_pid_stabilises_is_said() -> None:
    found = ccd.tune(1.0 / (s - 1.0), rate_hz=50.0, delay=2.0, starts=2)
    assert found.controller is None
    assert "no start is stable" in found.design.words


def test_the_call_is_public() -> None:
    assert {"tune", "Tuned"} <= set(from_stub("ccd_casadi"))
    assert "tune" in ccd.__all__


def written(path: Path, found: MeasuredResponse) -> str:
    np.savez(path, f_hz=found.hz, G=found.G)
    return str(path)


def test_the_command_writes_what_can_be_built(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two channels, a set of two; the C code gives what its own test expects."""
    files = [written(tmp_path / f"{i}.npz", two_by_two(g)) for i, g in enumerate((1.0, 1.2))]
    out = tmp_path / "out"
    words = ["--rate", "1000", "--biquads", "0", "--lead", "0", "--out", str(out), "--workers", "1"]
    assert main([*files, *words, "--s-max", "1.7"]) == 0
    said = capsys.readouterr().out
    assert all(word in said for word in ("bandwidth", "margins", "integrator", "report.html"))
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "verified"
    assert result["sensitivity_peak"] <= 1.7 * (1.0 + 1e-5)
    page = (out / "report.html").read_text()
    assert "0.npz, 1.npz" in page
    assert "N m/rad" not in page
    subprocess.run(["cc", "-std=c99", "-ffp-contract=off", "-o", "t", "controller.c",
                    "controller_test.c", "-lm"], cwd=out, check=True)  # fmt: skip
    subprocess.run(["./t"], cwd=out, check=True, capture_output=True)
    (out / "report.html").unlink()
    assert report.main([str(out)]) == 0  # it has no design over theta, and so no index
    assert (out / "report.html").read_text() == page
    assert not (out / "index.html").exists()


def test_the_command_says_why_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A response without low lines; and a file that is none."""
    one = two_by_two(1.0)
    high = MeasuredResponse(one.hz[one.hz > 24.0], one.G[one.hz > 24.0, 0, 0])
    code = main([written(tmp_path / "a.npz", high), "--rate", "1000", "--quiet", "--workers", "1"])
    said = capsys.readouterr().err
    assert code in (3, 4)
    assert "a.npz: " in said
    assert main([str(tmp_path / "none.csv"), "--quiet"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_rotary_plant_is_shown_in_its_own_units(tmp_path: Path) -> None:
    model = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [50.0]], "C": [[1.0, 0.0]], "D": [[0.0]]}
    savemat(tmp_path / "axis.mat", model)
    words = [str(tmp_path / "axis.mat"), "--rate-hz", "2000", "--biquads", "0", "--quiet"]
    assert main([*words, "--workers", "1", "--out", str(tmp_path), "--rotary"]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "N m/rad" in page
    assert "N/m" not in page


@pytest.fixture(scope="module")
def of_a_stage() -> tuple[StateSpace, ccd.Tuned]:
    """A mass with a mode, and its controller."""
    plant = control.ss(1.0 / (10.0 * s**2) + 0.02 / (s**2 + 20.0 * s + 2000.0**2))
    return from_control(plant), ccd.tune(plant, rate_hz=8000.0, starts=2)


@pytest.mark.parametrize("off", [0.0, 1e-6, 5.3e-5, -5.3e-5, 1e-3, 0.02, -0.02, 0.5, -0.5, 9.0])
def test_what_is_written_is_judged_however_far_it_is_from_the_controller(
    of_a_stage: tuple[StateSpace, ccd.Tuned], off: float
) -> None:
    """Rounding of the code is no reason to refuse it, a bound or a bandwidth that is lost is."""
    plant, found = of_a_stage
    K, bounds, rate = found.controller, found.case.bounds, 8000.0
    assert K is not None
    assert found.design.usable
    right = tuning.realise_blocks(tustin(K, 1.0 / rate)).as_coded
    coded = replace(right, C=(1.0 + off) * right.C, D=(1.0 + off) * right.D)
    judge = judge_loops([plant], K, coded, bounds, Sampling(rate), found.design.bandwidth, True)
    peak = judged(control.ss(*(getattr(plant, part) for part in "ABCD")),
                  replace(K, C=(1.0 + off) * K.C, D=(1.0 + off) * K.D), rate)  # fmt: skip
    if abs(off) <= 1e-3:  # within what the search leaves of S_max, and of the bandwidth
        assert peak <= bounds.S_max
        assert judge.passed
    if not peak <= bounds.S_max * (1.0 + 1e-4) or off <= -0.02:
        assert judge.passed is False
    assert ("coefficients of the code" in judge.words) == (abs(off) > 1e-5 and np.isfinite(peak))
    if np.isfinite(peak):
        assert judge.figures["S_max"] * bounds.S_max == pytest.approx(peak, rel=1e-3)
