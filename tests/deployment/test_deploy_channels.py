"""Sections of several channels: deployed as they are, judged as one loop; solved to the end."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from oracles.case_documents import TWO_MASS

from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.verdict import State
from ccd_casadi.deploy import main as deploy_main
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.deploy_files import deployment_dict
from ccd_casadi.deployment.outcome import DeployedRun, Deployment
from ccd_casadi.deployment.pipeline import _judge, deploy
from ccd_casadi.deployment.robust_set import as_written, members
from ccd_casadi.drawing.paint import page_html
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.structured_plant_set import structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_search import with_range
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import closed_loop
from ccd_casadi.reporting.deploy_page import deploy_page
from ccd_casadi.solve import main as solve_main
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import measure

GANTRY = """
def gantry(theta, load=0.0):
    m, c = theta["m"], 0.5 * load
    return {
        "mass": [[m + load, c, 0, 0], [c, 2 * m + load, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "stiffness": [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1.4e6, 0], [0, 0, 0, 2.1e6]],
        "damping_ratio": 0.02, "input": [[1, 0], [0, 1], [0.1, 0], [0, 0.1]],
        "output": [[1, 0, 0.1, 0], [0, 1, 0, 0.1]], "hardware_cost": m}
"""
CASE = """
[plant]
function = "gantry.py:gantry"
[theta.m]
lower = 9.9
upper = 10.1
start = 10.0
unit = "kg"
[objective]
w1 = 1.0
w2 = -0.05
WEIGHTS
[controller]
structure = "sections"
biquads = 0
roll_off = 1
starts = 2
weighted_level = 12.0
CHANNELS
[loop]
rate_hz = 8000.0
delay_us = 60.0
[robust]
gain = 0.02
plants = ["loaded.toml"]
[sampling]
points = 2
[outer]
box_points = 0
direct_starts = 2
"""
EXAMPLES = Path(__file__).parents[2] / "examples"
DIAGONALS = """[controller.channel.sum]
outputs = [1, 1]
[controller.channel.difference]
outputs = [1, -1]"""
HAND = {"gain": 3e3, "integrator": HZ, "lead 1 zero": 0.1 * HZ, "lead 1 pole": 150.0 * HZ,
        "roll-off real": 300.0 * HZ}  # fmt: skip


def written(folder: Path, channels: str = "") -> Path:
    """A gantry whose axes a load couples; channels along its diagonals are coupled without it."""
    (folder / "gantry.py").write_text(GANTRY)
    (folder / "loaded.toml").write_text("load = 0.5\n")
    weights = "[weights]" + TWO_MASS.read_text().split("[weights]")[1]
    path = folder / "case.toml"
    text = (
        CASE.replace("WEIGHTS", weights)
        .replace("CHANNELS", channels)
        .replace("M_K = 2e7", "M_K = 1e6")
    )
    path.write_text(text.replace("S_max = 1.75", "S_max = 2.5").replace("S_low = 0.03",
                                                                        "S_low = 0.2"))  # fmt: skip
    return path


def run_by_hand(folder: Path, harder: float = 1.0) -> FinishedRun:
    """A run whose controller is tuned by hand; that of the second channel `harder` times."""
    case = load_case(written(folder, DIAGONALS))
    problem = problem_of(case)
    structure = structure_of(problem)
    assert isinstance(structure, ChannelStructure)
    kappa = np.log([HAND[name.split(": ")[1]] for name in structure.names])
    kappa[structure.slices[1].start] += np.log(harder)
    plant, K = scaled_plant(problem, problem.start), structure.state_space(kappa)
    figures = measure(plant, K, problem.weights, omega_low=HZ)
    result = {"status": "verified", "theta": dict(zip(problem.names, problem.start, strict=True))}
    return FinishedRun(folder, case, problem, problem.start, plant, problem.weights, K, figures,
                       result, kappa=kappa)  # fmt: skip


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> tuple[FinishedRun, Deployment]:
    run = run_by_hand(tmp_path_factory.mktemp("gantry"))
    return run, deploy(run, Timing())


def test_what_runs_are_the_channels_sections_by_tustin(
    by_hand: tuple[FinishedRun, Deployment],
) -> None:
    run, found = by_hand
    K, omega = found.realisation.system, np.geomspace(1.0, 0.9 * np.pi * 8000.0, 50)
    s = 2j * 8000.0 * np.tan(0.5 * omega / 8000.0)
    C = run.controller
    exact = [C.C @ np.linalg.solve(x * np.eye(len(C.A)) - C.A, C.B) + C.D for x in s]
    assert K.response(omega) == pytest.approx(np.array(exact), rel=1e-6, abs=1e-6)
    assert [item.channel.name for item in found.orders] == ["sum", "difference"]
    words = deployment_dict(run, found, 0)["channels"]
    assert [item["sections"]["gain"] for item in words] == pytest.approx([3e3, 3e3])
    assert [item["order"] for item in words] == [3, 3]


def test_both_ends_of_a_stroke_are_deployed_and_judged() -> None:
    case = load_case(EXAMPLES / "gantry_stroke" / "case.toml")
    problem = with_range(problem_of(case))
    run: Any = SimpleNamespace(problem=problem, theta=problem.start, case=case)
    places = {place for item in members(run) for place in item.at.varies}  # type: ignore[attr-defined]
    assert places == {("theta.at", -0.3), ("theta.at", 0.3)}
    assert len(as_written(run)) > len(members(run, dense=True)) > len(places)


def test_the_whole_loop_is_judged_on_the_whole_set(
    by_hand: tuple[FinishedRun, Deployment], tmp_path: Path
) -> None:
    run, found = by_hand
    assert found.passed, found.shortfalls
    assert found.judge is not None
    assert found.judge.passed is True
    assert found.judge.plants > 4
    worst = found.judge.figures["S_max"] * found.target.peak
    assert worst == pytest.approx(found.worst.figures.sensitivity_peak, rel=1e-5)
    K, T = found.realisation.system, 1.0 / 8000.0
    z, k = np.exp(1j * HZ * T), K.response(np.array([HZ]))[0]
    at_low = 0.0
    for plant in as_written(run):  # |S(ω_low)| over S_low by the exact hold and delay
        G = zoh(plant, T, 60e-6)
        g = G.C @ np.linalg.solve(z * np.eye(len(G.A)) - G.A, G.B) + G.D
        at_low = max(at_low, np.linalg.norm(np.linalg.inv(np.eye(2) + g @ k), 2))
    S_low = run.problem.inner.S_low * (1.0 + found.target.excess)
    assert found.judge.figures["S_low"] == pytest.approx(at_low / S_low, rel=1e-6)
    largest = 12.0 * max(found.judge.figures["KS"], found.judge.figures["T"])
    for share, state in ((1.01, State.PASSED), (0.3, State.WARNED)):
        other = replace(run.problem.controller, weighted_level=share * largest)
        of_other = replace(run, problem=replace(run.problem, controller=other))
        again = replace(found, judge=_judge(of_other, found))
        assert DeployedRun(run, again).check().state == state, again.weighted_above
        assert any("3.33 times weighted_level" in one.words() for one in again.weighted_above) == (
            share < 1.0
        )
    wrong = replace(found.realisation, system=replace(K, C=-K.C, D=-K.D))
    assert _judge(run, replace(found, realisation=wrong)).passed is False
    for share, passed in ((1.001, True), (0.999, False)):
        target = replace(found.target, S_max=share * worst / (1.0 + found.target.excess))
        assert _judge(run, replace(found, target=target)).passed is passed
    assert {getattr(item.at, "option", 0) for item in found.members} == {0, 1}
    uncertain = uncertain_plant(run.problem, run.theta)
    for option in (0, 1):  # in between, by plants of one's own
        for gain in (-0.02, 0.007, 0.02):
            plant = uncertain.plant(np.array([gain]), option).plant_si()
            held = zoh(plant, 1.0 / 8000.0, 60e-6)
            figures = sampled_figures(closed_loop(held, found.realisation.system).S)
            assert figures.stable
            assert figures.sensitivity_peak <= found.worst.figures.sensitivity_peak * (1.0 + 1e-3)
    page = page_html(deploy_page(run, found))
    assert "Channel sum: gain 3000\xa0N/m" in page
    assert "Channel difference: 3 states, as designed" in page


def test_one_channel_that_is_too_fast_is_reported(tmp_path: Path) -> None:
    found = deploy(run_by_hand(tmp_path, harder=4.0), Timing())
    assert not found.passed
    assert found.worst.badness > found.target.peak


@pytest.mark.slow
def test_a_solve_runs_to_its_end_and_deploys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = ["--formulation", "direct", "--workers", "1", "--out", str(run)]
    assert solve_main([str(written(tmp_path)), *options]) == 0
    printed = capsys.readouterr().out
    assert "order 6, gain 1: " in printed
    result = json.loads((run / "result.json").read_text())
    assert result["status"] == "verified"
    assert result["proof"]["outcome"] == "proven"  # the box, for both channels together
    assert [item["name"] for item in result["controller"]["channels"]] == ["1", "2"]
    assert "1: lead" in (run / "report.html").read_text()
    assert deploy_main([str(run), "--quiet"]) == 0
    deployed = json.loads((run / "deploy" / "deploy.json").read_text())
    assert deployed["robust"]["worst"]["sensitivity_peak"] <= 2.5 * (1.0 + 1e-3)
    if shutil.which("cc"):
        command = ["cc", "-std=c99", "-O2", "-ffp-contract=off", "-o", "test", "controller.c",
                   "controller_test.c"]  # fmt: skip
        subprocess.run(command, cwd=run / "deploy", check=True)
        subprocess.run(["./test"], cwd=run / "deploy", check=True)
