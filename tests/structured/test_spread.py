"""A response with a spread: bounds hold for every plant within it, in the search and its judges."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ccd_casadi as ccd
from ccd_casadi.extensions.measured import main
from ccd_casadi.extensions.measured.line_problem import LineProblem, line_problem
from ccd_casadi.extensions.measured.measured_loop import controller_response, judge
from ccd_casadi.extensions.measured.tuned_plants import present_loop
from ccd_casadi.extensions.measured.tuning import Tuned, tune
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.design import DesignOptions
from ccd_casadi.fixed_structure.figures import constraints
from ccd_casadi.fixed_structure.judgement import judge_lines
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, RowPlaces
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import tustin
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

RATE = 5000.0


def response(share: float, lines: int = 500) -> MeasuredResponse:
    """A stage with a resonance and a delay of half a period."""
    hz = np.geomspace(1.0, 2000.0, lines)
    s = 1j * HZ * hz
    G = 1.0 / (2.0 * s**2 + 20.0 * s) + 0.3 / (s**2 + 48.0 * s + 1200.0**2)
    G = G * np.exp(-1e-4 * s)
    return MeasuredResponse(hz, G, spread=share * np.abs(G) if share else None)


@pytest.fixture(scope="module")
def tuned() -> Tuned:
    return tune(response(0.15), rate_hz=RATE, starts=4)


def test_the_worst_plant_of_every_disc_is_within_S_max(tuned: Tuned) -> None:
    """And the bound is reached: nothing is given away. Measured: 1.8 to 1e-6."""
    measured = response(0.15)
    assert tuned.design.usable
    K = controller_response(tuned.controller, measured.hz, 1.0 / RATE)[:, 0, 0]
    L = measured.G * K
    worst = measured.G - 0.15 * np.abs(L) / K * (1.0 + L) / np.abs(1.0 + L)
    S = 1.0 / np.abs(1.0 + worst * K)
    assert S.max() == pytest.approx(1.8, rel=1e-4)
    rng = np.random.default_rng(2)
    for _ in range(20):
        disc = np.sqrt(rng.random(len(L))) * np.exp(2j * np.pi * rng.random(len(L)))
        assert (1.0 / np.abs(1.0 + L + 0.15 * np.abs(L) * disc) <= S * (1.0 + 1e-9)).all()


@pytest.mark.slow
def test_a_spread_costs_bandwidth_and_a_factor_of_0_ignores_it(tuned: Tuned) -> None:
    plain = tune(response(0.15), rate_hz=RATE, starts=4, spread=0.0)
    none = tune(response(0.0), rate_hz=RATE, starts=4)
    assert plain.design.bandwidth == pytest.approx(none.design.bandwidth, rel=1e-6)
    assert tuned.design.bandwidth < 0.95 * plain.design.bandwidth
    bounds = Bounds(1.8, 1.8, HZ)
    assert judge(response(0.0), plain.controller, bounds, period=1 / RATE).S_peak <= 1.8 + 1e-4
    assert judge(response(0.15), plain.controller, bounds, period=1 / RATE).S_peak > 1.9
    coded = tustin(plain.controller, 1.0 / RATE)
    for share, passed in ((0.0, True), (0.15, False)):
        found = judge_lines(response(share), coded, bounds, 0.0, HZ * 10.0, True)
        assert found.passed is passed


def test_what_the_spread_adds_has_exact_slopes(tuned: Tuned) -> None:
    """Against central differences, of one channel."""
    structure = Structure(biquads=1, least_damping=0.1)
    problem = line_problem([response(0.15)], structure, Bounds(1.8, 1.8, HZ, 1.1), 1.0 / RATE,
                           DesignOptions.margin, 20.0)  # fmt: skip
    assert isinstance(problem, LineProblem)
    kappa = 0.5 * (problem.box[0] + problem.box[1])
    lines = np.arange(50, 500, 50)
    at = RowPlaces(np.full(len(lines), LoopCurve.S_MAX), lines, problem.v[lines])
    found, step = constraints(problem, kappa, -2.0, at), 1e-6
    for i in range(len(kappa)):
        ends = [
            constraints(problem, kappa + sign * step * np.eye(len(kappa))[i], -2.0, at).value
            for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose(
            found.to_kappa[:, i], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-4, atol=1e-7
        )
    plain = replace(problem, unsure=0.0 * problem.unsure)
    assert (found.value > constraints(plain, kappa, -2.0, at).value).all()


def test_a_spread_above_the_plant_leaves_no_design() -> None:
    """Where |G| is not known to differ from 0 no integrator is safe."""
    measured = response(0.05)
    spread = np.where(measured.hz < 3.0, 2.0, 0.05) * np.abs(measured.G)
    with pytest.raises(UserError, match=r"drop the lines below 3\.04 Hz"):
        tune(replace(measured, spread=spread), rate_hz=RATE, starts=2)


def test_the_present_controller_is_judged_beside_the_new_one(
    tmp_path: Path, tuned: Tuned, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = response(0.0, 250)
    K = tuned.controller
    parts = {name: getattr(K, name).tolist() for name in "ABCD"}
    (tmp_path / "now.json").write_text(json.dumps(parts))
    now = present_loop(tmp_path / "now.json", [measured], Bounds(1.8, 1.8, HZ), 1.0 / RATE)
    S = np.abs(1.0 / (1.0 + measured.G * controller_response(K, measured.hz, 1 / RATE)[:, 0, 0]))
    assert now.stable
    assert now.peak == pytest.approx(S.max())
    assert measured.hz[np.argmax(np.sqrt(0.5) < S)] == pytest.approx(now.bandwidth_hz, rel=0.04)
    np.savez(tmp_path / "G.npz", f_hz=measured.hz, G=measured.G)
    words = [str(tmp_path / "G.npz"), "--rate-hz", "5000", "--out", str(tmp_path / "out")]
    words += ["--biquads", "0", "--least-damping", "0.02", "--workers", "1"]
    words += ["--controller", str(tmp_path / "now.json")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert f"now {now.bandwidth_hz:.4g} Hz" in " ".join(printed.split())
    assert "possible" in printed
    assert json.loads((tmp_path / "out" / "result.json").read_text())["present"]["stable"]
    wrong = {name: (-np.array(value)).tolist() if name in "CD" else value
             for name, value in parts.items()}  # fmt: skip
    (tmp_path / "wrong.json").write_text(json.dumps(wrong))
    turned = present_loop(tmp_path / "wrong.json", [measured], Bounds(1.8, 1.8, HZ), 1.0 / RATE)
    assert not turned.stable
    assert "not stable" in turned.words
    (tmp_path / "two.json").write_text(json.dumps(
        {"A": [[-1.0]], "B": [[1.0, 0.0]], "C": [[1.0]], "D": [[0.0, 0.0]]}))  # fmt: skip
    with pytest.raises(UserError, match="this plant needs 1 and 1"):
        present_loop(tmp_path / "two.json", [measured], Bounds(1.8, 1.8, HZ), 1.0 / RATE)


def test_the_public_call_takes_the_factor() -> None:
    assert ccd.tune is tune
