"""For mkdocstrings: examples with >>> in docstrings as code, and an entry for each parameter."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"^>>> .*?(?=\n\s*\n|\Z)", re.DOTALL | re.MULTILINE)

# `a, b : float` and its description: apart, each has its own default
GROUP = re.compile(r"^(\w+(?:, \w+)+)( : [^\n]*)?\n((?:    [^\n]*\n?)+)", re.MULTILINE)


def apart(found: re.Match[str]) -> str:
    """The same for each name of a group."""
    names, kind, words = found[1].split(", "), found[2] or "", found[3].rstrip()
    return "".join(f"{name}{kind}\n{words}\n" for name in names)


class DoctestBlocks(griffe.Extension):
    """Fences the examples of every docstring that is drawn."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = EXAMPLE.sub(
                lambda found: f"```pycon\n{found[0].rstrip()}\n```",
                GROUP.sub(apart, obj.docstring.value),
            )
