"""What an installation needs and says of itself: declared packages, versions, what ships."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from doctest import DocTestFinder
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from oracles.sources import ROOT, SOURCES, nodes

import ccd_casadi
from ccd_casadi.support import options

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# what is imported has another name than what is declared, and need not be installed here
NAMES = {"ansys": "ansys-mapdl-reader", "skfem": "scikit-fem", "sklearn": "scikit-learn"}


def normal(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0].replace("_", "-").lower()


CORE = {normal(words) for words in PROJECT["dependencies"]}
EXTRAS = {name: {*map(normal, all_)} for name, all_ in PROJECT["optional-dependencies"].items()}


def imported(path: Path) -> Iterator[str]:
    """Top-level names of what a module imports, anywhere in it."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def required(path: Path) -> Iterator[tuple[str, str]]:
    """Package and extra of every `require("package", "extra")`."""
    for node in nodes(path):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "require":
            words = [item.value for item in node.args if isinstance(item, ast.Constant)]
            if len(words) == 2:
                yield str(words[0]).partition(".")[0], str(words[1])


installed = cache(packages_distributions)  # reads every distribution


def distribution(module: str) -> str:
    return normal(NAMES.get(module) or installed().get(module, [module])[0])


def test_every_package_that_is_imported_is_declared() -> None:
    known = {*sys.stdlib_module_names, "ccd_casadi", "surrogates"}
    found = {name for path in SOURCES for name in imported(path)} - known
    assert found >= {"numpy", "casadi", "bokeh"}
    assert {distribution(name) for name in found} - CORE - set().union(*EXTRAS.values()) == set()


def test_what_examples_and_studies_import_is_there() -> None:
    """They are run by hand: a name that has moved would be found missing late."""
    missing = []
    for path in (*(ROOT / "examples").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")):
        for node in nodes(path):
            place = (getattr(node, "module", None) or "").split(".")[0]
            if isinstance(node, ast.ImportFrom) and place in ("ccd_casadi", "surrogates"):
                try:
                    exec(ast.unparse(node), {})
                except ImportError as error:
                    missing.append(f"{path.name}: {error}")
    assert missing == []


def test_an_extra_that_an_error_names_has_the_package() -> None:
    pairs = {pair for path in SOURCES for pair in required(path)}
    assert ("bokeh", "explore") in pairs
    assert [(name, extra) for name, extra in pairs if distribution(name) not in EXTRAS[extra]] == []


def test_every_file_beside_the_sources_ships() -> None:
    found = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    for package, patterns in found["package-data"].items():
        place = ROOT / package
        shipped = {path for pattern in patterns for path in place.glob(pattern)}
        there = {
            path for path in place.rglob("*")
            if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
        }  # fmt: skip
        assert there <= shipped, there - shipped


def test_a_version_that_is_not_published_has_no_date() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    version = PROJECT["version"]
    assert re.search(rf"^version: {re.escape(version)}$", citation, re.MULTILINE)
    changes = (ROOT / "CHANGELOG.md").read_text().splitlines()
    head = next(line for line in changes if line.startswith(f"## {version}"))
    assert ("not yet published" in head) == ("date-released" not in citation)


def test_the_case_that_ships_is_case_study_1() -> None:
    assert ccd_casadi.TWO_MASS.read_bytes() == (ROOT / "runs" / "two_mass.toml").read_bytes()


@pytest.mark.parametrize("name", ccd_casadi.__all__)
def test_examples_of_the_public_face_need_no_clone(name: str) -> None:
    value = getattr(ccd_casadi, name)
    sources = "".join(
        item.source for test in DocTestFinder().find(value, name) for item in test.examples
    )
    files = re.findall(r"""["'][^"']*\.(?:toml|csv|json|py)["']""", sources)
    assert files == []


def test_cores_are_counted_on_systems_without_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(options.os, "sched_getaffinity", raising=False)
    assert options.usable_cores() >= 1
    asking = [path.name for path in SOURCES if "sched_getaffinity" in path.read_text()]
    assert asking == ["options.py"]
