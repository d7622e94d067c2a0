"""`ccd`: one name for every command, and a stage to begin with."""

import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from ccd_casadi.__main__ import COMMANDS, main, overview
from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.inner_problem.problem import scaled_plant

ROOT = Path(__file__).resolve().parent.parent


def test_every_word_has_a_command_and_the_entry_point_is_there() -> None:
    for module, _ in COMMANDS.values():
        assert callable(import_module(module).main)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, name = project["scripts"]["ccd"].partition(":")
    assert getattr(import_module(module), name) is main


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
    # what is commented out is right too
    lines = case.read_text().splitlines()
    begin = next(i for i, line in enumerate(lines) if line == "# [controller]")
    built = lines[:begin] + [line.removeprefix("# ") for line in lines[begin:]]
    (folder / "built.toml").write_text("\n".join(built))
    assert problem_of(load_case(folder / "built.toml")).sections is not None

    assert str(case.relative_to(tmp_path)) in overview(tmp_path).replace(f"{tmp_path}/", "")
    assert main(["new", str(folder)]) == 2
    assert "would be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["sovle"], ["new"], ["new", "a", "b"], ["new", "--help"]])
def test_a_wrong_word_is_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_alone_it_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    said = capsys.readouterr().out
    assert all(word in said for word in (*COMMANDS, "new"))
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("ccd-casadi ")
