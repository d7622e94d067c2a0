"""The surrogates that a run folder keeps, RUN_DIR/surrogates/0001.json ...

A version is written once and never changed; RUN_DIR/surrogate.json is the newest.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from surrogates.files import write_whole
from surrogates.gaussian_process import GaussianProcess
from surrogates.serialise import SurrogateFileError, load, save

FOLDER = "surrogates"
NEWEST = "surrogate.json"


@dataclass(frozen=True)
class Version:
    """The record that a version's file holds under `extra`.

    samples: how many it was fitted to. errors: output -> leave-one-out {rms, max, q2} in its
    unit. at_optimum: |J predicted - J true| / |J| at the true sample by the predicted optimum,
    itself left out (None before there is one). objective: the predicted J.
    """

    version: str
    parent: str | None
    samples: int
    errors: dict[str, dict[str, float]]
    at_optimum: float | None
    objective: float | None
    created: str


class Versions:
    """The versions of one run folder. What adds must be the folder's only job."""

    def __init__(self, run: Path) -> None:
        self.run, self.folder = run, run / FOLDER

    def names(self) -> list[str]:
        """Names of all versions, oldest first."""
        found = [p.stem for p in self.folder.glob("*.json") if p.stem.isdecimal()]
        return sorted(found, key=int)

    def add(
        self, surrogates: Sequence[GaussianProcess], extra: dict[str, Any], **facts: Any
    ) -> Version:
        """Keep surrogates as the next version, child of the newest; `facts` fill a `Version`."""
        self.folder.mkdir(exist_ok=True)
        parent = next(reversed(self.names()), None)
        version = Version(f"{int(parent or 0) + 1:04d}", parent, **facts)
        path = self.folder / f"{version.version}.json"
        save(surrogates, path, extra | {"version": asdict(version)})
        self.publish()
        return version

    def load(self, name: str) -> tuple[tuple[GaussianProcess, ...], Version]:
        """The surrogates of a version and its record.

        Raises SurrogateFileError where there is no such version, or its file is damaged.
        """
        path = self.folder / f"{name}.json"
        known = self.names()
        if name not in known:
            words = f"known are {known[0]} to {known[-1]}" if known else "there are none yet"
            raise SurrogateFileError(f"{path}: there is no such version; {words}")
        members, extra = load(path)
        record = extra.get("version")
        if not isinstance(record, dict) or set(record) != {f.name for f in fields(Version)}:
            raise SurrogateFileError(f"{path}: holds no record of its version")
        processes = tuple(m for m in members if isinstance(m, GaussianProcess))
        if len(processes) != len(members) or not processes:
            raise SurrogateFileError(f"{path}: holds other surrogates than Gaussian processes")
        return processes, Version(**record)

    def newest(self) -> tuple[tuple[GaussianProcess, ...], Version] | None:
        """The newest version, None where there is none."""
        names = self.names()
        return self.load(names[-1]) if names else None

    def publish(self) -> None:
        """Make surrogate.json the newest version."""
        newest = (self.folder / f"{self.names()[-1]}.json").read_bytes()
        target = self.run / NEWEST
        if not target.exists() or target.read_bytes() != newest:
            write_whole(target, newest)
