"""Ctrl-C while CasADi's solvers run: they swallow KeyboardInterrupt, so it is kept for later."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_pending = threading.Event()


def pending() -> bool:
    """Whether Ctrl-C was pressed since the current solve began: end what is under way soon."""
    return _pending.is_set()


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Hold Ctrl-C until the end of the block and raise KeyboardInterrupt there.

    Only the main thread receives signals; elsewhere the block runs as it is.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def keep(number: int, frame: FrameType | None) -> None:
        _pending.set()

    before = signal.signal(signal.SIGINT, keep)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        pressed = _pending.is_set()
        _pending.clear()
    if pressed:
        raise KeyboardInterrupt
