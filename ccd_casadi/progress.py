"""A progress bar on stderr: done, rate, time left."""

import sys
import time
from types import TracebackType
from typing import Self, TextIO


class Progress:
    """`with Progress(total, label) as bar: bar.advance()`; nothing is printed if quiet or empty.

    On a terminal one line is rewritten at most ten times a second; elsewhere a plain line is
    printed every few seconds and at the end.
    """

    def __init__(
        self, total: int, label: str, *, quiet: bool = False, stream: TextIO | None = None
    ) -> None:
        self.total, self.label = total, label
        self.stream = sys.stderr if stream is None else stream
        self.silent = quiet or total == 0
        self.terminal = self.stream.isatty()
        self.interval = 0.1 if self.terminal else 5.0
        self.done = 0
        self._began = self._shown = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self.silent:
            self._show(end="\n")

    def advance(self, count: int = 1) -> None:
        """Count `count` more as done."""
        self.done += count
        if not self.silent and time.monotonic() - self._shown >= self.interval:
            self._show(end="" if self.terminal else "\n")

    def line(self) -> str:
        """The line as it stands, for instance `sampling  37/81 [####----] 12.3/s, 4 s left`."""
        elapsed = time.monotonic() - self._began
        rate = self.done / elapsed if elapsed > 0.0 else 0.0
        filled = int(24 * self.done / self.total)
        text = f"{self.label}  {self.done}/{self.total} [{'#' * filled}{'-' * (24 - filled)}]"
        if self.done >= self.total:
            return f"{text} {duration(elapsed)}"
        if not self.done:
            return text
        return f"{text} {rate:.3g}/s, {duration((self.total - self.done) / rate)} left"

    def _show(self, end: str) -> None:
        self._shown = time.monotonic()
        start = "\r\x1b[2K" if self.terminal else ""
        self.stream.write(start + self.line() + end)
        self.stream.flush()


def duration(seconds: float) -> str:
    """Seconds in words.

    >>> duration(3.2), duration(250), duration(7300)
    ('3.2 s', '4 min 10 s', '2 h 01 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
