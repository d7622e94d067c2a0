"""Lines for people: wrapped text, a progress bar, and what shows itself in a notebook."""

import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import ClassVar, Self, TextIO, TypeVar


class NotebookHtml:
    """Base of what a notebook shows as HTML.

    How it is drawn is known in packages far above this one, which set `drawn`.

    Attributes
    ----------
    drawn : callable
        Object -> HTML.
    """

    drawn: ClassVar[Callable[[object], str] | None] = None

    def _repr_html_(self) -> str | None:
        return None if NotebookHtml.drawn is None else NotebookHtml.drawn(self)


def in_notebook(stream: object) -> bool:
    """Whether a stream is a notebook's cell: no terminal, but a line in it can be rewritten."""
    return "ipykernel" in sys.modules and type(stream).__module__.startswith("ipykernel.")


WIDTH = 100  # characters of a line at most, and where no terminal is
LABEL = re.compile(r"\s*(\S+( \S+)*?\s{2,})?((passed|warned|failed|unknown)\s{2,})?")

PLAIN = (("‖S‖∞", "the peak of S"), ("±", "+-"), ("×", "x"), ("÷", "/"), ("°", " deg"), ("µ", "u"),
         ("ω_b", "omega_b"))  # fmt: skip
COLOURS = {"passed": 32, "verified": 32, "warned": 33, "failed": 31, "not_verified": 31}
QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
STATE = re.compile(rf"^(\w+\s{{2,}})({'|'.join(COLOURS)})\b")


def columns(stream: TextIO) -> int:
    """Measure the terminal behind a stream.

    Parameters
    ----------
    stream : TextIO

    Returns
    -------
    int
        Characters of a line, at most `WIDTH`.
    """
    try:
        found = os.get_terminal_size(stream.fileno()).columns if stream.isatty() else WIDTH
    except (OSError, ValueError):
        return WIDTH
    return min(found or WIDTH, WIDTH)


def wrap(line: str, width: int) -> str:
    """Break a line between words; what follows is under its words, not under its label.

    Parameters
    ----------
    line : str
    width : int
        Characters.

    Returns
    -------
    str

    Examples
    --------
    >>> print(wrap("survives      warned   stable for resonances -0.76 to +7.9 %", 48))
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


def colour_line(line: str) -> str:
    """The word of a verdict or status behind its label in green, yellow or red."""
    if "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb":
        return line
    return STATE.sub(lambda m: f"{m[1]}\x1b[{COLOURS[m[2]]}m{m[2]}\x1b[0m", line)


def plain(text: str) -> str:
    """Replace signs that not every terminal has.

    Parameters
    ----------
    text : str

    Returns
    -------
    str

    Examples
    --------
    >>> plain("±1 µm, damping × 0.5, 40°")
    '+-1 um, damping x 0.5, 40 deg'
    """
    for sign, words in PLAIN:
        text = text.replace(sign, words)
    return text


def say(text: str, stream: TextIO | None = None) -> None:
    """Print lines, with "us" and "um" for "µs" and "µm"; a terminal gets them wrapped and coloured.

    Parameters
    ----------
    text : str
    stream : TextIO, optional
        By default stdout.
    """
    stream, text = stream or sys.stdout, text.replace("µ", "u")
    if stream.isatty():
        text = "\n".join(colour_line(wrap(line, columns(stream))) for line in text.split("\n"))
        if stream is sys.stderr:  # where a bar may stand
            text = f"\r\x1b[2K{text}"
    print(text, file=stream, flush=True)


def inform(text: str, stream: TextIO | None = None) -> None:
    """Print lines as `say` does, unless `kept_quiet` (--quiet) is active.

    Parameters
    ----------
    text : str
    stream : TextIO, optional
    """
    if not QUIET.get():
        say(text, stream)


def remark(text: str, quiet: bool) -> None:
    """Print a line of progress on stderr; a stream that fails ends the printing alone.

    Parameters
    ----------
    text : str
    quiet : bool
        Print nothing.
    """
    with suppress(OSError, ValueError):
        if not quiet:
            say(text, sys.stderr)


@contextmanager
def keep_quiet(yes: bool) -> Iterator[None]:
    """Silence `inform` and progress bars within the block.

    Parameters
    ----------
    yes : bool
        False: they print, also within a block that is quiet.
    """
    token = QUIET.set(yes)
    try:
        yield
    finally:
        QUIET.reset(token)


T = TypeVar("T")
BAR_WIDTH = 24
CELL = 100  # characters of a line in a notebook
Log = Callable[[str], None]  # what is given lines of progress


class Progress:
    """A progress bar: `with Progress(total, label) as bar: bar.advance()`.

    On a terminal, and in a notebook's cell, one line is rewritten a few times a second; elsewhere
    a plain line is printed every few seconds and at the end. Work that ends before its total ends
    the bar, and a single step leaves no line behind. A stream that fails ends the printing, not the
    work.

    Parameters
    ----------
    total : int
        Number of steps; of 0 nothing is printed.
    label : str
    quiet : bool, optional
        Print nothing; by default as `kept_quiet` has it.
    stream : TextIO, optional
    """

    def __init__(
        self, total: int, label: str, quiet: bool | None = None, stream: TextIO | None = None
    ) -> None:
        self.total, self.label, self.note = total, label, ""
        cell = in_notebook(sys.stdout)
        self.stream = stream or (sys.stdout if cell else sys.stderr)
        self.silent = (QUIET.get() if quiet is None else quiet) or total <= 0
        self.cell = in_notebook(self.stream)
        self.terminal = not self.silent and (self.cell or self.stream.isatty())
        self.interval = (0.25 if self.cell else 0.1) if self.terminal else 5.0
        self.done = 0
        self._began = self._shown = time.monotonic()

    def __enter__(self) -> Self:
        if self.terminal:  # so that a first step that takes long is seen to be under way
            self._show(end="")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None and self.done:
            single, self.total = self.total == 1, self.done
            if single and not self.cell:
                self._write("\r\x1b[2K" if self.terminal else "")
                return
        self._show(end="\n")

    def over(self, items: Iterable[T]) -> Iterator[T]:
        """The items, each counted once what is done with it is done."""
        with self:
            for item in items:
                yield item
                self.advance()

    def advance(self, count: int = 1, note: str = "") -> None:
        """Count `count` more as done; `note` is shown behind the bar until the next one."""
        self.done += count
        self.note = note
        if time.monotonic() - self._shown >= self.interval:
            self._show(end="" if self.terminal else "\n")

    def line(self) -> str:
        """The line as it stands, for instance `sampling  37/81 [####----] 12.3/s, 4.0 s left`."""
        elapsed = time.monotonic() - self._began
        filled = min(BAR_WIDTH, BAR_WIDTH * self.done // self.total)
        text = (
            f"{self.label}  {self.done}/{self.total} [{'#' * filled}{'-' * (BAR_WIDTH - filled)}]"
        )
        if self.done >= self.total:
            text = f"{text} {duration(elapsed)}"
        elif self.done and elapsed > 0.0:
            left = (self.total - self.done) * elapsed / self.done
            text = f"{text} {self.done / elapsed:.3g}/s, {duration(left)} left"
        return f"{text}  {self.note}".rstrip()

    def _show(self, end: str) -> None:
        if self.silent:
            return
        self._shown = time.monotonic()
        text = self.line()
        if self.terminal:
            # a line that wraps could not be rewritten in place; a cell knows "\r" and no more
            wide = CELL if self.cell else columns(self.stream) - 1
            text = f"\r{text[:wide]:{wide}s}" if self.cell else "\r\x1b[2K" + text[:wide]
        self._write(text + end)

    def _write(self, text: str) -> None:
        if self.silent:
            return
        try:
            self.stream.write(text)
            self.stream.flush()
        except (OSError, ValueError):
            self.silent = True  # closed, or a broken pipe


def silent(words: str) -> None:
    """Discard lines of progress.

    Parameters
    ----------
    words : str
    """


def with_title(log: Log, title: str) -> Log:
    """Put a title before each line of progress.

    Parameters
    ----------
    log : callable
        Takes a line.
    title : str

    Returns
    -------
    callable
        Takes a line.
    """
    return lambda words: log(f"{title}: {words}")


def duration(seconds: float) -> str:
    """Write a duration in words.

    Parameters
    ----------
    seconds : float

    Returns
    -------
    str

    Examples
    --------
    >>> duration(3.2), duration(59.97), duration(250), duration(7300)
    ('3.2 s', '1 min 00 s', '4 min 10 s', '2 h 01 min')
    """
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
