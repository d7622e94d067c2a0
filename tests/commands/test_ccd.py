"""`ccd`: one name for every command, and a stage to begin with."""

import argparse
import json
import os
import re
import subprocess
import sys
import tomllib
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import pytest

from ccd_casadi import robust
from ccd_casadi.__main__ import ALIASES, OWN, commands, main, overview
from ccd_casadi.cases.case import CaseError, case_schema, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.support import extensions

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = commands()


def test_every_word_has_a_command_and_the_entry_point_is_there() -> None:
    for module, _ in COMMANDS.values():
        assert callable(import_module(module).main)
    every = [*(ROOT / "ccd_casadi").glob("*.py"), *(ROOT / "surrogates").glob("*.py")]
    words = {f"{p.parent.name}.{p.stem}" for p in every if "\n@command(" in p.read_text()}
    assert words == {module for module, _ in COMMANDS.values() if module.count(".") == 1}
    thin = {p.stem for p in every if "\nmain = command(" in p.read_text()}
    assert thin == set(extensions.SHIPPED["commands"]) == {
        word for word, (module, _) in COMMANDS.items() if module.count(".") > 1
    }
    assert set(ALIASES.values()) <= set(COMMANDS)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, name = project["scripts"]["ccd"].partition(":")
    assert getattr(import_module(module), name) is main


def options_read(module: ModuleType) -> set[str]:
    """The options that a command's module reads, and those that `run` and its helpers read."""
    text = Path(str(module.__file__)).read_text()
    shared = ROOT / "ccd_casadi" / "support" / "command_line.py"
    found = set(re.findall(r"\boptions\.(\w+)", text + shared.read_text()))
    if "move_of(options" in text:
        found |= {name for name, _, _ in robust._MOVE}
    if "break_frequencies(options)" in text:
        found |= {"omega_S_hz", "omega_T_hz"}
    return found


@pytest.mark.parametrize("word", COMMANDS)
def test_an_option_in_the_help_is_read(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module = import_module(COMMANDS[word][0])
    required: list[argparse.ArgumentParser] = []

    def note(command: object, arguments: Any, *_: object, **__: object) -> int:
        required.append(arguments)
        return 0

    monkeypatch.setattr("ccd_casadi.support.command_line.run", note)
    module.main([])
    shown = (action for action in required[0]._actions if action.help != argparse.SUPPRESS)
    reported = {action.dest for action in shown} - {
        "help",
        "workers",
        "no_user_code",
    }
    assert reported - options_read(module) == set()


def test_a_new_stage_is_a_case_that_can_be_solved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "my_stage"
    assert main(["new", str(folder)]) == 0
    assert "ccd check" in capsys.readouterr().out
    case = folder / "case.toml"
    problem = problem_of(load_case(case))
    assert scaled_plant(problem, (19.0, 8.0)).B.shape[1] == 1
    assert main(["check", str(case), "--quiet"]) == 0
    assert isinstance(problem.controller, StructuredProblem)
    schema = json.loads((folder / "case.schema.json").read_text())
    jsonschema.validate(tomllib.loads(case.read_text()), schema)

    assert str(case.relative_to(tmp_path)) in overview(tmp_path).replace(f"{tmp_path}/", "")
    assert main(["new", str(folder)]) == 2
    assert "would be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("word", [*COMMANDS, *OWN])
def test_every_word_has_help(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with suppress(SystemExit):  # as argparse ends
        assert main([word, "--help"]) == 0
    assert word in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [["sovle"], ["new"], ["new", "a", "b"], ["new", "-x"], ["keys", "x"]]
)
def test_a_wrong_word_is_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("word", ["imported", "import"])
@pytest.mark.parametrize("modes", ["0", "-3", "1.5"])
def test_the_modes_of_an_import_are_counted(
    word: str, modes: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word, "fe", f"--modes={modes}"]) == 2
    assert "argument --modes: " in capsys.readouterr().err


def test_check_writes_what_it_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = str(ROOT / "runs/two_mass.toml")
    assert main(["check", case, "--json", "--quiet", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "check.json").read_text()) == json.loads(capsys.readouterr().out)


def test_alone_it_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(word in said for word in (*COMMANDS, *OWN))
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("ccd-casadi ")


@cache
def checked() -> Any:
    """The schema of cases, itself checked once: that costs more than to check a case."""
    kind = jsonschema.validators.validator_for(case_schema())
    kind.check_schema(case_schema())
    return kind(case_schema())


CASES = [*sorted((ROOT / "runs").glob("*.toml")), *sorted((ROOT / "examples").glob("*/*.toml"))]


@pytest.mark.parametrize("path", CASES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_every_case_of_the_project_is_one_by_its_schema(path: Path) -> None:
    checked().validate(tomllib.loads(path.read_text()))


@pytest.mark.parametrize(
    "change",
    [
        {"inner": {"S_maxx": 2.0}},
        {"inner": {"S_max": "2"}},
        {"objective": {"w1": -1.0}},
        {"controller": {"structure": "pid"}},
        {"theta": {"m1": {"lower": 1.0}}},
        {"budget": {"force": {"level": 1.0, "unit": "lbf"}}},
        {"typo": {}},
    ],
    ids=str,
)
def test_what_the_schema_refuses_the_checks_refuse(change: dict[str, dict[str, object]]) -> None:
    data = tomllib.loads((ROOT / "runs/two_mass.toml").read_text())
    changed = data | {name: data.get(name, {}) | table for name, table in change.items()}
    with pytest.raises(jsonschema.ValidationError):
        checked().validate(changed)
    with pytest.raises(CaseError):
        parse_case(changed, ROOT / "runs/two_mass.toml")


def test_a_measured_plant_needs_no_theta() -> None:
    data = tomllib.loads((ROOT / "runs/two_mass.toml").read_text())
    measured = {"plant": {"model": "measured", "file": "stage.csv"}, "inner": data["inner"]}
    checked().validate(measured)
    with pytest.raises(jsonschema.ValidationError):
        checked().validate(measured | {"plant": {"model": "two_mass"}})


def test_the_page_of_all_keys_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys"]) == 0
    page = capsys.readouterr().out
    assert page == (ROOT / "docs/case_file.md").read_text(), "ccd keys > docs/case_file.md"
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(case_schema()))


@pytest.mark.slow
def test_the_readme_leads_from_nothing_to_tested_c_code(tmp_path: Path) -> None:
    """Its commands as printed, in an empty folder, without the packages that are optional."""
    for package in ("cvxpy", "bokeh", "dask"):
        (tmp_path / f"{package}.py").write_text(f"raise ImportError('no {package}')\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    block = (ROOT / "README.md").read_text().partition("## Your own stage\n\n")[2]
    commands = re.findall(r"^    ccd ([^#\n]+)", block, re.MULTILINE)
    assert [words.split()[0] for words in commands] == ["new", "check", "solve", "deploy"]
    for words in commands:
        subprocess.run(
            [sys.executable, "-m", "ccd_casadi", *words.split()], cwd=tmp_path, check=True,
            env=os.environ | {"PYTHONPATH": path},
        )  # fmt: skip
    run = tmp_path / "my_stage" / "case"
    verdict = json.loads((run / "result.json").read_text())["verdict"]
    assert {line["state"] for line in verdict.values()} == {"passed"}
    subprocess.run(["cc", "-std=c99", "-ffp-contract=off", "-o", "t", "controller.c",
                    "controller_test.c", "-lm"], cwd=run / "deploy", check=True)  # fmt: skip
    subprocess.run(["./t"], cwd=run / "deploy", check=True, capture_output=True)
