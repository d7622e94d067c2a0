"""The core works without its extensions: each is removed in a copy of the package."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from oracles.case_documents import QUICK_SECTIONS
from oracles.sources import ROOT

from ccd_casadi.support import extensions
from ccd_casadi.support.extensions import SHIPPED, Extension, read_shipped

CASE = ROOT / "runs" / "two_mass.toml"
NAMES = sorted(read_shipped())
SHOWN = ("formats", "rib_stage")  # in the suite; a process each
IMPORTS = """
import pkgutil, ccd_casadi
for found in pkgutil.walk_packages(ccd_casadi.__path__, "ccd_casadi."):
    if not found.name.startswith("ccd_casadi.extensions.") and "__main__" not in found.name:
        __import__(found.name)
"""


def run_without(place: Path, *removed: str, words: list[str]) -> "subprocess.CompletedProcess[str]":
    """A Python process on a copy of the package, of links: its compiled kernels are shared."""
    copy = place / "ccd_casadi"
    for folder, skipped in (("", {"extensions"}), ("extensions", set(removed))):
        (copy / folder).mkdir(parents=True, exist_ok=True)
        for item in (ROOT / "ccd_casadi" / folder).iterdir():
            if item.stem not in skipped and not (copy / folder / item.name).is_symlink():
                (copy / folder / item.name).symlink_to(item)
    if not (place / "surrogates").is_symlink():
        (place / "surrogates").symlink_to(ROOT / "surrogates")
    environment = os.environ | {"PYTHONPATH": str(place)}
    return subprocess.run(
        [sys.executable, *words], cwd=place, env=environment, capture_output=True, text=True
    )


def solve_words(place: Path, *more: str) -> list[str]:
    return ["-m", "ccd_casadi.solve", str(CASE), "--out", str(place / "run"), "--quiet", *more]


def test_every_extension_of_a_message_is_there() -> None:
    for kind, of in SHIPPED.items():
        every = read_shipped().items()
        there = {word: name for name, item in every for word in getattr(item, kind)}
        assert there == of


# Several commands in one process: each as `python -m` runs it, and what it ends with.
ONE_BY_ONE = """
import contextlib, io, json, runpy, sys
answers = []
for module, *words in json.loads(sys.argv[1]):
    sys.argv = [module, *words]
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            runpy.run_module(module, run_name="__main__")
        except SystemExit as end:
            answers.append((end.code, errors.getvalue()))
print(json.dumps(answers))
"""


@pytest.mark.parametrize(
    "name", [n if n in SHOWN else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
)
def test_what_a_removed_extension_has_is_answered_by_name(name: str, tmp_path: Path) -> None:
    needs = f"needs the extension {name}, which is not installed\n"
    own, required = read_shipped()[name], list[tuple[list[str], str]]()
    for word in own.commands:
        for words in ([f"ccd_casadi.{word}"], ["ccd_casadi", word]):
            required.append((words, f"`{word}` {needs}"))
    for model in own.plants:
        case = tmp_path / f"{model}.toml"
        case.write_text(CASE.read_text().replace('"two_mass"', f'"{model}"'))
        line = f"{case}: plant.model: '{model}' {needs}"
        required.append((["ccd_casadi", "check", str(case)], line))
    if name == "cluster":
        words = [*solve_words(tmp_path, "--scheduler", "tcp://a:1")[1:]]
        required.append((words, f"--scheduler {needs}"))
    if name == "formats":
        required.append((["ccd_casadi.deploy", str(tmp_path), "--fmu"], f"--fmu {needs}"))
    words = [words for words, _ in required] + [["ccd_casadi", "foo"]]
    done = run_without(tmp_path, name, words=["-c", ONE_BY_ONE, json.dumps(words)])
    assert (done.returncode, done.stderr) == (0, "")
    *answers, (code, unknown) = json.loads(done.stdout)
    assert answers == [[2, line] for _, line in required]
    assert code == 2
    assert all(f" {word}," not in unknown for word in own.commands)


def test_the_core_solves_without_any_extension(tmp_path: Path) -> None:
    case, quick = tmp_path / "case.toml", "[outer]\nstarts = 2\nbox_points = 0\n"
    case.write_text(f"{CASE.read_text()}\n[sampling]\nlifted_points = 16\n{quick}")
    words = [str(case), "--formulation", "lifted", "--no-report", "--quiet", "--workers", "1"]
    solve = f"from ccd_casadi.solve import main; raise SystemExit(main({words}))"
    done = run_without(tmp_path, *NAMES, words=["-c", f"{IMPORTS}\n{solve}"])
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_core_solves_without_each_extension(name: str, tmp_path: Path) -> None:
    done = run_without(tmp_path, name, words=["-c", IMPORTS])
    assert (done.returncode, done.stderr) == (0, "")
    done = run_without(tmp_path, name, words=solve_words(tmp_path))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
def test_sections_are_designed_and_deployed_without_any_extension(tmp_path: Path) -> None:
    case, folder = tmp_path / "case.toml", tmp_path / "case"
    case.write_text(QUICK_SECTIONS)
    for words in (["solve", str(case)], ["deploy", str(folder)]):
        done = run_without(
            tmp_path, *NAMES, words=["-m", "ccd_casadi", *words, "--quiet", "--workers", "1"]
        )
        assert (done.returncode, done.stderr) == (0, "")
    result = json.loads((folder / "result.json").read_text())
    assert result["gap"] is None
    assert "gap not known" in result["verdict"]["optimal"]["words"]
    assert not (folder / "deploy" / "controller.st").exists()


HELLO = """
from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(commands={"hello": ("ccd_casadi.extensions.hello", "greet a person")})


def main(words):
    print("hello", *words)
    return 0
"""


def test_a_new_extension_is_one_file(tmp_path: Path) -> None:
    file = tmp_path / "ccd_casadi" / "extensions" / "hello.py"
    file.parent.mkdir(parents=True)
    file.write_text(HELLO)
    done = run_without(tmp_path, words=["-m", "ccd_casadi", "hello", "you"])
    assert (done.returncode, done.stdout, done.stderr) == (0, "hello you\n", "")
    assert "greet a person" in run_without(tmp_path, words=["-m", "ccd_casadi"]).stdout


def test_another_distribution_adds_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Extension(commands={"press": ("my_package.press", "press it")})
    point = SimpleNamespace(name="presses", load=lambda: own)
    monkeypatch.setattr(extensions, "entry_points", lambda group: [point])
    extensions.read_installed.cache_clear()
    try:
        assert extensions.find("commands", "press") == own.commands["press"]
        assert set(extensions.collect_declared("commands")) == {*SHIPPED["commands"], "press"}
    finally:
        extensions.read_installed.cache_clear()
