"""Controllers from files: matrices, filters as a table, and the loop at rest."""

import json
from pathlib import Path

import numpy as np
import pytest
from oracles.helpers import responses

from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.deployment.given_controller import read_controller, with_controller
from ccd_casadi.lti.loop import tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.statics import Statics, statics

TABLE = """
gain = 3.0e5
integrator_hz = 2.0
lead = [{ zero_hz = 20.0, pole_hz = 200.0 }]
notch = [{ zero_hz = 250.0, zero_damping = 0.02, pole_hz = 260.0, pole_damping = 0.4 }]
low_pass = [{ pole_hz = 900.0, pole_damping = 0.7 }, { pole_hz = 2000.0 }]
"""


def gain(K: StateSpace, s: complex) -> complex:
    return complex((K.C @ np.linalg.solve(s * np.eye(len(K.A)) - K.A, K.B) + K.D)[0, 0])


def test_a_table_is_the_product_of_its_filters(tmp_path: Path) -> None:
    (tmp_path / "k.toml").write_text(TABLE)
    K = read_controller(tmp_path / "k.toml")[0]

    def second(s: complex, hz: float, zeta: float) -> complex:
        w = HZ * hz
        return (s / w) ** 2 + 2.0 * zeta * s / w + 1.0

    for hz in (0.1, 3.0, 40.0, 250.0, 255.0, 3000.0):
        s = 2j * np.pi * hz
        expected = 3.0e5 * (s + HZ * 2.0) / s
        expected *= (1 + s / (HZ * 20.0)) / (1 + s / (HZ * 200.0))
        expected *= second(s, 250.0, 0.02) / second(s, 260.0, 0.4)
        expected /= second(s, 900.0, 0.7) * (1 + s / (HZ * 2000.0))
        assert gain(K, s) == pytest.approx(expected, rel=1e-9)


def test_json_of_either_kind_and_the_runs_own(two_mass_run: Path, tmp_path: Path) -> None:
    run = read_run(two_mass_run)
    same = with_controller(run, two_mass_run / "controller.json")
    assert same.figures.sensitivity_peak == run.figures.sensitivity_peak
    (tmp_path / "k.json").write_text(json.dumps({"gain": 5.0, "low_pass": [{"pole_hz": 3.0}]}))
    assert gain(read_controller(tmp_path / "k.json")[0], 0j) == pytest.approx(5.0)
    (tmp_path / "p.toml").write_text("gain = 3e5")  # no state of its own
    figures = with_controller(run, tmp_path / "p.toml").figures
    assert figures.certificate.stable


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("k.toml", "gain = -1.0", "give a number above 0"),
        ("k.toml", "lead = []", "gain: is missing"),
        ("k.toml", "gain = 1.0\nnotches = []", "unknown key"),
        ("k.toml", "gain = 1.0\nnotch = [{ zero_hz = 3.0 }]", "notch 1: give"),
        ("k.toml", "gain = ", "is not valid TOML"),
        ("k.json", '{"A": [[1]], "B": 3}', "not matrices"),
        ("k.json", '{"A": [[1]], "B": [[1]], "C": [[1, 2]], "D": [[0]]}', "no state space"),
        ("k.txt", "", ".json, .toml or .mat"),
    ],
)
def test_what_is_no_controller_is_reported(
    tmp_path: Path, name: str, text: str, words: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=words):
        read_controller(tmp_path / name)


def test_a_loop_that_it_does_not_hold_is_refused(two_mass_run: Path, tmp_path: Path) -> None:
    (tmp_path / "k.toml").write_text("gain = 1e9\nintegrator_hz = 100.0\n")
    with pytest.raises(UserError, match="not stable"):
        with_controller(read_run(two_mass_run), tmp_path / "k.toml")


def at_rest(run: FinishedRun, K: StateSpace) -> Statics:
    return statics(
        run.plant.plant_si(), K, bandwidth=run.figures.bandwidth,
        omega_low=run.problem.inner.omega_low,
    )  # fmt: skip


def test_the_loop_at_rest_is_the_limit_of_low_frequencies(two_mass_run: Path) -> None:
    run = read_run(two_mass_run)
    found = at_rest(run, run.controller)
    G, K, S = responses(run.plant, run.controller, np.array([1e-4 * HZ]))
    assert found.stiffness == pytest.approx(abs(K[0, 0, 0]), rel=1e-3)
    assert found.compliance == pytest.approx(abs((S @ G)[0, 0, 0]), rel=1e-3)
    assert found.differentiates
    assert "almost a differentiator" in found.words


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("second", [0.0, 40.0])
def test_a_channel_without_an_integrator_yields_at_rest(second: float, sampled: bool) -> None:
    """Two free masses, each with its own controller k (1 + w/s), one of them with `second` for w:
    by a constant force on that one it moves 1/k where w is 0."""
    k, turn = 3e4, np.array([[0.6, -0.8], [0.8, 0.6]])
    A, B = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)), np.vstack([0.0 * turn, 0.2 * turn])
    G = StateSpace(A, B, np.hstack([turn.T, 0.0 * turn]), np.zeros((2, 2)))
    K = StateSpace(-1e3 * np.array([[0.0, 0.0], [0.0, 0.0 if second else 1.0]]), np.eye(2),
                   10.0 * k * np.diag([1.0, 0.1 * second]), k * np.eye(2))  # fmt: skip
    K = tustin(K, 1e-4) if sampled else K
    found = statics(G, K, bandwidth=300.0, omega_low=HZ)
    if second:
        assert found.compliance == 0.0
        assert "a constant force does not move the stage" in found.words
    else:
        assert found.stiffness == pytest.approx(k, rel=1e-4)
        assert found.compliance == pytest.approx(1.0 / k, rel=1e-4)
        assert "Not every channel integrates" in found.words
        assert "33.3" in found.words


def test_an_integrator_is_infinitely_stiff(two_mass_run: Path, tmp_path: Path) -> None:
    run = read_run(two_mass_run)
    (tmp_path / "k.toml").write_text(TABLE)
    K = read_controller(tmp_path / "k.toml")[0]
    found = at_rest(run, K)
    assert found.compliance == 0.0
    low = responses(run.plant, K, np.array([run.problem.inner.omega_low]))
    assert found.low == pytest.approx(abs((low[2] @ low[0])[0, 0, 0]), rel=1e-9)
    assert not found.differentiates
