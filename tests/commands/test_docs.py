"""The documentation: its size, links to it, every public name, messages as in the code."""

import ast
import json
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from itertools import chain
from pathlib import Path

import pytest
from oracles.sources import ROOT, SOURCES, nodes

from ccd_casadi.__main__ import commands
from ccd_casadi.reporting.run_verdict import FILES
from ccd_casadi.support.text import package_text

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
DEVELOPERS = [page for page in PAGES if "development" in page.parts]
USERS = [page for page in PAGES if page not in DEVELOPERS]
MENTIONS = ("README.md", "CONTRIBUTING.md", "pyproject.toml", "Makefile", "ccd_casadi/**/*.py",
            "surrogates/**/*.py", "benchmarks/*.py", "examples/**/*.md", "runs/*.toml",
            "tests/*.py")  # fmt: skip
CELL = re.compile(r"^\| `(.+?)` \|", re.MULTILINE)


def words(pages: Iterable[Path]) -> int:
    return sum(len(page.read_text().split()) for page in pages)


def test_the_pages_for_users_are_few_and_short() -> None:
    assert len(USERS) <= 27
    assert words([*USERS, ROOT / "README.md"]) <= 25_000


def test_the_pages_for_developers_are_short() -> None:
    assert words(DEVELOPERS) <= 10_000


@pytest.mark.parametrize("package", ["ccd_casadi", "surrogates"])
def test_every_public_name_is_on_the_reference_page(package: str) -> None:
    stub = ast.parse((ROOT / package / "__init__.pyi").read_text())
    page = (DOCS / "reference.md").read_text().splitlines()
    for node in ast.walk(stub):
        if isinstance(node, ast.ImportFrom):
            for name in node.names:
                assert f"::: {node.module}.{name.name}" in page


def test_a_page_has_one_name_in_the_navigation_and_on_itself() -> None:
    nav = re.findall(r"^ +- (.+): (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    for name, page in nav[1:]:  # but Home
        title = re.search(r"^# (.+)$", (DOCS / page).read_text(), re.MULTILINE)
        assert title is not None
        assert title[1].strip() == name.strip('"')


def test_the_page_of_development_names_every_page_of_it() -> None:
    """One entry of the navigation leads to all of them, by their titles."""
    place = DOCS / "development"
    index = (place / "index.md").read_text()
    links = dict(re.findall(r"^- \[(.+)\]\((\S+)\)$", index, re.MULTILINE))
    pages = {page.relative_to(place).as_posix() for page in place.rglob("*.md")} - {"index.md"}
    assert set(links.values()) == pages
    for name, page in links.items():
        assert (place / page).read_text().startswith(f"# {name}\n")


def test_every_page_that_is_named_elsewhere_is_there() -> None:
    for pattern in MENTIONS:
        for file in ROOT.glob(pattern):
            for named in re.findall(r"\bdocs/[\w/]+\.(?:md|png)", file.read_text()):
                assert (ROOT / named).exists(), f"{file}: {named}"


@cache
def strings() -> str:
    """Every string of the packages, … for what is put in."""

    def each() -> Iterator[str]:
        for node in chain.from_iterable(map(nodes, SOURCES)):
            if isinstance(node, ast.JoinedStr):
                parts = (getattr(part, "value", None) for part in node.values)
                yield "".join(part if isinstance(part, str) else "…" for part in parts)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value

    return "\n".join(each())


@pytest.mark.parametrize("message", CELL.findall((DOCS / "troubleshooting.md").read_text()))
def test_every_message_is_one_of_the_code(message: str) -> None:
    for part in filter(None, map(str.strip, message.split("…"))):
        assert part in strings()


def test_the_page_of_commands_has_every_option_file_and_key() -> None:
    spec = spec_from_file_location("generated", DOCS / "generated.py")
    assert spec is not None
    assert spec.loader is not None
    generated = module_from_spec(spec)
    spec.loader.exec_module(generated)
    page = generated.on_page_markdown((DOCS / "commands.md").read_text())
    assert "<!--" not in page
    for word in commands():
        own = page.partition(f"### ccd {word}\n")[2].partition("\n###")[0]
        assert f"usage: ccd {word} [-h]" in own
        assert "Exit codes: 0 done" in own
    assert "--scheduler ADDRESS" in page.partition("### ccd solve\n")[2].partition("\n###")[0]
    schema = json.loads(package_text("templates/result.schema.json"))
    assert all(f"| `{key}` |" in page for key in (*schema["properties"], *FILES))
