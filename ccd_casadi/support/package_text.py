"""Texts that ship beside the sources: pages' styles and scripts, templates of pages and code."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccd_casadi.support.units import spoken

if TYPE_CHECKING:  # no command needs it to start
    from jinja2 import Environment, Template

PLAIN = (".c", ".h", ".md", ".st", ".txt")  # what no mark-up is in


def package_path(name: str) -> Path:
    """Of a file of the package, by its path in there."""
    return Path(__file__).parents[1] / name


@cache
def package_text(name: str) -> str:
    """Its text."""
    return package_path(name).read_text(encoding="utf-8")


def template(name: str, **known: Any) -> "Template":
    """A template of Jinja by its path; `known`: functions that it calls."""
    return _templates().get_template(name, globals=known)


def printable(value: Any) -> Any:
    """A text whose control characters show as a replacement sign; another value as it is."""
    if not isinstance(value, str) or hasattr(value, "__html__"):  # mark-up of our own
        return value
    return "".join(c if c.isprintable() or c in "\n\t\xa0" else "\ufffd" for c in value)


@cache
def _templates() -> "Environment":
    """Texts are escaped where there is mark-up, and a name that nobody gives is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(package_path("")), undefined=StrictUndefined, finalize=printable,
        autoescape=lambda name: not str(name).endswith(PLAIN), trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    made.globals["spoken"] = spoken
    return made
