"""What jobs on one run folder tell each other: who decides now, and which points are evaluated.

A job decides what to evaluate under one lock, and writes its points to a file that it keeps locked
while it evaluates them. Locks end with the process that holds them, however it ends: the points of
a killed job are free again.
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from surrogates.interface import Array

FOLDER = "claims"  # the name in run folders, which jobs of other versions look for as well


class PendingPoints:
    """The points with d inputs that the jobs of a run folder are evaluating now."""

    def __init__(self, run: Path, d: int) -> None:
        self.folder, self.d = run / FOLDER, d
        self.folder.mkdir(exist_ok=True)

    @contextmanager
    def deciding(self) -> Iterator[None]:
        """Hold the one lock of the run folder; waits for it."""
        with (self.folder / "lock").open("a") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)  # ends with the file, or the process
            yield

    def others(self) -> Array:
        """Points (m, d) that other living jobs have in flight; call it while deciding."""
        found: list[list[float]] = []
        for path in sorted(self.folder.glob("*.json")):
            with path.open() as stream:
                if _locked(stream):
                    found += json.load(stream)
                else:
                    path.unlink(missing_ok=True)  # its job was killed
        return np.array(found, dtype=float).reshape(-1, self.d)

    def reserve(self, X: Array) -> "Reservation":
        """Reserve X (m, d) from now until it is closed; call it while deciding."""
        return Reservation(self.folder / f"{os.getpid()}.json", X)


class Reservation:
    """A file of points that is locked while this object is open: `with reservation: ...`."""

    def __init__(self, path: Path, X: Array) -> None:
        self.path = path
        self.stream = path.open("w")
        fcntl.flock(self.stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        json.dump(X.tolist(), self.stream)
        self.stream.flush()

    def __enter__(self) -> "Reservation":
        return self

    def __exit__(self, *_: object) -> None:
        self.path.unlink(missing_ok=True)
        self.stream.close()


def _locked(stream: TextIO) -> bool:
    try:
        fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False
