"""Lines for people: a terminal gets them wrapped to its width, under their label."""

import os
import re
import sys
import textwrap
from typing import TextIO

WIDTH = 100  # characters of a line at most, and where no terminal is
LABEL = re.compile(r"\s*(\S+( \S+)*?\s{2,})?((passed|warned|failed|unknown)\s{2,})?")


def columns(stream: TextIO) -> int:
    """Of the terminal behind a stream, at most WIDTH."""
    try:
        found = os.get_terminal_size(stream.fileno()).columns if stream.isatty() else WIDTH
    except (OSError, ValueError):
        return WIDTH
    return min(found or WIDTH, WIDTH)


def wrapped(line: str, width: int) -> str:
    """A line broken between words; what follows is under its words, not under its label.

    >>> print(wrapped("survives      warned   stable for resonances -0.76 to +7.9 %", 48))
    survives      warned   stable for resonances
                           -0.76 to +7.9 %
    """
    label = LABEL.match(line)
    indent = 0 if label is None else label.end()
    if len(line) <= width:
        return line
    return textwrap.fill(
        line, width, subsequent_indent=" " * (indent if 2 * indent < width else 2),
        break_long_words=False, break_on_hyphens=False, replace_whitespace=False,
    )  # fmt: skip


def say(text: str, stream: TextIO | None = None) -> None:
    """Print lines; a stream that is no terminal gets them as they are."""
    stream = stream or sys.stdout
    if stream.isatty():
        text = "\n".join(wrapped(line, columns(stream)) for line in text.split("\n"))
    print(text, file=stream, flush=True)
