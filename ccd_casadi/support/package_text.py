"""Texts that ship beside the sources: pages' styles and scripts, generated code."""

from functools import cache
from pathlib import Path
from string import Template


def package_path(name: str) -> Path:
    """Of a file of the package, by its path in there."""
    return Path(__file__).parents[1] / name


@cache
def package_text(name: str) -> str:
    """Its text."""
    return package_path(name).read_text(encoding="utf-8")


def filled(name: str, **values: object) -> str:
    """The same with a value in place of every `$name`."""
    return Template(package_text(name)).substitute(values)
