"""What comes from a colleague executes nothing but the plant function it names, and on request not
even that; no name in a file leads out of the run folder."""

import importlib
import importlib.util
import json
import os
import pickle
import py_compile
import shutil
from pathlib import Path

import pytest

from ccd_casadi.__main__ import commands
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner import main as inner
from ccd_casadi.inner_problem.plant_source import _build
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.retrain import formulation_in
from ccd_casadi.solve import main as solve
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.user_code import permit_user_code, time_limit
from surrogates import SurrogateFileError, load

ROOT = Path(__file__).parents[2]
TRAP = """
import pathlib
(pathlib.Path(__file__).parent / "executed").touch()
from ccd_casadi.plants.registry import two_mass

def f(theta, **options):
    return two_mass(theta, 0.01)
"""


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A case whose plant leaves a file behind as soon as anything of it runs."""
    (tmp_path / "trap.py").write_text(TRAP)
    text = (ROOT / "runs" / "two_mass.toml").read_text()
    start, end = text.index("model ="), text.index("[theta")
    path = tmp_path / "trap.toml"
    path.write_text(text[:start] + 'function = "trap.py:f"\n\n' + text[end:])
    return path


@pytest.fixture
def trapped_run(two_mass_run: Path, trap: Path) -> Path:
    """A finished run whose case file was exchanged for the trap."""
    folder = Path(
        shutil.copytree(
            two_mass_run, trap.parent / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    for name in ("report.json", "report.html"):  # with them `report` needs no plant
        (folder / name).unlink()
    shutil.copy(trap, folder / "case.toml")
    shutil.copy(trap.parent / "trap.py", folder)
    return folder


# ---- user code -----------------------------------------------------------------------------------


OF_A_RUN = {"ccd_casadi.insight", "ccd_casadi.deploy", "ccd_casadi.robustness",
            "ccd_casadi.retrain", "ccd_casadi.report",
            "ccd_casadi.extensions.feedforward"}  # fmt: skip
NUMBERS = ("imported", "record", "tune")  # take numbers, no case
COMMANDS = sorted(module for word, (module, _) in commands().items() if word not in NUMBERS)


@pytest.mark.parametrize("name", COMMANDS)
def test_no_user_code_refuses_a_plant_function_and_runs_nothing_of_it(
    trapped_run: Path, trap: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    module = importlib.import_module(name)
    if "drives" in name:  # which designs cases with this table alone
        trap.write_text(f'{trap.read_text()}\n[drive]\nname = "generic"\n')
    words = [str(trapped_run if name in OF_A_RUN else trap), "--no-user-code"]
    words += ["--theta", "m1=60,m2=60"] if "inner" in name or "cross" in name else ["--quiet"]
    assert module.main(words) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert "trap.py:f is code, which --no-user-code refuses" in errors
    assert ("case.toml" if name in OF_A_RUN else "trap.toml") in errors
    assert not list(trap.parent.rglob("executed"))


def test_all_commands_are_found() -> None:
    assert {"ccd_casadi.solve", "ccd_casadi.inner", *OF_A_RUN} <= set(COMMANDS)


def test_models_of_the_package_are_no_user_code(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--theta", "m1=60,m2=60", "--omega-s-hz", "800", "--omega-t-hz", "40"]
    assert inner([str(ROOT / "runs" / "two_mass.toml"), *words, "--no-user-code"]) == 0


def test_a_plant_that_was_built_before_is_refused_too(trap: Path) -> None:
    problem = problem_of(load_case(trap))
    plant_of(problem)
    with permit_user_code(allowed=False), pytest.raises(UserError, match="refuses"):
        plant_of(problem)
    plant_of(problem)  # and allowed again afterwards


def test_an_edited_plant_is_not_the_one_kept_in_memory(trap: Path) -> None:
    """In a notebook, or on a Dask worker that lives longer than a run."""
    path = trap.parent / "trap.py"
    first = problem_of(load_case(trap))
    before = plant_of(first).hardware
    path.write_text(TRAP.replace("0.01)", '0.01) | {"hardware_cost": 7 * theta["m1"]}'))
    second = problem_of(load_case(trap))
    assert first.identity() != second.identity()
    assert float(plant_of(second).hardware([60.0, 60.0])[0]) == 420.0
    assert plant_of(first).hardware is before
    copied = pickle.loads(pickle.dumps(first))  # as a worker gets it
    _build.cache_clear()
    with pytest.raises(UserError, match="was changed since the case was read"):
        plant_of(copied)


def test_bytecode_beside_a_plant_is_neither_run_nor_written(trap: Path) -> None:
    """It may say something else than the file that a careful colleague reads."""
    path = trap.parent / "trap.py"
    evil = trap.parent / "evil.py"
    evil.write_text("raise RuntimeError('bytecode ran')\n")
    stamp = path.stat().st_mtime
    evil.write_bytes(evil.read_bytes().ljust(path.stat().st_size, b"\n"))
    os.utime(evil, (stamp, stamp))
    cached = Path(importlib.util.cache_from_source(str(path)))
    py_compile.compile(str(evil), cfile=str(cached), dfile=str(path), doraise=True)
    plant_of(problem_of(load_case(trap)))
    cached.unlink()
    plant_of(problem_of(load_case(trap)))
    assert not cached.exists()


def test_checking_a_case_executes_nothing(trap: Path) -> None:
    load_case(trap)
    assert not (trap.parent / "executed").exists()


def test_truth_json_names_installed_packages_only(two_mass_run: Path, tmp_path: Path) -> None:
    folder = Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    for name in ("trap", "os:system", "trap.py:f", "../trap", str(tmp_path / "trap.py"), ""):
        (folder / "truth.json").write_text(json.dumps({"truth": name, "formulation": "lifted"}))
        with pytest.raises(UserError, match="is known"):
            formulation_in(folder)


# ---- time ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "body",
    [
        "    while True: pass\n",
        "    while True:\n        try:\n            while True: pass\n"
        "        except Exception:\n            pass\n",
        "    import time\n    time.sleep(1e6)\n",
    ],
    ids=["busy", "stubborn", "asleep"],
)
def test_a_plant_that_hangs_is_ended_in_one_line(
    trap: Path, capsys: pytest.CaptureFixture[str], body: str
) -> None:
    (trap.parent / "trap.py").write_text("def f(theta, **options):\n" + body)
    trap.write_text(trap.read_text() + "\n[limits]\nplant_seconds = 0.2\n")
    assert solve([str(trap), "--quiet"]) == 2
    errors = capsys.readouterr().err
    assert len(errors.splitlines()) == 1
    assert errors.startswith(f"{trap}: plant: trap.py:f did not return within 0.2 s; ")
    assert not trap.with_suffix("").exists()


def test_an_async_function_is_no_plant(trap: Path) -> None:
    (trap.parent / "trap.py").write_text("async def f(theta): return {}\n")
    with pytest.raises(UserError, match="write a plain def"):
        problem_of(load_case(trap))


def test_an_import_that_hangs_is_ended_too(trap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (trap.parent / "trap.py").write_text("while True: pass\n")
    trap.write_text(trap.read_text() + "\n[limits]\nplant_seconds = 0.2\n")
    assert inner([str(trap), "--theta", "m1=60,m2=60"]) == 2
    assert "did not return within 0.2 s" in capsys.readouterr().err


def test_the_limit_ends_with_its_block() -> None:
    import signal

    before = signal.getsignal(signal.SIGALRM)
    with time_limit(60.0, PlantError("late")):
        pass
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) is before


@pytest.mark.parametrize(
    ("matrices", "words"),
    [
        ("mass=ca.SX.eye(10**6), stiffness=ca.SX.eye(10**6), input=ca.SX(10**6, 1), "
         "output=ca.SX(1, 10**6)", "mass has 1000000 rows or columns"),
        ("mass=ca.SX.eye(2), stiffness=ca.SX.eye(2), input=ca.SX(2, 10**6), output=ca.SX(1, 2)",
         "input has 1000000"),
        ("mass=ca.SX.eye(2), stiffness=ca.SX.eye(2), input=ca.SX(2, 1), output=ca.SX(10**6, 2)",
         "output has 1000000"),
    ],
)  # fmt: skip
def test_a_plant_too_large_for_memory_is_refused(trap: Path, matrices: str, words: str) -> None:
    source = "import casadi as ca\ndef f(t):\n    return dict(damping_ratio=0.1, hardware_cost=1, "
    (trap.parent / "trap.py").write_text(source + matrices + ")\n")
    with pytest.raises(UserError, match=words):
        problem_of(load_case(trap))


# ---- names that lead out of the folder -----------------------------------------------------------


def test_a_surrogate_file_of_another_kind_is_not_built(tmp_path: Path) -> None:
    for kind in ("os.system", "__class__", "Surrogate", ["gaussian_process"], None):
        path = tmp_path / "s.json"
        record = {"kind": kind, "args": ["touch executed"]}
        path.write_text(json.dumps({"schema": "surrogates/2", "surrogates": [record], "extra": {}}))
        with pytest.raises(SurrogateFileError):
            load(path)
