"""What may go wrong around a command: a full disk, a clock running back, locks, other people's."""

import os
import resource
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from ccd_casadi.sampling.store import SampleStore

NOBODY = 65534


@contextmanager
def _full(folder: Path, amount: float) -> Iterator[None]:
    """No file may grow beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(amount), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def _clock(folder: Path, amount: float) -> Iterator[None]:
    """Every look at the clock shows an earlier time."""
    now, global_checks = time.time(), iter(range(10**9))
    with patch.object(time, "time", lambda: now - amount * next(global_checks)):
        yield


@contextmanager
def _locked(folder: Path, amount: float) -> Iterator[None]:
    """Somebody else holds the store."""
    other = sqlite3.connect(folder / "samples.sqlite", isolation_level=None)
    try:
        other.execute("pragma locking_mode = exclusive")
        other.execute("begin exclusive")
        with patch.object(SampleStore.__init__, "__defaults__", (0.2,)):  # s that it waits
            yield
    finally:
        other.close()


@contextmanager
def _readonly(folder: Path, amount: float) -> Iterator[None]:
    """The folder is somebody else's; without the right to change user, it is left as it is."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


FAULTS = {"full": _full, "clock": _clock, "locked": _locked, "readonly": _readonly}
