"""The table of extensions: what is found by name, and imported when it is first used.

An extension is a module or package of `ccd_casadi.extensions`, or of another distribution behind an
entry point of that group. It declares an `Extension`, and imports nothing heavy to do so.
"""

import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any, cast

from ccd_casadi.support.options import ExitCode
from ccd_casadi.support.terminal import say

GROUP = "ccd_casadi.extensions"  # the package here, and entry points of other distributions
# What the extensions of this distribution have, for the message where one was removed.
SHIPPED: Mapping[str, Mapping[str, str]] = MappingProxyType({
    "commands": {
        "cross_check": "cross_check", "drive": "drives", "explore": "explorer",
        "feedforward": "feedforward", "gap": "limitations", "imported": "imported",
        "record": "records", "schedule": "schedule", "tolerances": "tolerances",
        "tune": "measured", "worth": "worth",
    },
    "plants": {
        "cad_stage": "cad", "modal_table": "imported", "rib_stage": "rib_stage",
        "sampled_matrices": "imported",
    },
    "functions": {
        "cluster": "cluster", "fmu": "formats", "known_gap": "limitations",
        "measured_answer": "measured", "measured_page": "measured",
        "none_reaches": "limitations", "plcopen_xml": "formats", "structured_text": "formats",
    },
})  # fmt: skip


@dataclass(frozen=True)
class Extension:
    """The additions of an extension, by names of what is imported: "module:name" where not stated.

    Attributes
    ----------
    commands : mapping
        Word -> the module of its `main`, and what it does.
    plants : mapping
        Name in a case file -> its `plants.registry.Model`.
    functions : mapping
        Name -> what the core calls where it is there.
    """

    commands: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    plants: Mapping[str, str] = field(default_factory=dict)
    functions: Mapping[str, str] = field(default_factory=dict)


@cache
def read_shipped() -> dict[str, Extension]:
    """Read the extensions of this distribution.

    Returns
    -------
    dict of str to Extension
        By the name of their module, sorted.
    """
    places = import_module(GROUP).__path__
    names = sorted(found.name for found in pkgutil.iter_modules(places))
    return {name: import_module(f"{GROUP}.{name}").EXTENSION for name in names}


@cache
def read_installed() -> dict[str, Extension]:
    """Read all extensions, those of other distributions last.

    Returns
    -------
    dict of str to Extension
    """
    return read_shipped() | {point.name: point.load() for point in entry_points(group=GROUP)}


def collect_declared(kind: str) -> dict[str, Any]:
    """Collect what all extensions declare of one kind.

    Parameters
    ----------
    kind : str
        A field of `Extension`.

    Returns
    -------
    dict
    """
    return {k: v for item in read_installed().values() for k, v in getattr(item, kind).items()}


def find(kind: str, name: str) -> Any:
    """Look for what an extension declares; other distributions are read where none here has it.

    Parameters
    ----------
    kind, name : str
        A field of `Extension`, and a key of that.

    Returns
    -------
    object or None
    """
    for extensions in (read_shipped, read_installed):
        for item in extensions().values():
            if name in getattr(item, kind):
                return getattr(item, kind)[name]
    return None


def load(place: str) -> Any:
    """Import what "module:name" names.

    Parameters
    ----------
    place : str

    Returns
    -------
    object
    """
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def function(name: str) -> Callable[..., Any] | None:
    """Import a function that the core calls where an extension has it.

    Parameters
    ----------
    name : str

    Returns
    -------
    callable or None
    """
    place = find("functions", name)
    return None if place is None else cast(Callable[..., Any], load(place))


def missing(subject: str, kind: str, name: str) -> str:
    """Say that something needs an extension that was removed.

    Parameters
    ----------
    subject : str
    kind, name : str
        What the extension has; as in `find`.

    Returns
    -------
    str
    """
    return f"{subject} needs the extension {SHIPPED[kind][name]}, which is not installed"


def command(word: str) -> Callable[..., int]:
    """Make the entry point of an extension's command, which is imported when it is called.

    Parameters
    ----------
    word : str

    Returns
    -------
    callable
        Takes a list of words; BAD_INPUT where the extension was removed.
    """

    def main(argv: Sequence[str] | None = None) -> int:
        found = find("commands", word)
        if found is None:
            say(missing(f"`{word}`", "commands", word), sys.stderr)
            return ExitCode.BAD_INPUT
        return int(import_module(found[0]).main(argv))

    return main
