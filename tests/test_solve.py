"""The whole command: three formulations of case study 1, verified, refused and resumed."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from helpers import (
    HZ,
    dense_grid,
    first_crossing,
    highest,
    reference_plant,
    to_control,
    two_mass_model,
)

from ccd_casadi import sampling
from ccd_casadi.case import load_case
from ccd_casadi.inner_command import main as inner
from ccd_casadi.parallel import WorkerLost
from ccd_casadi.plant import mechanics
from ccd_casadi.scaling import StateSpace
from ccd_casadi.solve import main
from surrogates import load

TWO_MASS = Path(__file__).parent.parent / "runs" / "two_mass.toml"
KEYS = {
    "status", "theta", "omega_S_hz", "omega_T_hz", "objective", "hardware_cost", "bandwidth_hz",
    "surrogate_bandwidth_hz", "verification_error", "gamma_opt", "gamma", "gamma_lower_bound",
    "sensitivity_peak", "sensitivity_peak_hz", "sensitivity_low", "certificate", "active",
    "syntheses", "seconds", "versions", "seed", "formulation",
}  # fmt: skip
CERTIFICATE = {"stable", "max_real_pole", "norm", "norm_bound", "passed"}
PLANT = """
from ccd_casadi.models import MODELS

def model(theta, least):
    total = theta["m1"] + theta["m2"]
    return MODELS["two_mass"](theta, 0.01) | {"constraints": {"total": least - total}}
"""


def run(folder: Path, *more: str, case: Path = TWO_MASS) -> int:
    return main([str(case), "--out", str(folder), "--workers", "1", "--quiet", *more])


def read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


def changed(folder: Path, *changes: tuple[str, str], more: str = "") -> Path:
    """A copy of the two-mass case with lines replaced and sections appended."""
    text = TWO_MASS.read_text()
    for old, new in changes:
        assert text.count(old) == 1, f"{old} is not once in the case file"
        text = text.replace(old, new)
    path = folder / "case.toml"
    path.write_text(text + more)
    return path


def own_plant(folder: Path, least: float, more: str = "") -> Path:
    (folder / "plant.py").write_text(PLANT)
    lines = f'function = "plant.py:model"\nleast = {least}\n'
    text = re.sub(r'model = "two_mass".*\nzeta = .*\n', lines, TWO_MASS.read_text())
    path = folder / "case.toml"
    path.write_text(text + more)
    return path


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The run folder of a formulation, solved once."""
    folders: dict[str, Path] = {}

    def solve(formulation: str) -> Path:
        if formulation not in folders:
            folder = tmp_path_factory.mktemp(formulation) / "run"
            assert run(folder, "--formulation", formulation) == 0
            folders[formulation] = folder
        return folders[formulation]

    return solve


@pytest.mark.parametrize("formulation", ["nested", "lifted", "direct"])
def test_case_study_1_is_solved_and_verified(
    solved: Callable[[str], Path], formulation: str
) -> None:
    result = read(solved(formulation))
    assert set(result) >= KEYS
    assert set(result["certificate"]) == CERTIFICATE
    assert (result["status"], result["formulation"]) == ("verified", formulation)
    assert result["objective"] <= -439.4
    assert result["objective"] == pytest.approx(-439.465, abs=2e-3), "an independent prototype's"
    assert result["theta"] == pytest.approx({"m1": 55.0, "m2": 55.0}, abs=1e-6)
    assert result["bandwidth_hz"] == pytest.approx(72.045, abs=1e-3)
    assert result["omega_S_hz"] == pytest.approx(1800.0, rel=1e-9)
    assert result["omega_T_hz"] == pytest.approx(26.07, abs=0.01)
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
    assert result["gamma"] <= 1.02 * result["gamma_opt"] * (1.0 + 1e-6)
    assert result["sensitivity_peak"] <= 1.75
    assert result["sensitivity_low"] <= 0.03


def test_lifted_spends_few_syntheses_and_loses_nothing(solved: Callable[[str], Path]) -> None:
    nested, lifted, direct = (read(solved(name)) for name in ("nested", "lifted", "direct"))
    assert lifted["syntheses"] <= 200
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
    plant = reference_plant(mechanics(two_mass_model(), theta))
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
    path = solved("nested") / "report.html"
    if not path.exists() or not path.read_text():
        pytest.skip("no report is written yet")
    page = path.read_text()
    assert re.findall(r"""(?:src|href)\s*=\s*["']?\s*(?:https?:)?//[^"'\s>]*""", page) == []
    assert re.findall(r"""(?:url\(|@import)\s*["']?\s*(?:https?:)?//""", page) == []


def test_a_second_run_reuses_every_sample(
    solved: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = solved("nested")
    before = read(folder)

    def untouchable(*_: Any) -> None:
        raise AssertionError("this was sampled already")

    monkeypatch.setattr(sampling, "inner_unit", untouchable)
    monkeypatch.setattr(sampling, "design_unit", untouchable)
    assert run(folder, "--resume") == 0
    after = read(folder)
    assert after.pop("seconds") < before.pop("seconds")
    assert after == before


def test_the_summary_says_what_matters(
    solved: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = solved("direct")
    words = [str(TWO_MASS), "--out", str(folder), "--workers", "1", "--formulation", "direct"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    found = {line.split()[0]: line for line in lines}
    assert "verified" in found["status"]
    assert "m1 = 55 kg, m2 = 55 kg" in found["theta"]
    assert "-439.46" in found["objective"]
    assert "72.04" in found["bandwidth"]
    assert "passed" in found["certificate"]
    assert "S_max" in found["binding"]
    assert str(folder) in found["run"]


@pytest.mark.parametrize("formulation", ["lifted", pytest.param("nested", marks=pytest.mark.slow)])
def test_the_result_does_not_depend_on_the_number_of_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, formulation: str
) -> None:
    """To the last bit, seconds aside; the pool is started although the work is short."""
    monkeypatch.setattr("ccd_casadi.solve.PATIENCE", 0.0)
    quick = "\n[sampling]\npoints = 2\nlifted_points = 12\n[outer]\nstarts = 2\n"
    case = changed(tmp_path, more=quick + "max_refinements = 0\n")
    for workers in ("1", "2"):
        words = ["--out", str(tmp_path / workers), "--quiet", "--formulation", formulation]
        assert main([str(case), *words, "--workers", workers]) in (0, 4)
    one, two = (read(tmp_path / workers) for workers in ("1", "2"))
    assert one.pop("seconds") > 0.0 < two.pop("seconds")
    assert one == two
    for name in ("controller.json", "surrogate.json", "case.toml"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


# ---- constraints, and cases that cannot be solved ------------------------------------------------


def test_a_plants_own_constraint_binds_in_every_formulation(tmp_path: Path) -> None:
    case = own_plant(tmp_path, 118.0, "\n[sampling]\npoints = 4\n")
    objectives = []
    for formulation in ("nested", "lifted", "direct"):
        folder = tmp_path / formulation
        assert run(folder, "--formulation", formulation, case=case) == 0
        result = read(folder)
        assert sum(result["theta"].values()) >= 118.0 - 1e-9
        assert "total" in result["active"]
        assert result["kkt"]["multipliers"]["total"] > 0.0
        objectives.append(result["objective"])
    assert max(objectives) - min(objectives) <= 1e-6 * abs(objectives[0])
    assert min(objectives) > -439.4, "the constraint costs something"


@pytest.mark.parametrize("formulation", ["nested", "lifted", "direct"])
def test_an_infeasible_case_says_what_and_by_how_much(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], formulation: str
) -> None:
    case = changed(
        tmp_path, ("S_max = 1.75", "S_max = 1.05"),
        more="\n[sampling]\npoints = 3\nlifted_points = 16\n[outer]\nmax_refinements = 2\n",
    )  # fmt: skip
    assert run(tmp_path / "run", "--formulation", formulation, case=case) == 3
    result = read(tmp_path / "run")
    assert (result["status"], result["formulation"]) == ("infeasible", formulation)
    found = re.fullmatch(
        r"S_max = 1\.05 cannot be met: the least peak of S found is ([0-9.]+)", result["reason"]
    )
    assert found, result["reason"]
    assert 1.05 < float(found[1]) < 1.75
    assert not (tmp_path / "run" / "controller.json").exists()
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors == f"{case}: {result['reason']}\n"


def test_the_least_shortfall_is_the_one_that_is_told(tmp_path: Path) -> None:
    """Not that of the first θ sampled, nor of the one with the shortest words."""
    case = changed(tmp_path, ("S_max = 1.75", "S_max = 1.05"), more="\n[sampling]\npoints = 3\n")
    assert run(tmp_path / "run", case=case) == 3
    told = float(read(tmp_path / "run")["reason"].rsplit(" ", 1)[1])
    with sampling.SampleStore(tmp_path / "run" / "samples.sqlite") as store:
        least = min(row.sensitivity_peak for row in store.select() if row.certified)
    assert told == pytest.approx(least, rel=1e-3)


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
    case = changed(
        tmp_path,
        more="\n[sampling]\npoints = 2\n[outer]\ntolerance = 1e-15\nmax_refinements = 0\n",
    )
    assert run(tmp_path / "run", case=case) == 4
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


def test_an_infeasible_run_leaves_no_design_of_an_earlier_one(tmp_path: Path) -> None:
    """The folder is reused with a harder case: what lies in it must belong together."""
    small = "\n[sampling]\npoints = 2\n[outer]\nmax_refinements = 0\n"
    case = changed(tmp_path, more=small)
    run(tmp_path / "run", case=case)
    assert (tmp_path / "run" / "controller.json").exists()
    case = changed(tmp_path, ("S_max = 1.75", "S_max = 1.05"), more=small)
    assert run(tmp_path / "run", case=case) == 3
    assert not (tmp_path / "run" / "controller.json").exists()
    assert not (tmp_path / "run" / "surrogate.json").exists()


# ---- bad input, through the commands -------------------------------------------------------------


def refusal(words: list[str], capsys: pytest.CaptureFixture[str], command: Any = main) -> str:
    """The one line on stderr of a command that refuses its input."""
    assert command(words) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.endswith("\n")
    line = errors[:-1]
    assert len(line.splitlines()) == 1
    assert line.isprintable()
    return line


FILES: dict[str, tuple[bytes | None, str]] = {
    "absent": (None, "there is no such file"),
    "empty": (b"", "plant: is missing; add a table [plant]"),
    "latin-1": (b'[plant]\nmodel = "caf\xe9"\n', "not UTF-8"),
    "broken": (b"[plant\n", "is not valid TOML"),
    "binary": (bytes(range(256)), "is not"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("command", [main, inner], ids=["solve", "inner"])
def test_a_wrong_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, command: Any
) -> None:
    content, words = FILES[name]
    path = tmp_path / "bad.toml"
    if content is not None:
        path.write_bytes(content)
    more = [] if command is main else ["--theta", "m1=60,m2=60"]
    line = refusal([str(path), *more], capsys, command)
    assert line.startswith(f"{path}: ")
    assert words in line
    assert not (tmp_path / "bad").exists(), "nothing is written for a wrong file"


def test_a_folder_for_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "name a readable file" in refusal([str(tmp_path)], capsys)
    assert "name a readable file" in refusal([str(TWO_MASS / "x.toml")], capsys)


@pytest.mark.parametrize(
    ("old", "new", "key", "remedy"),
    [
        ("S_max = 1.75", "S_max = 0.9", "inner.S_max", "give more than 1"),
        ("S_max = 1.75", "S_max = nan", "inner.S_max", "give"),
        ("S_max = 1.75", "S_mx = 1.75", "inner.S_mx", "did you mean S_max?"),
        ("S_low = 0.03", 'S_low = "0.03"', "inner.S_low", "give a number"),
        ("omega_low_hz = 1.0", "omega_low_hz = -1.0", "inner.omega_low_hz", "above 0"),
        ("[10.0, 1800.0]", "[1800.0, 10.0]", "inner.omega_S_hz", "low < high"),
        ("[25.0, 1000.0]", "[25.0]", "inner.omega_T_hz", "two positive numbers"),
        ("w2 = -0.9950", "w2 = 0.9950", "objective.w2", "give a negative number"),
        ("w1 = 0.0995", "w1 = -1.0", "objective.w1", "give 0 or more"),
        ("M_K = 2e7", "", "weights.M_K", "add it"),
        ("M_K = 2e7", "M_K = true", "weights.M_K", "give a number"),
        ("gamma_backoff = 1.02", "gamma_backoff = 1", "inner.gamma_backoff", "above 1"),
        ('model = "two_mass"', 'model = "two_masses"', "plant.model", "did you mean two_mass?"),
        ('model = "two_mass"', 'function = "no.py:f"', "plant", "relative to the case file"),
        ("[theta.m1]", "[theta.mass]", "theta.mass", "known are m1, m2"),
        ("[weights]", "[wieghts]", "wieghts", "did you mean weights?"),
    ],
)
def test_a_wrong_case_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, key: str, remedy: str
) -> None:
    path = changed(tmp_path, (old, new))
    line = refusal([str(path), "--out", str(tmp_path / "run")], capsys)
    assert line.startswith(f"{path}: {key}")
    assert remedy in line
    assert not (tmp_path / "run").exists()


GOOD = (
    'dict(mass=ca.diag(ca.vertcat(t["m1"], t["m2"])), damping_ratio=0.01, input=ca.DM([1, 0]), '
    "output=ca.DM([[1, 0]]), stiffness=1e8 * ca.DM([[1, -1], [-1, 1]]), "
    'hardware_cost=t["m1"] + t["m2"])'
)


def plant_file(folder: Path, source: str) -> Path:
    (folder / "plant.py").write_text(source)
    text = re.sub(
        r'model = "two_mass".*\nzeta = .*\n', 'function = "plant.py:f"\n', TWO_MASS.read_text()
    )
    path = folder / "own.toml"
    path.write_text(text + "\n[sampling]\npoints = 2\n")
    return path


def model(result: str) -> str:
    return f"import math\nimport casadi as ca\n\ndef f(t, **options):\n    return {result}\n"


def test_a_users_plant_is_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = plant_file(tmp_path, model(GOOD))
    words = [str(path), "--theta", "m1=60,m2=60", "--omega-s-hz", "100", "--omega-t-hz", "100"]
    assert inner(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert max(answer["natural_hz"]) == pytest.approx(np.sqrt(2e8 / 60.0) / HZ, rel=1e-6)
    assert answer["hardware_cost"] == 120.0


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import nothing_like_this\n", "cannot be loaded: ModuleNotFoundError"),
        ("def f(t: return\n", "cannot be loaded: SyntaxError"),
        ("x = 1 / 0\n", "cannot be loaded: ZeroDivisionError"),
        ('raise ValueError("two\\nlines \\x1b[31m")\n', "cannot be loaded: ValueError: two lines"),
        ("g = 1\n", "defines no function f; check plant.function"),
        ("f = 1\n", "defines no function f; check plant.function"),
        ("def f(): pass\n", "does not take its options"),
        (model('t["m3"]'), "m3"),
        (model("1 / 0"), "ZeroDivisionError"),
        (model("undefined"), "NameError"),
        (model("None"), "plant"),
        (model("[1, 2]"), "plant"),
        (model("{}"), "returns no mass"),
        (model(GOOD + " | {'mas': 1}"), "unknown mas; drop it"),
        (model(GOOD + " | {'damping': 0}"), "either damping or damping_ratio"),
        (model(GOOD + " | {'mass': 'heavy'}"), "plant"),
        (model(GOOD + " | {'mass': ca.DM.ones(2, 3)}"), "mass"),
        (model(GOOD + " | {'stiffness': 1}"), "stiffness"),
        (model(GOOD + " | {'input': ca.DM.ones(3, 1)}"), "input"),
        (model(GOOD + " | {'damping_ratio': 2}"), "between 0 and 1"),
        (model(GOOD + " | {'damping_ratio': t['m1']}"), "damping_ratio"),
        (model(GOOD + " | {'constraints': [1]}"), "plant"),
        (model(GOOD + " | {'hardware_cost': ca.DM([1, 2])}"), "hardware_cost"),
        (model(GOOD + " | {'constraints': {'a': ca.DM([1, 2])}}"), "a is"),
    ],
)
def test_a_users_plant_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str, words: str
) -> None:
    path = plant_file(tmp_path, source)
    line = refusal([str(path), "--out", str(tmp_path / "run"), "--quiet"], capsys)
    assert line.startswith(f"{path}: plant")
    assert words in line
    assert len(line) < 500
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (GOOD + " | {'mass': ca.diag(ca.vertcat(60 - t['m1'], 1))}", "mass is not positive def"),
        (GOOD + " | {'stiffness': math.nan * ca.DM.ones(2, 2)}", "is not finite at theta = m1="),
        (GOOD + " | {'stiffness': ca.DM([[1, 2], [3, 4]])}", "stiffness is not symmetric"),
    ],
)
def test_a_plant_that_fails_at_some_theta_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], result: str, words: str
) -> None:
    path = plant_file(tmp_path, model(result))
    line = refusal([str(path), "--out", str(tmp_path / "run"), "--quiet"], capsys)
    assert words in line
    assert line.startswith(f"{path}: plant: ")


def test_a_design_that_rounding_destroys_is_not_verified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Found by fuzzing: a plant of gain 1e12, whose loop hangs on digits that doubles lack."""
    plant = GOOD.replace("ca.DM([1, 0])", "ca.DM([[1e12, 0], [0, 0]])")
    path = plant_file(tmp_path, model(plant))
    words = ["--theta", "m1=60,m2=60", "--omega-s-hz", "56.462161732861716"]
    assert inner([str(path), *words, "--omega-t-hz", "292.4017738213266"]) == 4
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "not_verified"


def test_lost_workers_leave_a_run_to_be_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: Any) -> None:
        raise WorkerLost("a worker process died twice on the task x")

    monkeypatch.setattr(sampling, "inner_unit", killed)
    assert run(tmp_path / "run") == 130
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert "died twice" in errors
    assert "the same command resumes from there" in errors


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ("m1=60", "m2 is missing; give all of m1, m2"),
        ("60,60", "not of the form name=value"),
        ("m1=60,m9=60", "'m9' is no parameter of the case; known are m1, m2"),
        ("m1=60,m2=6o", "is not a number"),
        ("m1=60,m2=nan", "outside its bounds"),
        ("m1=60,m2=80", "outside its bounds; give 55 to 70"),
        ("m1=60,m1=60", "given twice"),
    ],
)
def test_a_wrong_theta_is_refused(
    capsys: pytest.CaptureFixture[str], theta: str, words: str
) -> None:
    line = refusal([str(TWO_MASS), "--theta", theta], capsys, inner)
    assert line.startswith(f"{TWO_MASS}: --theta: ")
    assert words in line


@pytest.mark.parametrize(
    "more", [["--omega-s-hz", "100"], ["--omega-t-hz", "100"], ["--omega-s-hz", "-1"]]
)
def test_wrong_frequencies_are_refused(capsys: pytest.CaptureFixture[str], more: list[str]) -> None:
    line = refusal([str(TWO_MASS), "--theta", "m1=60,m2=60", *more], capsys, inner)
    assert "--omega-s-hz" in line


def test_a_store_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "samples.sqlite").write_text("these are no samples\n" * 100)
    line = refusal([str(TWO_MASS), "--out", str(tmp_path)], capsys)
    assert line.startswith(f"{tmp_path / 'samples.sqlite'}: ")
    assert "choose another --out" in line


@pytest.mark.parametrize(
    "words",
    [
        ["ccd_casadi.solve", "bad.toml"],
        ["ccd_casadi.solve", "absent.toml"],
        ["ccd_casadi.inner", "bad.toml", "--theta", "m1=60,m2=60"],
        ["ccd_casadi.solve", "own.toml"],
    ],
)
def test_the_real_command_refuses_in_one_line(tmp_path: Path, words: list[str]) -> None:
    changed(tmp_path, ("S_max = 1.75", "S_max = 1.0")).rename(tmp_path / "bad.toml")
    plant_file(tmp_path, "import nothing_like_this\n")
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith(words[1] + ": ")
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) in ([], ["__pycache__"])
