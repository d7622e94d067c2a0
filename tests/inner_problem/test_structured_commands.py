"""Every command on one run with a controller of fixed structure: a PID, sampled."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from oracles.case_documents import QUICK_SECTIONS as QUICK
from oracles.contradictions import contradictions
from oracles.helpers import problem

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.codesign.post_optimal import structured_responses
from ccd_casadi.compare import main as compare_main
from ccd_casadi.deploy import main as deploy_main
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.given_controller import as_it_runs
from ccd_casadi.deployment.pipeline import deploy
from ccd_casadi.extensions.feedforward import main as feedforward_main
from ccd_casadi.extensions.feedforward.coefficients import Shape, responses_of
from ccd_casadi.extensions.limitations import main as gap_main
from ccd_casadi.extensions.limitations.multiplier import MultiplierBasis, discs
from ccd_casadi.extensions.limitations.of_problem import limits_of_problem, opposite_corners
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.starts import at_random, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner import main as inner_main
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_robustness import BoxCheckOptions, DesignOnBox
from ccd_casadi.insight import main as insight_main
from ccd_casadi.lti.loop import tustin, zoh
from ccd_casadi.reporting.concerns import ConcernOptions
from ccd_casadi.reporting.decision import advice
from ccd_casadi.robustness import main as robustness_main
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.solve import main as solve_main
from ccd_casadi.support.text import HZ, number
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import synthesise
from surrogates.retrain import main as retrain_main

COMMON = ["--quiet", "--workers", "1"]


@pytest.fixture(scope="module")
def folder(common_folder: Callable[[str], Any]) -> Path:
    """quick.toml and its run; what a test writes goes elsewhere."""
    with common_folder("sections") as place:
        found: Path = place
        if not (place / "run/report.html").exists():
            (place / "quick.toml").write_text(QUICK)
            words = [str(place / "quick.toml"), "--out", str(place / "run")]
            assert solve_main([*words, *COMMON]) == 0
    return found


@pytest.mark.slow
def test_its_verdict_agrees_with_itself(folder: Path) -> None:
    problem = problem_of(load_case(folder / "run" / "case.toml"))
    result = json.loads((folder / "run" / "result.json").read_text())
    assert contradictions(result, problem) == []
    assert {"races", "samples", "rounds"} <= set(result["spent"])


def test_a_run_holds_the_controller_and_its_page(folder: Path) -> None:
    run = folder / "run"
    result = json.loads((run / "result.json").read_text())
    controller = json.loads((run / "controller.json").read_text())
    assert controller["sections"]["loop"] == {
        "rate_hz": 8000.0, "delay_us": 80.0, "method": "tustin"
    }  # fmt: skip
    assert len(controller["A"]) == result["controller"]["order"] == 4
    page = (run / "report.html").read_text()
    for words in ("Nyquist", "roll-off", "What limits the bandwidth", "with feedforward"):
        assert words in page
    # more plants, or hold and delay, can only cost: the climbs start from the design itself
    for easier in ("on_model_hz", "continuous_hz"):
        assert result["costs"][easier] >= result["bandwidth_hz"] * (1.0 - 1e-3)


@pytest.mark.slow
def test_no_controller_exceeds_what_the_run_says(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = json.loads((folder / "run" / "result.json").read_text())
    bound = result["gap"]["bandwidth_bound_hz"]
    assert bound >= result["bandwidth_hz"]
    assert (
        f"no controller of any order exceeds {number(bound, 4)} Hz"
        in (result["verdict"]["optimal"]["words"])
    )
    assert gap_main([str(folder / "run")]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["gap"]["relative"] == pytest.approx(result["gap"]["relative"])
    model = answer["gap"]["model_bound_hz"]
    assert result["costs"]["on_model_hz"] < answer["gap"]["inside_hz"] < model
    assert bound <= model


@pytest.mark.slow
def test_the_loop_of_a_run_lies_in_the_discs_of_its_bandwidth_and_no_multiplier_sees_it(
    folder: Path,
) -> None:
    """T of the design in v = (2/T) tan(ωT/2): ∫ h T dv = 0, as for the T of every controller."""
    run = read_run(folder / "run")
    (model,) = limits_of_problem(run.problem, run.theta)
    sampling, bandwidth = run.problem.controller.sampling, HZ * run.result["bandwidth_hz"]
    pairs = opposite_corners(
        uncertain_plant(run.problem, run.theta), model.bounds, sampling, integrator=model.integrator
    )
    assert len(pairs) == 2
    v = np.geomspace(1e-3, 1e9, 200_000)
    omega = model.omega(v)
    K = tustin(run.controller, sampling.period).sweep(omega)[:, 0, 0]
    at = model.variable(bandwidth)
    for limits in (model, *pairs):
        L = limits.row[0].values(v) * K
        T, below = L / (1.0 + L), omega < 0.99 * np.pi * sampling.rate_hz
        centres, radii = discs(limits, v, v, bandwidth)
        share = (np.abs(T - centres) / radii)[:, below].max()
        assert 0.5 < share < 1.0 + 1e-3
        basis = MultiplierBasis((0.5 * at, 2.0 * at, 2.0 * at), (), 10.0 * at, 1, limits.beyond)
        h = basis.values(v)
        seen = np.trapezoid((h * T[:, None]).real, v, axis=0)
        assert np.abs(seen).max() < 1e-3 * np.trapezoid(np.abs(h * T[:, None]), v, axis=0).max()
    plant = zoh(run.plant.plant_si(), sampling.period, sampling.delay)
    assert model.row[0].values(v[below]) == pytest.approx(
        plant.sweep(omega[below])[:, 0, 0], rel=1e-4
    )


def test_fresh_draws_survive_what_was_designed_for_and_nothing_more(folder: Path) -> None:
    run = read_run(folder / "run")
    options = BoxCheckOptions(fresh=40)
    for more, survived in ((1.0, 40), (1.05, 0)):
        bandwidth = more * HZ * run.result["bandwidth_hz"]  # on the set
        made = SimpleNamespace(controller=run.controller, bandwidth=bandwidth)
        drawn, lost = DesignOnBox(run.problem, run.theta, made, options).fresh_yield()
        assert drawn is not None
        assert len(lost) == 40 - survived
        assert (drawn.survived, drawn.draws) == (survived, 40)


@pytest.mark.slow
def test_inner_and_deploy(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert inner_main([str(folder / "quick.toml"), "--theta", "m1=59,m2=59", *COMMON]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "verified"
    assert answer["gamma_opt"] is None

    result = json.loads((folder / "run" / "result.json").read_text())
    assert deploy_main([str(folder / "run"), "--out", str(folder / "deploy"), *COMMON]) == 0
    deployed = json.loads((folder / "deploy" / "deploy.json").read_text())
    assert (deployed["rate_hz"], deployed["delay"]) == pytest.approx((8000.0, 8e-5))
    assert deployed["sampled"]["bandwidth_hz"] >= result["bandwidth_hz"] * (1.0 - 1e-6)
    assert deployed["sampled"]["sensitivity_peak"] <= 1.75 * (1.0 + 1e-3)
    # the whole set that the case names, with its ends, and none above S_max
    gains = [member["gain"] for member in deployed["robust"]["members"]]
    assert min(gains) == pytest.approx(-0.02)
    assert max(gains) == pytest.approx(0.02)
    assert deployed["robust"]["worst"]["sensitivity_peak"] <= 1.75 * (1.0 + 1e-3)


def test_a_rate_that_only_the_nominal_plant_stands_is_not_verified(folder: Path) -> None:
    """At half the rate that the loop was designed for, the plant of the largest gain tells."""
    run = read_run(folder / "run")
    found = deploy(run, Timing(rate_hz=4000.0))
    nominal = max(found.sampled.sensitivity_peak, run.problem.inner.S_max)
    assert found.stable
    assert not found.passed
    assert found.worst.figures.sensitivity_peak > nominal
    assert "gain +2 %" in found.shortfalls[0]


def test_resonances_that_the_set_does_not_shift_are_a_condition_of_the_decision(
    folder: Path,
) -> None:
    """The set names an error of the gain alone: what the loop keeps is what must be known."""
    result = json.loads((folder / "run" / "result.json").read_text())
    line = result["verdict"]["survives"]
    assert line["set_shift"] == [0.0, 0.0]
    near = min(abs(end) for end in line["S_max_shift"]) < ConcernOptions().identified
    before, condition, _ = advice(result).partition(" Condition: ")
    assert before.startswith("Build this") or not condition
    assert bool(condition) == (near and before.startswith("Build this"))


def test_a_delay_beyond_that_of_the_design_is_the_cause_and_no_rate_is_the_remedy(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rate that the loop has already does not make up for more delay; the own delay does."""
    run, own = folder / "run", read_run(folder / "run").problem.sampling
    assert own is not None
    late = ["--delay-samples", str(6.0 * own.delay * own.rate_hz), "--out", str(tmp_path / "late")]
    assert deploy_main([str(run), *late, *COMMON]) == 4
    words = capsys.readouterr().err
    assert f"the delay exceeds the {own.delay_us:g} us of the design" in words
    assert f"{own.rate_hz:g} Hz is needed" not in words
    assert json.loads((tmp_path / "late" / "deploy.json").read_text())["needed_rate_hz"] is None
    kept = ["--delay", str(own.delay), "--out", str(tmp_path / "kept")]
    assert deploy_main([str(run), *kept, *COMMON]) == 0


@pytest.mark.slow  # of mixed sensitivity it is in test_deploy_robust
def test_a_run_that_is_not_verified_deploys_as_such(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(folder / "run", tmp_path / "run"))
    result = json.loads((run / "result.json").read_text())
    result |= {"status": "not_verified", "reason": "failed: robust"}
    (run / "result.json").write_text(json.dumps(result))
    assert deploy_main([str(run), *COMMON]) == 4
    assert "failed: robust" in capsys.readouterr().err
    assert deploy_main([str(run), *COMMON, "--unverified"]) == 4
    deployed = json.loads((run / "deploy" / "deploy.json").read_text())
    assert deployed["status"] == "not_verified"


@pytest.mark.slow
def test_robustness_is_of_the_loop_as_it_runs(folder: Path) -> None:
    """Of the sampled one, and as deploy has it."""
    run, out = folder / "run", folder / "robustness"
    assert robustness_main([str(run), "--samples", "3", "--out", str(out), *COMMON]) == 0
    found = json.loads((out / "robustness.json").read_text())
    assert found["period"] == pytest.approx(1.0 / 8000.0)
    assert found["survives"]
    assert found["sensitivity_peak"] <= 1.75 * (1.0 + 1e-3)
    assert len(found["move"]["runs"]) == 2
    without, ahead = found["move"]["runs"]
    assert ahead["peak_error"] < without["peak_error"]
    finished = read_run(run)
    assert as_it_runs(finished).figures.bandwidth != finished.figures.bandwidth


@pytest.mark.slow
def test_insight_draws_the_front_of_the_runs_own_function(folder: Path) -> None:
    out = folder / "insight"
    assert insight_main([str(folder / "run"), "--points", "2", "--out", str(out), *COMMON]) == 0
    found = json.loads((out / "insight.json").read_text())
    result = json.loads((folder / "run" / "result.json").read_text())
    points = found["front"]["points"]
    assert all(point["status"] == "verified" for point in points)
    fastest = max(point["bandwidth_hz"] for point in points)
    assert fastest == pytest.approx(result["bandwidth_hz"], rel=1e-3)
    assert "S_max" in (out / "insight.html").read_text()


def test_responses_against_differences(folder: Path) -> None:
    """dω_b*/dS_max, and dJ*/dp at a θ whose bounds hold it, by two other designs."""
    run = read_run(folder / "run")
    made = structured_value(run.problem, run.theta)
    sample = InnerSample(run.theta, made.bandwidth, made.gradient, np.nan, np.nan, (), "", 0.0, 1)
    found = structured_responses(run.problem, sample, made)
    by_name = {item.parameter: item for item in found.responses}
    h = 1e-3
    ends = []
    for sign in (1.0, -1.0):
        inner = replace(run.problem.inner, S_max=run.problem.inner.S_max + sign * h)
        ends.append(structured_value(replace(run.problem, inner=inner), run.theta).bandwidth)
    slope = (ends[0] - ends[1]) / (2.0 * h)
    assert found.determined
    assert by_name["S_max"].bandwidth == pytest.approx(slope, rel=1e-3)
    assert by_name["S_max"].objective == pytest.approx(run.problem.w2 * slope, rel=1e-3)
    for name, value in zip(run.problem.names, run.theta, strict=True):
        assert value == pytest.approx(60.0, rel=1e-9)  # the bound, as near as it was reached
        i = run.problem.names.index(name)
        J = run.problem.w1 + run.problem.w2 * made.gradient[i]
        assert by_name[f"{name} upper"].objective == pytest.approx(J, rel=1e-9)


@pytest.mark.slow
def test_retraining_goes_on_from_the_runs_samples(folder: Path) -> None:
    out = folder / "retrained"
    before = json.loads((folder / "run" / "result.json").read_text())
    assert retrain_main([str(folder / "run"), "--out", str(out), "--budget", "6", *COMMON]) == 0
    after = json.loads((out / "result.json").read_text())
    assert after["status"] == "verified"
    assert after["objective"] == pytest.approx(before["objective"], rel=1e-3)
    assert after["anchors"] == before["anchors"]
    assert "Nyquist" in (out / "report.html").read_text()


@pytest.mark.slow
def test_compare_sets_the_methods_side_by_side(folder: Path) -> None:
    case = folder / "compared.toml"
    case.write_text(QUICK + "[baseline]\nstarts = 1\nsteps = [0.1]\nfirst_resonance_hz = 150.0\n")
    out = folder / "compared"
    assert compare_main([str(case), "--out", str(out), *COMMON]) == 0
    found = json.loads((out / "compare.json").read_text())
    methods, best = found["methods"], found["conclusions"]["best_objective"]
    assert "steepest_descent" not in methods
    for name in ("nested", "lifted", "direct", "steepest_descent_total"):
        assert methods[name]["status"] == "verified"
        assert methods[name]["objective"] == pytest.approx(best, rel=1e-3)
    assert methods["sequential"]["objective"] >= best
    assert "Left out" in (out / "report.html").read_text()


def test_no_structure_has_a_stacked_norm_below_gamma_opt() -> None:
    """γ_opt is a bound for every stabilising controller; some at random, of order 6."""
    rng, structure, case = np.random.default_rng(3), Structure(biquads=1), problem()
    weights = case.weights.at(600.0 * HZ, 40.0 * HZ)
    bounds = Bounds(S_max=2.0, S_low=0.1, omega_low=HZ)
    for theta in ((55.0, 55.0), (70.0, 58.0)):
        plant = scaled_plant(case, theta)
        least = synthesise(plant, weights, omega_low=HZ).figures.gamma_opt
        inside = problem_for([plant], structure, bounds)
        draws = np.exp(rng.uniform(-3.0, -0.5, 40))
        stable = stabilising(inside, at_random(inside, draws, rng))
        assert len(stable) > 3
        for kappa in stable:
            K = structure.state_space(structure.in_units(kappa, plant.omega_0, plant.force))
            found = measure(plant, K, weights, omega_low=weights.omega_T)
            stacked = found.certificate.norm if found.certificate.stable else np.inf
            assert stacked >= least * (1.0 - 1e-6)


def test_a_changed_controller_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changed = folder / "changed"
    shutil.copytree(folder / "run", changed)
    controller = json.loads((changed / "controller.json").read_text())
    controller["sections"]["kappa"][0] += 3.0  # 20 times the gain
    (changed / "controller.json").write_text(json.dumps(controller))
    assert deploy_main([str(changed), *COMMON]) == 2
    assert "not certified" in capsys.readouterr().err
    result = json.loads((changed / "result.json").read_text())
    result["anchors"][0].append(0.0)
    (changed / "result.json").write_text(json.dumps(result))
    shutil.copy(folder / "run" / "controller.json", changed / "controller.json")
    assert insight_main([str(changed), *COMMON]) == 2
    assert "anchors" in capsys.readouterr().err


def test_a_feedforward_for_the_set_settles_on_it_and_learns(folder: Path, tmp_path: Path) -> None:
    move = ["--stroke", "1e-3", "--jerk", "1e4", "--snap", "1e7", "--window", "1e-5", "--quiet"]
    move += ["--judges", "60"]
    words = [str(folder / "run"), "--out", str(tmp_path), *move]
    assert feedforward_main(words) == 0
    found = json.loads((tmp_path / "feedforward.json").read_text())
    assert found["kept"] == found["judged"] == 60
    assert found["settled"] <= found["settled_inverse"]
    assert found["peak_force"] <= found["peak_force_inverse"] * 1.002
    assert (tmp_path / "report.html").exists()
    # a move of a machine whose gain is 5 % higher
    run = as_it_runs(read_run(folder / "run"))
    G = run.plant.plant_si()
    shape = Shape(tuple(found["orders"]), 1, found["taps"], found["spacing"])
    profile = setpoint(MoveLimits(1e-3, 0.1, 2.0, 1e4, 1e7))
    machine = responses_of(run.loop_on(replace(G, B=1.05 * G.B)), profile, shape.orders, axis=0,
                           samples=found["samples"]).with_taps(shape)  # fmt: skip

    def error() -> np.ndarray:
        now = json.loads((tmp_path / "feedforward.json").read_text())
        x = shape.join(np.array(now["shaper"]), np.array(now["forces"]))
        return machine.tracking(x, shape)

    before = error()
    np.savetxt(tmp_path / "log.csv", before, header="error", comments="")
    assert feedforward_main([*words, "--learn", str(tmp_path / "log.csv")]) == 0
    assert np.linalg.norm(error()) < 0.5 * np.linalg.norm(before)
