"""Lines for people: a terminal gets them wrapped to its width, under their label."""

import os
import re
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import TextIO

WIDTH = 100  # characters of a line at most, and where no terminal is
LABEL = re.compile(r"\s*(\S+( \S+)*?\s{2,})?((passed|warned|failed|unknown)\s{2,})?")

PLAIN = (("‖S‖∞", "the peak of S"), ("±", "+-"), ("×", "x"), ("÷", "/"), ("°", " deg"), ("µ", "u"),
         ("ω_b", "omega_b"))  # fmt: skip
COLOURS = {"passed": 32, "verified": 32, "warned": 33, "failed": 31, "not_verified": 31}
QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
STATE = re.compile(rf"^(\w+\s{{2,}})({'|'.join(COLOURS)})\b")


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


def coloured(line: str) -> str:
    """The word of a verdict or status behind its label in green, yellow or red."""
    if "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb":
        return line
    return STATE.sub(lambda m: f"{m[1]}\x1b[{COLOURS[m[2]]}m{m[2]}\x1b[0m", line)


def plain(text: str) -> str:
    """Words of a page in the signs that every terminal has.

    >>> plain("±1 µm, damping × 0.5, 40°")
    '+-1 um, damping x 0.5, 40 deg'
    """
    for sign, words in PLAIN:
        text = text.replace(sign, words)
    return text


def say(text: str, stream: TextIO | None = None) -> None:
    """Print lines, "us" and "um" in all of them; a stream that is no terminal gets them whole."""
    stream, text = stream or sys.stdout, text.replace("µ", "u")
    if stream.isatty():
        text = "\n".join(coloured(wrapped(line, columns(stream))) for line in text.split("\n"))
        if stream is sys.stderr:  # where a bar may stand
            text = f"\r\x1b[2K{text}"
    print(text, file=stream, flush=True)


def inform(text: str, stream: TextIO | None = None) -> None:
    """As `say`, unless `kept_quiet` (--quiet) forbids what is no answer and no mistake."""
    if not QUIET.get():
        say(text, stream)


def remark(text: str, quiet: bool) -> None:
    """A line of progress on stderr, unless quiet; a stream that fails ends the printing alone."""
    with suppress(OSError, ValueError):
        if not quiet:
            say(text, sys.stderr)


@contextmanager
def kept_quiet(yes: bool) -> Iterator[None]:
    """Within the block `inform` and progress bars print nothing, or (`yes` False) do."""
    token = QUIET.set(yes)
    try:
        yield
    finally:
        QUIET.reset(token)
