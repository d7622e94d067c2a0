"""A progress bar on stderr: done, rate, time left.

By hand: tqdm and rich rewrite one line on a terminal only to fill a log with it elsewhere; here a
log gets a plain line every few seconds, and a stream that fails ends the printing alone. In a
notebook it is on stdout, since stderr is painted there as a failure.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Self, TextIO, TypeVar

from ccd_casadi.support.notebook import in_notebook
from ccd_casadi.support.terminal import QUIET, columns

T = TypeVar("T")
WIDTH = 24
CELL = 100  # characters of a line in a notebook
Tell = Callable[[str], None]  # what is given lines of progress


class Progress:
    """`with Progress(total, label) as bar: bar.advance()`; nothing is printed if quiet or empty.

    `quiet`: by default as `kept_quiet` says.

    On a terminal, and in a notebook's cell, one line is rewritten a few times a second; elsewhere
    a plain line is printed every few seconds and at the end. Work that ends before its total ends
    the bar, and a single step leaves no line behind. A stream that fails ends the printing, not the
    work.
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
        filled = min(WIDTH, WIDTH * self.done // self.total)
        text = f"{self.label}  {self.done}/{self.total} [{'#' * filled}{'-' * (WIDTH - filled)}]"
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
    """Lines of progress that nobody reads."""


def titled(tell: Tell, title: str) -> Tell:
    """Lines of progress with what they are of."""
    return lambda words: tell(f"{title}: {words}")


def duration(seconds: float) -> str:
    """Seconds in words.

    >>> duration(3.2), duration(59.97), duration(250), duration(7300)
    ('3.2 s', '1 min 00 s', '4 min 10 s', '2 h 01 min')
    """
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
