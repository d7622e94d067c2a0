"""Ctrl-C while a command (`python -m ...`) imports what it needs: one line, exit 130, no traceback.

Nothing has begun by then, so the process just ends. `begun` gives Ctrl-C back to the command.
"""

import os
import signal
from types import FrameType


def _leave(number: int, frame: FrameType | None) -> None:
    # An exception would come out of whatever is being imported, which may swallow or reword it.
    os.write(2, b"interrupted before anything was begun\n")
    os._exit(130)


def starting() -> None:
    """Let Ctrl-C end the process at once, unless somebody handles or ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def begun() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)
