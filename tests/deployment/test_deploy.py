"""A run's controller deployed: as a whole, by the command, and order by order."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.helpers import (
    OMEGA_LOW,
    PAPER,
    flexible_case,
    mechanics,
    problem,
    responses,
    scaled,
    two_mass_model,
)
from oracles.sampled_simulation import measure_set
from scipy.linalg import block_diag

from ccd_casadi.analysis.loop_channels import scalar_channels
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.deploy import main
from ccd_casadi.deployment import Timing, pipeline
from ccd_casadi.deployment.discretise import LoopLimits, Reduction, reductions, smallest
from ccd_casadi.deployment.pipeline import deploy
from ccd_casadi.deployment.realisation import assemble
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.interchange import read_mat
from ccd_casadi.synthesis.synthesis import Design, synthesise

ROOT = Path(__file__).parents[2]
QUICK = ["--quiet"]


def copied(run: Path, folder: Path) -> Path:
    return Path(shutil.copytree(run, folder / "run"))


def two_channels() -> tuple[ScaledPlant, Design]:
    """Two different two-mass systems side by side, seen and driven through a rotation."""
    one, other = (mechanics(two_mass_model(), (m, m)) for m in (55.0, 65.0))
    c, s = np.cos(0.4), np.sin(0.4)
    U = np.array([[c, -s], [s, c]])
    both = replace(
        one,
        **{name: block_diag(getattr(one, name), getattr(other, name)) for name in "MDK"},
        B=block_diag(one.B, other.B) @ U.T, C=U @ block_diag(one.C, other.C),
        derivatives=(np.zeros((0, 4, 4)),) * 3 + (np.zeros((0, 4, 2)), np.zeros((0, 2, 4))),
    )  # fmt: skip
    plant = scaled(both, PAPER.M_K)
    return plant, synthesise(plant, PAPER, omega_low=OMEGA_LOW)


def as_run(plant: ScaledPlant, made: Design) -> FinishedRun:
    inner = replace(problem().inner, S_max=made.figures.sensitivity_peak)
    case = load_case(ROOT / "runs" / "two_mass.toml")
    return FinishedRun(
        Path("x"), case, problem(inner=inner), (), plant, made.weights, made.controller,
        made.figures, {},
    )  # fmt: skip


def test_a_plant_of_two_channels_is_deployed_channel_by_channel(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant, made = two_channels()
    channels = scalar_channels(plant, made.controller)
    assert [c.plant.C.shape[0] for c in channels] == [1, 1]
    whole = assemble(channels, [c.controller for c in channels])
    omega = HZ * np.geomspace(1.0, 1000.0, 50)
    np.testing.assert_allclose(
        responses(plant, whole, omega)[1], responses(plant, made.controller, omega)[1],
        rtol=0, atol=1e-6 * np.abs(responses(plant, made.controller, omega)[1]).max(),
    )  # fmt: skip
    found = deploy(as_run(plant, made), Timing(lead=True))
    assert not found.passed, "there is no plant function, so that nothing was judged"
    assert found.judge is not None
    assert found.judge.passed is None
    monkeypatch.setattr(pipeline, "as_written", lambda run: [plant.plant_si()])
    found = deploy(as_run(plant, made), Timing(lead=True))
    assert found.passed, found.shortfalls
    assert found.order < len(made.controller.A)
    K, exact = found.realisation.system, found.sampled
    measured = measure_set([found.plant], K, exact.bandwidth, seed=0)[0]
    assert found.sampled.sensitivity_peak <= 1.05 * made.figures.sensitivity_peak
    assert found.sampled.bandwidth == pytest.approx(made.figures.bandwidth, rel=0.03)
    assert measured.bandwidth == pytest.approx(found.sampled.bandwidth, rel=1e-4)
    assert measured.sensitivity_peak == pytest.approx(found.sampled.sensitivity_peak, rel=1e-3)


def test_a_coupled_plant_is_one_channel() -> None:
    case = flexible_case(0)
    made = synthesise(case.plant, case.weights, omega_low=OMEGA_LOW)
    (channel,) = scalar_channels(case.plant, made.controller)
    rows = reductions(channel, case.weights, OMEGA_LOW)
    f, best = made.figures, rows[0].figures
    assert best.bandwidth == pytest.approx(f.bandwidth, rel=1e-5)
    limits = LoopLimits(1.02 * f.sensitivity_peak, 1.0, 2.0 * f.gamma, 0.99 * f.bandwidth)
    chosen = smallest(rows, limits)
    assert chosen.meets(limits)
    assert chosen.order < len(made.controller.A)


def test_every_order_is_measured_on_the_true_loop(two_mass_run: Path) -> None:
    run = read_run(two_mass_run)
    (channel,) = scalar_channels(run.plant, run.controller)
    rows = reductions(channel, run.weights, OMEGA_LOW)
    assert {row.method for row in rows} == set(Reduction) - {Reduction.NONE}
    for row in rows:
        assert len(row.controller.A) == row.order
        again = measure(
            run.plant, row.controller, run.weights, omega_low=OMEGA_LOW
        )
        np.testing.assert_equal(again.sensitivity_peak, row.figures.sensitivity_peak)
    S_max = run.problem.inner.S_max
    f = run.figures
    tight = LoopLimits(S_max * (1 + 1e-6), 0.03, 2 * f.gamma, 0.99 * f.bandwidth)
    wide = LoopLimits(1.005 * S_max, 0.03, 2 * f.gamma, 0.99 * f.bandwidth)
    strict, loose = smallest(rows, tight), smallest(rows, wide)
    assert 1 < loose.order <= strict.order < len(run.controller.A)
    for found, limits in ((strict, tight), (loose, wide)):
        assert found.meets(limits)
        assert not any(row.meets(limits) for row in rows if row.order < found.order)
        rivals = [row for row in rows if row.order == found.order and row.meets(limits)]
        assert found.figures.sensitivity_peak == min(r.figures.sensitivity_peak for r in rivals)
    none = smallest(rows, LoopLimits(1.0, 0.03, 2 * f.gamma, 0.99 * f.bandwidth))
    assert none is rows[0]


class _Plain(HTMLParser):
    """A page's tags and attributes: nothing of it may leave the page."""

    def __init__(self) -> None:
        super().__init__()
        self.foreign: list[Any] = []
        self.figures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.figures += tag == "figure"
        outside = [v for k, v in attrs if k in ("src", "href") and not (v or "").startswith("#")]
        self.foreign += outside + [tag] * (tag in ("link", "iframe"))


def test_the_command_leaves_a_controller_that_can_be_built(
    two_mass_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied(two_mass_run, tmp_path)
    assert main([str(folder), "--rate-hz", "10000", *QUICK]) == 0
    out = folder / "deploy"
    found = json.loads((out / "deploy.json").read_text())
    run = read_run(folder)
    S_max, hz = run.problem.inner.S_max, run.figures.bandwidth / HZ
    assert found["sampled"]["sensitivity_peak"] <= 1.05 * S_max
    assert found["sampled"]["bandwidth_hz"] == pytest.approx(hz, rel=0.03)
    assert found["status"] == "verified"
    assert (found["rate_hz"], found["delay"]) == (1e4, 1e-4)
    assert 1 < found["order"] < len(run.controller.A)
    assert 7000.0 < found["needed_rate_hz"] < 9000.0  # 8000 Hz, found to some per cent
    # the loop of the .mat file alone, at its own bandwidth
    mat = read_mat(out / "design.mat")
    K, G = (mat.systems[name].system for name in ("controller_discrete", "plant_discrete"))
    assert (K.period, G.period) == (1e-4, 1e-4)
    z = np.exp(1j * HZ * found["sampled"]["bandwidth_hz"] * K.period)
    g, k = (s.C @ np.linalg.solve(z * np.eye(len(s.A)) - s.A, s.B + 0j) + s.D for s in (G, K))
    assert abs(1.0 / (1.0 + (g @ k)[0, 0])) == pytest.approx(2**-0.5, rel=1e-8)
    table = json.loads((out / "controller.json").read_text())
    np.testing.assert_array_equal(table["A"], K.A)
    page = _Plain()
    page.feed((out / "report.html").read_text(encoding="utf-8"))
    assert (page.figures, page.foreign) == (3, ["../index.html"])  # loop, step, move
    if shutil.which("cc"):
        line = next(x for x in (out / "controller_test.c").read_text().splitlines() if " cc " in x)
        subprocess.run(line.split()[1:], cwd=out, check=True)
        assert subprocess.run([out / "controller_test"], check=False).returncode == 0
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_rate_that_does_not_do_names_the_one_that_does(
    two_mass_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path)]
    assert main([str(two_mass_run), *out, "--rate-hz", "6000", *QUICK]) == 4
    words = capsys.readouterr().err
    assert "It was NOT verified" in (tmp_path / "controller.h").read_text()
    reported = re.match(r"not verified: 6000 Hz with foh with lead is not enough: .*; (\d+)", words)
    assert reported is not None
    assert 7000.0 < float(reported[1]) < 9000.0
    assert json.loads((tmp_path / "deploy.json").read_text())["status"] == "not_verified"
    assert main([str(two_mass_run), *out, "--delay", "0.005", *QUICK]) == 2
    assert "shorten it" in capsys.readouterr().err
    assert main([str(two_mass_run), *out, "--rate-hz", "100", *QUICK]) == 2
    assert "sample faster" in capsys.readouterr().err


def test_a_loop_without_a_bandwidth_is_refused_in_one_line(two_mass_run: Path) -> None:
    run = read_run(two_mass_run)
    lost = replace(run, figures=replace(run.figures, bandwidth=np.nan))
    with pytest.raises(UserError, match=r"no bandwidth was measured .* K has a pole at \d"):
        deploy(lost, Timing())


def test_an_unstable_loop_leaves_no_code(
    two_mass_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "controller.c").write_text("of an earlier deployment")
    options = ["--rate-hz", "400", "--out", str(tmp_path), "--lead", "off", "--quiet"]
    assert main([str(two_mass_run), *options]) == 4
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"deploy.json", "report.html", "report.json"}
    assert not json.loads((tmp_path / "deploy.json").read_text())["sampled"]["stable"]
    assert main([str(two_mass_run), "--out", str(two_mass_run), *QUICK]) == 2
    assert "overwrite" in capsys.readouterr().err


def test_the_peak_is_the_one_that_the_simulation_shows(two_mass_run: Path) -> None:
    """SLICOT's AB13DD gives 1.737 here, where the loop has 1.877."""
    timing = Timing(12500.0, 2e-4, lead=True)
    found = deploy(read_run(two_mass_run), timing)
    K, exact = found.realisation.system, found.sampled
    measured = measure_set([found.plant], K, exact.bandwidth, seed=0)[0]
    assert exact.sensitivity_peak == pytest.approx(1.87683, rel=1e-3)
    assert exact.sensitivity_peak == pytest.approx(measured.sensitivity_peak, rel=1e-4)


@pytest.mark.slow
def test_the_stage_is_deployed(tmp_path: Path) -> None:
    from ccd_casadi.solve import main as solve

    case = ROOT / "runs" / "rib_stage.toml"
    options = ["--out", str(tmp_path), "--formulation", "direct", "--workers", "1", "--quiet"]
    assert solve([str(case), *options]) == 0
    assert main([str(tmp_path), "--rate-hz", "12500", *QUICK]) == 0
    found = json.loads((tmp_path / "deploy" / "deploy.json").read_text())
    S_max = found["criterion"]["S_max"]
    assert found["sampled"]["sensitivity_peak"] <= 1.05 * S_max
    bandwidth = found["full"]["bandwidth_hz"]
    assert found["sampled"]["bandwidth_hz"] == pytest.approx(bandwidth, rel=0.03)
    assert len(found["channels"]) == 4
    if shutil.which("cc"):
        out = tmp_path / "deploy"
        line = next(x for x in (out / "controller_test.c").read_text().splitlines() if " cc " in x)
        subprocess.run(line.split()[1:], cwd=out, check=True)
        assert subprocess.run([out / "controller_test"], check=False).returncode == 0
