"""The whole command: three formulations of case study 1, verified, infeasible and resumed."""

import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from oracles.commands import TWO_MASS, changed, own_plant, read, run
from oracles.helpers import (
    HZ,
    dense_grid,
    first_crossing,
    highest,
    reference_plant,
    to_control,
    two_mass_model,
)

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.formulations import Direct
from ccd_casadi.codesign.run import solve
from ccd_casadi.inner import main as inner
from ccd_casadi.kernels import compilation
from ccd_casadi.kernels.certified_design import CertifiedDesignOptions
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import FREE
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.sampling import sampler as sampling
from ccd_casadi.solve import main, summary
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Workers
from surrogates import load

KEYS = {
    "status", "theta", "omega_S_hz", "omega_T_hz", "objective", "hardware_cost", "bandwidth_hz",
    "surrogate_bandwidth_hz", "verification_error", "gamma_opt", "gamma", "gamma_lower_bound",
    "sensitivity_peak", "sensitivity_peak_hz", "sensitivity_low", "certificate", "active",
    "syntheses", "seconds", "versions", "seed", "formulation",
}  # fmt: skip
CERTIFICATE = {"stable", "max_real_pole", "norm", "norm_bound", "passed"}


@pytest.mark.parametrize(
    "formulation", [pytest.param("nested", marks=pytest.mark.slow), "lifted", "direct"]
)
def test_case_study_1_is_solved_and_verified(
    solved: Callable[[str], Path], formulation: str
) -> None:
    result = read(solved(formulation))
    assert set(result) >= KEYS
    assert set(result["certificate"]) == CERTIFICATE
    assert (result["status"], result["formulation"]) == ("verified", formulation)
    assert result["objective"] <= -438.7
    assert result["objective"] == pytest.approx(-438.756, abs=2e-3)
    assert result["theta"] == pytest.approx({"m1": 55.0, "m2": 55.0}, abs=1e-6)
    assert result["bandwidth_hz"] == pytest.approx(71.932, abs=1e-3)
    assert result["omega_S_hz"] == pytest.approx(1800.0, rel=1e-9)
    assert result["omega_T_hz"] == pytest.approx(26.042, abs=0.01)
    assert set(result["active"]) == {"m1 lower", "m2 lower", "S_max", "omega_S upper"}
    assert result["verification_error"] <= 1e-3
    true, predicted = result["bandwidth_hz"], result["surrogate_bandwidth_hz"]
    assert result["verification_error"] == pytest.approx(abs(predicted / true - 1.0), abs=1e-12)
    objective = 0.0995 * result["hardware_cost"] - 0.9950 * HZ * true
    assert result["objective"] == pytest.approx(objective, rel=1e-12)
    assert result["hardware_cost"] == pytest.approx(sum(result["theta"].values()), rel=1e-12)
    certificate = result["certificate"]
    assert (certificate["passed"], certificate["stable"]) == (True, True)
    assert certificate["max_real_pole"] < 0.0
    assert certificate["norm"] <= certificate["norm_bound"]
    assert result["gamma_lower_bound"] <= result["gamma_opt"] <= result["gamma"]
    freed = 1.0 + CertifiedDesignOptions.freed  # of the free stage
    assert result["gamma"] <= 1.02 * result["gamma_opt"] * freed
    assert result["sensitivity_peak"] <= 1.75
    assert result["sensitivity_low"] <= 0.03


def test_lifted_spends_few_syntheses_and_loses_nothing(solved: Callable[[str], Path]) -> None:
    nested, lifted, direct = (read(solved(name)) for name in ("nested", "lifted", "direct"))
    assert lifted["syntheses"] == sum(lifted["spent"].values())
    assert lifted["syntheses_to_optimum"] == lifted["syntheses"] - lifted["spent"]["box_look"] <= 60
    for result in (lifted, direct):
        loss = result["objective"] - nested["objective"]
        assert loss <= 1e-6 * abs(nested["objective"])
    for result in (nested, lifted, direct):
        kkt = result["kkt"]
        assert kkt["stationarity"] < 1e-6
        assert kkt["primal"] < 1e-8
        assert kkt["complementarity"] < 1e-6
        assert all(value >= 0.0 for value in kkt["multipliers"].values())
        assert kkt["multipliers"]["S_max"] > 1.0
        assert kkt["multipliers"]["omega_S upper"] > 1.0


def test_bandwidth_is_reproduced_by_python_control(solved: Callable[[str], Path]) -> None:
    """From controller.json and the plant's M, D, K, B, C, nothing else."""
    folder = solved("nested")
    result = read(folder)
    data = json.loads((folder / "controller.json").read_text())
    assert (data["input"], data["output"]) == ("e = r - y", "u")
    controller = StateSpace(*(np.array(data[name]) for name in "ABCD"))
    theta = list(result["theta"].values())
    plant = reference_plant(mechanics(two_mass_model(), theta), FREE)
    G, K = to_control(plant), control.ss(*(data[name] for name in "ABCD"))
    loop = control.feedback(control.ss([], [], [], 1.0), G * K)
    assert loop.poles().real.max() < 0.0

    def gain(omega: np.ndarray) -> np.ndarray:
        return np.abs(loop(1j * np.atleast_1d(omega)))

    grid = dense_grid(plant, controller)
    crossing = first_crossing(gain, grid, 1.0 / np.sqrt(2.0)) / HZ
    assert crossing == pytest.approx(result["bandwidth_hz"], rel=1e-6)
    peak, at = highest(gain, grid)
    assert peak == pytest.approx(result["sensitivity_peak"], rel=1e-6)
    assert at / HZ == pytest.approx(result["sensitivity_peak_hz"], rel=1e-4)
    assert gain(np.array([HZ]))[0] == pytest.approx(result["sensitivity_low"], rel=1e-6)


def test_inner_gives_the_same_design_at_the_same_theta(
    solved: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    result = read(solved("nested"))
    assert inner([str(TWO_MASS), "--theta", "m1=55,m2=55", "--workers", "1"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["bandwidth_hz"] == pytest.approx(result["bandwidth_hz"], rel=1e-6)
    assert answer["objective"] == pytest.approx(result["objective"], rel=1e-6)
    assert set(answer["active"]) == {"S_max", "omega_S upper"}


@pytest.mark.parametrize(("formulation", "outputs"), [("nested", 1), ("lifted", 3)])
def test_the_surrogate_reloads_and_predicts_what_was_said(
    solved: Callable[[str], Path], formulation: str, outputs: int
) -> None:
    folder = solved(formulation)
    result = read(folder)
    processes, extra = load(folder / "surrogate.json")
    assert (len(processes), extra["formulation"]) == (outputs, formulation)
    x = list(result["theta"].values())
    if formulation == "lifted":
        x += [np.log(HZ * result["omega_S_hz"]), np.log(HZ * result["omega_T_hz"])]
    predicted = float(processes[0].predict(np.array([x]))[0]) / HZ
    assert predicted == pytest.approx(result["surrogate_bandwidth_hz"], rel=1e-12)


def test_the_run_folder_holds_what_the_contract_says(solved: Callable[[str], Path]) -> None:
    folder = solved("nested")
    names = {"case.toml", "samples.sqlite", "surrogate.json", "controller.json", "result.json"}
    assert names <= {path.name for path in folder.iterdir()}
    again, case = load_case(folder / "case.toml"), load_case(TWO_MASS)
    assert {**vars(again), "path": None} == {**vars(case), "path": None}
    for path in folder.iterdir():
        assert path.read_bytes()[:1] != b"\x80", f"{path.name} is a pickle"
    for name in ("result.json", "controller.json", "surrogate.json"):
        json.loads((folder / name).read_text(), parse_constant=lambda word: pytest.fail(word))


def test_the_report_opens_offline(solved: Callable[[str], Path]) -> None:
    page = (solved("lifted") / "report.html").read_text()
    assert re.findall(r"""(?:src|href)\s*=\s*["']?\s*(?:https?:)?//[^"'\s>]*""", page) == []
    assert re.findall(r"""(?:url\(|@import)\s*["']?\s*(?:https?:)?//""", page) == []


def test_a_run_without_a_report_has_everything_else(
    solved: Callable[[str], Path], tmp_path: Path
) -> None:
    ignored = shutil.ignore_patterns("*-shm", "*-wal")
    folder = Path(shutil.copytree(solved("lifted"), tmp_path / "run", ignore=ignored))
    before = {path.name for path in folder.iterdir()}
    assert "report.html" in before
    assert run(folder, "--no-report", "--formulation", "lifted") == 0
    assert {path.name for path in folder.iterdir()} == before - {"report.html", "index.html"}


@pytest.mark.parametrize(("more", "groups"), [([], {"loops", "synthesis"}),
                                              (["--no-report"], {"loops"})])  # fmt: skip
def test_the_kernels_of_its_pages_are_compiled_before_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str], groups: set[str]
) -> None:
    def required_groups(*names: str) -> None:
        assert set(names) == groups
        raise UserError("they are known")

    monkeypatch.setattr(compilation, "ensure_compiled", required_groups)
    built = TWO_MASS.with_name("two_mass_built.toml")
    assert main([str(built), "--out", str(tmp_path), *more]) == 2
    assert not any(tmp_path.iterdir())


def test_a_second_run_reuses_every_sample(
    solved: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = Path(shutil.copytree(solved("nested"), tmp_path / "run"))
    before = read(folder)

    def untouchable(*_: Any, **more: Any) -> None:
        raise AssertionError("this was sampled already")

    monkeypatch.setattr(sampling, "inner_unit", untouchable)
    monkeypatch.setattr(sampling, "design_unit", untouchable)
    words = [str(TWO_MASS), "--out", str(folder), "--workers", "1", "--resume", "--no-report"]
    assert main(words) == 0
    assert f"resuming      {folder / 'samples.sqlite'} holds " in capsys.readouterr().err
    after = read(folder)
    assert after.pop("seconds") < before.pop("seconds")
    assert after.pop("phase_seconds").keys() == before.pop("phase_seconds").keys()
    assert after == before


def test_the_summary_says_what_matters(
    solved: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(solved("direct"), tmp_path / "run"))
    words = [str(TWO_MASS), "--out", str(folder), "--workers", "1", "--formulation", "direct"]
    assert main([*words, "--no-report"]) == 0
    lines = capsys.readouterr().out.splitlines()
    found = {line.split()[0]: line for line in lines}
    assert "verified" in found["status"]
    assert "m1 = 55 kg, m2 = 55 kg" in found["theta"]
    assert "-438.75" in found["objective"]
    assert "71.93" in found["bandwidth"]
    assert "passed" in found["certified"]
    assert "S_max" in found["binding"]
    assert str(folder) in found["run"]


@pytest.mark.parametrize("formulation", ["lifted", pytest.param("nested", marks=pytest.mark.slow)])
def test_the_result_does_not_depend_on_the_number_of_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, formulation: str
) -> None:
    """To the last bit, seconds aside; the pool is started although the work is short."""
    command = sys.modules[main.__module__]
    monkeypatch.setattr(command, "pool", lambda scheduler, count, patience: Workers(count))
    quick = "\n[sampling]\npoints = 2\nlifted_points = 12\n[outer]\nstarts = 2\nbox_points = 4\n"
    case = changed(tmp_path, more=quick + "max_refinements = 0\n")
    for workers in ("1", "2"):
        words = ["--out", str(tmp_path / workers), "--quiet", "--formulation", formulation]
        words += ["--no-report"]
        assert main([str(case), *words, "--workers", workers]) in (0, 4)
    one, two = (read(tmp_path / workers) for workers in ("1", "2"))
    assert one.pop("seconds") > 0.0 < two.pop("seconds")
    assert one.pop("phase_seconds").keys() == two.pop("phase_seconds").keys()
    assert one == two
    for name in ("controller.json", "surrogate.json", "case.toml"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


# ---- constraints, and cases that cannot be solved ------------------------------------------------


@pytest.mark.slow
def test_a_plants_own_constraint_binds_in_every_formulation(tmp_path: Path) -> None:
    quick = "\n[sampling]\npoints = 4\nlifted_points = 16\n[outer]\nstarts = 2\nbox_points = 0\n"
    case = own_plant(tmp_path, 118.0, quick + "direct_starts = 1\n")
    objectives = []
    for formulation in ("nested", "lifted", "direct"):
        folder = tmp_path / formulation
        assert run(folder, "--no-report", "--formulation", formulation, case=case) == 0
        result = read(folder)
        assert sum(result["theta"].values()) >= 118.0 - 1e-9
        assert "total" in result["active"]
        assert result["kkt"]["multipliers"]["total"] > 0.0
        objectives.append(result["objective"])
    assert max(objectives) - min(objectives) <= 1e-6 * abs(objectives[0])
    assert min(objectives) > -438.7, "the constraint costs something"


@pytest.mark.parametrize(
    "formulation",
    ["nested", *(pytest.param(way, marks=pytest.mark.slow) for way in ("lifted", "direct"))],
)
def test_an_infeasible_case_says_what_and_by_how_much(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], formulation: str
) -> None:
    case = changed(
        tmp_path, ("S_max = 1.75", "S_max = 1.05"),
        more="\n[sampling]\npoints = 2\nlifted_points = 12\n[outer]\nmax_refinements = 1\n",
    )  # fmt: skip
    assert run(tmp_path / "run", "--formulation", formulation, case=case) == 3
    result = read(tmp_path / "run")
    assert (result["status"], result["formulation"]) == ("infeasible", formulation)
    found = re.search(r"the least peak of S of all is ([0-9.]+)", result["reason"])
    assert found, result["reason"]
    with sampling.SampleStore(tmp_path / "run" / "samples.sqlite") as store:
        least = min(row.sensitivity_peak for row in store.select() if row.certified)
    assert float(found[1]) == pytest.approx(least, rel=1e-3), "not the first one's that was met"
    assert 1.05 < least < 1.75
    assert result["reason"].startswith("none found among the mixed-sensitivity")
    assert "nearest at m1=" in result["reason"]
    assert not (tmp_path / "run" / "controller.json").exists()
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors == f"{case}: {result['reason']}\n"


@pytest.mark.parametrize("formulation", ["nested", "direct"])
def test_a_constraint_that_no_theta_meets_is_named(tmp_path: Path, formulation: str) -> None:
    case = own_plant(tmp_path, 141.5, "\n[sampling]\npoints = 2\n[outer]\nmax_refinements = 1\n")
    assert run(tmp_path / "run", "--formulation", formulation, case=case) == 3
    result = read(tmp_path / "run")
    assert result["status"] == "infeasible"
    assert "total" in result["reason"]
    assert "1.5" in result["reason"], "by how much"


def test_what_is_not_verified_is_not_called_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strict = "[outer]\ntolerance = 1e-15\nmax_refinements = 0\nbox_points = 0\n"
    case = changed(tmp_path, more=f"\n[sampling]\npoints = 2\n{strict}")
    assert run(tmp_path / "run", "--no-report", case=case) == 4
    result = read(tmp_path / "run")
    assert result["status"] == "not_verified"
    assert result["checks"]["prediction"] is False
    assert result["checks"]["certificate"] is True
    assert "prediction" in result["reason"]
    assert result["verification_error"] > 1e-15
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors == f"{case}: {result['reason']}\n"
    assert (tmp_path / "run" / "controller.json").exists()


def test_an_infeasible_run_leaves_no_design_of_an_earlier_one(
    solved: Callable[[str], Path], tmp_path: Path
) -> None:
    """The folder is reused with a harder case: what lies in it must belong together."""
    small = "\n[sampling]\npoints = 2\n[outer]\nmax_refinements = 0\nbox_points = 0\n"
    shutil.copytree(solved("nested"), tmp_path / "run")
    for name in ("controller.json", "surrogate.json"):
        assert (tmp_path / "run" / name).exists()
    case = changed(tmp_path, ("S_max = 1.75", "S_max = 1.05"), more=small)
    assert run(tmp_path / "run", case=case) == 3
    assert not (tmp_path / "run" / "controller.json").exists()
    assert not (tmp_path / "run" / "surrogate.json").exists()


def test_a_design_that_exceeds_a_constraint_has_no_objective_and_a_summary() -> None:
    """J of it is not known: result.json has null, and the terminal says so."""
    problem = problem_of(load_case(TWO_MASS))
    solution = solve(problem, Direct(starts=1, box_points=0))
    exceeded = replace(solution, result=solution.result | {"objective": None})
    assert "objective     not known" in summary(exceeded)
