"""The sources of both packages, each parsed once a process."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(p for name in ("ccd_casadi", "surrogates") for p in (ROOT / name).rglob("*.py"))

TITLED = re.compile(r'^```\w+ title="([^"]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)
CONTINUES = re.compile(r"# (\S+), and\n")  # the first line of a file that another one begins


def files_of(page: Path) -> dict[str, str]:
    """The files that a page has its reader write, by their titles."""
    found = dict(TITLED.findall(page.read_text(encoding="utf-8")))
    for title, text in found.items():
        if (first := CONTINUES.match(text)) is not None:
            found[title] = found[first[1]] + "\n" + text[first.end() :]
    return found


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Every node of a module's syntax tree, the module itself first."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
