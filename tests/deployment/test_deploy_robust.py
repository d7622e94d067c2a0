"""A deployment holds on every plant that the run's [robust] set promises, or says where not."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.deploy import main
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.given_controller import with_controller
from ccd_casadi.deployment.outcome import Deployment
from ccd_casadi.deployment.pipeline import DeploymentOptions, deploy
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import closed_loop
from ccd_casadi.plants.modal import Perturbation, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.robust.perturbed import sampled_compliance
from ccd_casadi.robustness import main as robustness
from ccd_casadi.solve import main as solve
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.statics import compliance_of

RUNS = Path(__file__).parents[2] / "runs"
ONE_WAY = Timing(lead=True)
QUICK = ["--quiet"]


@pytest.fixture(scope="module")
def robust_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robust")
    text = (RUNS / "two_mass.toml").read_text()
    more = '\n[robust]\nresonance_shift = 0.02\nshifts = 3\ndesign_at = "low"\n'
    more += "[sampling]\nlifted_points = 24\n[outer]\nbox_points = 0\n"
    (folder / "case.toml").write_text(text + more)
    options = ["--formulation", "lifted", "--workers", "1", "--quiet", "--no-report"]
    options += ["--out", str(folder / "run")]
    assert solve([str(folder / "case.toml"), *options]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def deployed(robust_run: Path) -> tuple[FinishedRun, Deployment]:
    run = read_run(robust_run)
    return run, deploy(run, ONE_WAY)


def peaks(run: FinishedRun, found, shifts) -> list[float]:  # type: ignore[no-untyped-def]
    """‖S‖∞ of the sampled loop on plants built here, bodies free as no design suspends them; inf
    where it is unstable."""
    system = mechanics(plant_of(run.problem), run.theta)
    out = []
    for shift in shifts:
        modal = modal_plant(system, run.problem.suspension.free, Perturbation(float(shift)))
        plant = scale_plant(modal, run.weights.M_K).plant_si()
        held = zoh(plant, 1.0 / found.rate_hz, found.delay)
        figures = sampled_figures(closed_loop(held, found.realisation.system).S)
        out.append(figures.sensitivity_peak if figures.stable else np.inf)
    return out


def test_what_is_verified_holds_between_the_plants_too(
    deployed: tuple[FinishedRun, Deployment],
) -> None:
    run, found = deployed
    assert found.passed
    assert found.stable
    shifts = np.random.default_rng(0).uniform(-0.02, 0.02, 10)
    worst = max(peaks(run, found, [*shifts, -0.02, 0.02]))
    allowed = 1.0 + DeploymentOptions().sampled_excess
    assert worst <= allowed * run.problem.inner.S_max * (1.0 + 1e-4)
    assert worst <= found.worst.figures.sensitivity_peak * (1.0 + 1e-4)
    assert {item.at.shift for item in found.members} >= {-0.02, 0.02}


def test_a_bound_on_the_compliance_is_kept_or_reported(
    deployed: tuple[FinishedRun, Deployment],
) -> None:
    run, found = deployed
    assert found.compliance is None, "this case bounds none"
    most = sampled_compliance(run.plant.plant_si(), found.plant, found.realisation.system)
    whole = compliance_of(run.plant, found.reduced).gain
    assert most == pytest.approx(whole, rel=0.05), "the rate is far above the loop's peak"
    at = replace(found, compliance=(Perturbation(0.02), most), compliance_max=1.01 * most)
    assert at.passed
    broken = replace(at, compliance_max=most / 1.2)
    assert not broken.passed
    assert "compliance |GS|" in broken.shortfalls[0]
    assert "resonances +2 %" in broken.shortfalls[0]


@pytest.mark.slow
def test_a_rate_enough_for_the_nominal_plant_alone_is_not_enough(
    deployed: tuple[FinishedRun, Deployment],
) -> None:
    """The finding that this is for: the sampled loop within its target on one plant of the set."""
    run, needed = deployed[0], deployed[1].needed_hz
    assert needed is not None
    failed = 0
    for rate in np.array([0.75, 0.95]) * needed:
        found = deploy(run, Timing(float(rate), lead=True))
        wrong = max(peaks(run, found, np.linspace(-0.02, 0.02, 9)))
        if wrong > (1.0 + DeploymentOptions().sampled_excess) * run.problem.inner.S_max:
            assert not found.passed
            failed += 1
            words = found.shortfalls[0]
            assert "resonances" in words or "nominal" in words
    assert failed > 0


def test_a_run_that_is_not_verified_is_refused_unless_required(
    robust_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(robust_run, tmp_path / "run"))
    result = json.loads((run / "result.json").read_text())
    result |= {"status": "not_verified", "reason": "failed: robust"}
    (run / "result.json").write_text(json.dumps(result))
    assert main([str(run), *QUICK]) == 4
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "failed: robust" in err
    assert not (run / "deploy").exists()
    assert main([str(run), *QUICK, "--unverified"]) == 4
    reported = json.loads((run / "deploy" / "deploy.json").read_text())
    assert reported["status"] == "not_verified"
    assert "failed: robust" in reported["reason"]
    assert "verified" not in (run / "deploy" / "controller.h").read_text().replace(
        "not verified", ""
    ).replace("NOT verified", "").replace("not been verified", "")


@pytest.mark.parametrize("lead", ["on", "off"])
def test_a_rate_below_twice_the_peak_is_one_line(
    robust_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], lead: str
) -> None:
    run = read_run(robust_run)
    rate = 4.05 * run.figures.bandwidth / HZ
    words = ["--rate-hz", str(rate), "--delay-samples", "2", "--lead", lead]
    code = main([str(robust_run), *words, "--quiet", "--out", str(tmp_path / "d")])
    assert code in (2, 4)
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_deployed_controller_of_a_continuous_design_is_judged_as_it_runs(
    robust_run: Path, deployed: tuple[FinishedRun, Deployment], tmp_path: Path
) -> None:
    run, found = deployed
    assert run.problem.sampling is None
    assert main([str(robust_run), *QUICK, "--out", str(tmp_path)]) == 0
    own = with_controller(run, tmp_path / "controller.json")
    assert own.loop_on(run.plant.plant_si()).period == pytest.approx(1.0 / found.rate_hz)
    assert own.figures.sensitivity_peak == pytest.approx(peaks(run, found, [0.0])[0], rel=1e-6)


@pytest.mark.slow
def test_robustness_judges_the_deployed_controller_on_the_same_plants(
    robust_run: Path, deployed: tuple[FinishedRun, Deployment], tmp_path: Path
) -> None:
    run, found = deployed
    assert main([str(robust_run), *QUICK, "--out", str(tmp_path / "deploy")]) == 0
    out = tmp_path / "r"
    words = ["--controller", str(tmp_path / "deploy" / "controller.json"), "--shift", "2"]
    words += ["--samples", "2", "--quiet", "--out", str(out)]
    assert robustness([str(robust_run), *words]) == 0
    reported = json.loads((out / "robustness.json").read_text())
    plants = reported["resonance_shift"]["plants"]
    expected = peaks(run, found, [p["shift"] for p in plants])
    assert [p["sensitivity_peak"] for p in plants] == pytest.approx(expected, rel=1e-6)
    rms = [v for key, v in reported["noise"].items() if key.startswith("rms_")]
    assert len(rms) == 4
    assert all(np.isfinite(v).all() and np.min(v) > 0.0 for v in rms)
    assert reported["period"] == pytest.approx(1.0 / found.rate_hz)
