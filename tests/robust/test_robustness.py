"""What a finished design survives: every figure against another way to it."""

import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import control
import numpy as np
import pytest
from oracles.helpers import HZ, SUSPENSION, random_plant, responses, scaled
from scipy.integrate import trapezoid

from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.modal import Perturbation, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.reporting.robustness_page import _bandwidth_lost
from ccd_casadi.robust.margins import gains, margins, noise, structured_bound
from ccd_casadi.robust.perturbed import (
    damping_line,
    shift_line,
    single_modes,
    tolerances,
    worst_in_box,
)
from ccd_casadi.robustness import main
from ccd_casadi.synthesis.interchange import named_controller, named_plant, to_control
from ccd_casadi.synthesis.synthesis import synthesise
from ccd_casadi.synthesis.weights import Weights

GRID = np.unique(np.concatenate([np.geomspace(0.2, 3000.0, 800), np.linspace(120, 260, 600)]))


@pytest.fixture(scope="module")
def run(two_mass_run: Path) -> FinishedRun:
    return read_run(two_mass_run)


def matrix(plant: StateSpace, controller: StateSpace) -> np.ndarray:
    return closed_loop(plant, controller).A


def stable(plant: StateSpace, controller: StateSpace) -> bool:
    return bool(np.linalg.eigvals(matrix(plant, controller)).real.max() < 0.0)


# ---- margins -------------------------------------------------------------------------------------


def test_margins_are_where_stability_ends(run: FinishedRun) -> None:
    # of a grid on which the resonance is hardly seen: it brackets, and decides no figure
    coarse = np.geomspace(0.2, 3000.0, 400)
    found = margins(lambda omega: responses(run.plant, run.controller, omega)[:2], coarse)
    plant, loop = run.plant.plant_si(), found.loops[0]

    def with_gain(factor: float) -> bool:
        k = run.controller
        return stable(plant, StateSpace(k.A, k.B, factor * k.C, factor * k.D))

    near = 1e-6
    assert with_gain((1.0 - near) * loop.gain_up)
    assert not with_gain((1.0 + near) * loop.gain_up)
    assert with_gain((1.0 + near) * loop.gain_down)
    assert not with_gain((1.0 - near) * loop.gain_down)
    assert 1.0 < loop.disk.gain <= loop.gain_up
    assert 0.0 < loop.disk.phase_deg <= loop.phase_deg
    L = to_control(named_plant(plant)) * to_control(named_controller(run.controller))
    dense = loop.disk.hz * np.geomspace(0.98, 1.02, 2001)
    alpha, decibels, degrees = control.disk_margins(L, HZ * dense)
    assert loop.disk.alpha == pytest.approx(alpha, rel=1e-6)
    assert 20.0 * np.log10(loop.disk.gain) == pytest.approx(decibels, rel=1e-6)
    assert loop.disk.phase_deg == pytest.approx(degrees, rel=1e-6)
    assert found.outputs.alpha <= loop.disk.alpha * (1.0 + 1e-9)
    assert found.outputs.alpha == pytest.approx(loop.disk.alpha, rel=1e-3)


def mimo(seed: int) -> tuple:
    plant = random_plant(seed, rigid=2, flexible=2, inputs=2, outputs=2)
    M_K = 2e4
    weights = Weights(
        M_S=2.0, A_S=1e-4, omega_S=1.0 * HZ, c_K=1e4, omega_K=100.0 * HZ, M_K=M_K,
        A_l=1.0, A_u=1e-2, omega_T=10.0 * HZ,
    )  # fmt: skip
    system = mechanics(plant, (0.4, 0.6))
    G = scaled(system, M_K)
    made = synthesise(G, weights, omega_low=HZ)
    assert made.figures.certified
    return G, modal_plant(system, SUSPENSION), made.controller, M_K


def test_every_gain_inside_the_joint_disk_keeps_a_2_x_2_loop() -> None:
    plant, _, controller, _ = mimo(4)
    hz = np.geomspace(0.05, 1000.0, 200)
    found = margins(lambda omega: responses(plant, controller, omega)[:2], hz)
    assert [item.name for item in found.loops] == ["output 1", "output 2", "input 1", "input 2"]
    for where, margin in (("outputs", found.outputs), ("inputs", found.inputs)):
        ends = 1.0 + 0.999 * (margin.gain - 1.0)
        for factors in ([ends, ends], [ends, 1 / ends], [1 / ends, ends], [1 / ends, 1 / ends]):
            k = controller
            D = np.diag(factors)
            scaled_k = (
                StateSpace(k.A, k.B @ D, k.C, k.D @ D)
                if where == "outputs"
                else StateSpace(k.A, k.B, D @ k.C, D @ k.D)
            )
            assert stable(plant.plant_si(), scaled_k)
        assert margin.alpha <= min(m.disk.alpha for m in found.loops if m.name[0] == where[0])


# ---- noise ---------------------------------------------------------------------------------------


def test_rms_values_against_integrals_over_frequency(run: FinishedRun) -> None:
    found = noise(Loop(run.plant.plant_si(), run.controller), 1e-9, 2e-3)
    hz = np.unique(np.concatenate([np.geomspace(1e-4, 1e5, 20001), np.linspace(100, 300, 20001)]))
    G, K, S = responses(run.plant, run.controller, HZ * hz)
    T, GS = (G @ K @ S)[:, 0, 0], (S @ G)[:, 0, 0]
    KS = (K @ S)[:, 0, 0]
    for value, response, density in (
        (found.position_by_noise, T, 1e-9), (found.force_by_noise, KS, 1e-9),
        (found.position_by_disturbance, GS, 2e-3), (found.force_by_disturbance, T, 2e-3),
    ):  # fmt: skip
        rms = density * np.sqrt(trapezoid(np.abs(response) ** 2, hz))
        assert value[0] == pytest.approx(rms, rel=1e-3)
    assert gains(G, K)[0] == pytest.approx(np.abs(S[:, 0, 0]))


# ---- plants off the model ------------------------------------------------------------------


def shifted_stable(run: FinishedRun, shift: float) -> bool:
    modal = run.modal(Perturbation(shift))
    return stable(scale_plant(modal, run.weights.M_K).plant_si(), run.controller)


def test_the_ends_of_a_line_are_where_the_loop_is_lost(run: FinishedRun) -> None:
    line = shift_line(run, 0.05, 21)
    low, high = line.stable
    assert -0.0077 < low < -0.0075  # the nominal design of case study 1 stands 0.76 %
    assert shifted_stable(run, low + 1e-6)
    assert not shifted_stable(run, low - 1e-6)
    assert high == 0.05
    assert line.within[0] <= 0.0 <= line.within[1] < high
    assert len(line.judged) == 21
    damped = damping_line(run, 0.5, 2.0, 7)
    assert damped.stable == pytest.approx((0.5, 2.0))
    # this plant has one flexible mode: alone it is all of them
    alone = single_modes(run, 0.05)
    assert [item.stable for item in alone] == [False, True]
    # its damping matrix stays where the frequency moves, so both ways are the same plant
    assert alone[1].peak == pytest.approx(line.judged[-1].peak, rel=1e-9)


def test_the_worst_of_a_box_is_worse_than_all_that_was_seen(run: FinishedRun) -> None:
    line = shift_line(run, 0.006, 9)
    worst = worst_in_box(run, 0.006, (0.8, 1.25))
    assert worst.badness >= max(item.badness for item in line.judged)
    assert abs(worst.place[0]) <= 0.006 * (1.0 + 1e-12)
    assert 0.8 * (1 - 1e-12) <= worst.place[1] <= 1.25 * (1 + 1e-12)


def test_random_hardware_repeats_and_its_worst_is_at_a_corner(run: FinishedRun) -> None:
    """Both masses 1 % lighter: k falls with their fourth powers, and the resonance with it."""
    first = tolerances(run, 0.01, 25, 3)
    again = tolerances(run, 0.01, 25, 3)
    # as texts, in which one NaN is another
    assert repr(first) == repr(again)
    assert repr(first) != repr(tolerances(run, 0.01, 25, 4))
    assert len(first.judged) == 25
    for item in first.judged:
        assert (np.abs(np.array(item.place) / run.theta - 1.0) <= 0.01).all()
    assert not first.worst.stable
    assert first.worst.place == pytest.approx(0.99 * np.array(run.theta))


def test_the_structured_bound_is_one_and_no_loose_one(run: FinishedRun) -> None:
    """One mode: the true limit is the shift at which stability is lost."""
    modal = run.modal()
    bound = structured_bound(run.plant, modal, run.controller, np.geomspace(0.2, 3000.0, 200))
    assert bound is not None
    lost = shift_line(run, 0.05, 21).stable[0]
    # by so much a grid may miss it
    assert bound.stiffness == pytest.approx(1.0 - (1.0 + lost) ** 2, rel=1e-4)
    assert bound.shift == pytest.approx(np.sqrt(1.0 + bound.stiffness) - 1.0)
    assert bound.stiffness >= 1.0 / bound.mu.max()


def test_errors_within_the_structured_bound_keep_two_modes_stable() -> None:
    plant, modal, controller, M_K = mimo(4)
    bound = structured_bound(plant, modal, controller, np.geomspace(0.05, 3000.0, 300))
    assert bound is not None
    assert bound.modes == 2
    flexible = np.flatnonzero(~modal.rigid)
    rng = np.random.default_rng(0)
    corners = [np.array(c) for c in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    for delta in (*corners, *rng.uniform(-1.0, 1.0, (30, 2))):
        K = modal.K.copy()
        K[flexible, flexible] *= 1.0 + 0.999 * bound.stiffness * delta
        assert stable(scale_plant(replace(modal, K=K), M_K).plant_si(), controller)


# ---- the command ---------------------------------------------------------------------------


def test_the_command_writes_figures_and_a_page(two_mass_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--out", str(out), "--samples", "10", "--seed", "5", "--quiet"]
    assert main([str(two_mass_run), *options]) == 0
    found = json.loads((out / "robustness.json").read_text())
    assert found["seed"] == 5
    assert not found["survives"]
    assert found["resonance_shift"]["stable_between"][0] == pytest.approx(-0.00758, abs=2e-5)
    assert found["structured"]["stiffness"] == pytest.approx(0.01511, abs=2e-5)
    assert [item["feedforward"] for item in found["move"]["runs"]] == [False, True]
    assert found["move"]["runs"][1]["settling"] == 0.0
    assert found["move"]["runs"][1]["rms_error"] < 1e-7
    assert found["tolerances"]["samples"] == 10
    page = (out / "robustness.html").read_text()

    class Tags(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.ids: list[str] = []

        def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
            assert tag not in ("img", "link", "iframe")
            self.ids += [value or "" for name, value in attributes if name == "id"]

    tags = Tags()
    tags.feed(page)
    assert len(tags.ids) == len(set(tags.ids))
    assert page.count("<figure>") == 5  # one of the move, with and without feedforward
    assert "not stable on all plants" in page
    assert "-0.75 to +5.00" in page  # rounded towards zero
    left = ["report.json", "robustness.html", "robustness.json"]
    assert sorted(p.name for p in out.iterdir()) == left


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--axis", "2"], "--axis: is 2; the plant has outputs 1 to 1"),
        (["--damping", "1.5", "2"], "--damping: is 1.5 2"),
        (["--tolerance", "-1"], "--tolerance"),
        (["--shift", "60"], "not a number above 0 and below 50"),
        (["--stroke", "0"], "not a number above 0"),
        (["--samples", "0"], "not a whole number"),
    ],
)
def test_a_wrong_option_is_named(
    two_mass_run: Path, tmp_path: Path, options: list[str], words: str, capsys
) -> None:
    assert main([str(two_mass_run), "--out", str(tmp_path), *options]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_folder_that_holds_no_run(two_mass_run: Path, tmp_path: Path, capsys) -> None:
    folder = Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    (folder / "controller.json").unlink()
    assert main([str(folder)]) == 2
    assert "solve the case first" in capsys.readouterr().err


@pytest.mark.parametrize(("share", "said"), [(0.99, False), (0.6, True)])
def test_plants_that_lose_bandwidth_are_said_though_stable_and_within_s_max(
    share: float, said: bool
) -> None:
    """D8: "0 unstable, 0 above S_max" was all that was said where a quarter had 37 Hz of 59."""
    bandwidths = HZ * np.array([59.0] * 15 + [share * 59.0] * 5)
    judged = [SimpleNamespace(stable=True, bandwidth=value) for value in bandwidths]
    run = SimpleNamespace(figures=SimpleNamespace(bandwidth=59.0 * HZ))
    lost = _bandwidth_lost(run, SimpleNamespace(tolerances=SimpleNamespace(judged=judged)))
    assert bool(lost) == said
    if said:
        assert lost[1:] == pytest.approx((35.4, 59.0))
