"""The surrogates that a run folder keeps: RUN_DIR/surrogates/0001.json ... and their index.

A version is written once and never changed. Its number is taken by making the file, so that two
jobs never share one; `index.json` lists all of them, and RUN_DIR/surrogate.json is the newest.
"""

import json
import os
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from surrogates.files import write_whole
from surrogates.gaussian_process import GaussianProcess
from surrogates.serialise import SurrogateFileError, load, save

FOLDER = "surrogates"
INDEX = "index.json"
NEWEST = "surrogate.json"


@dataclass(frozen=True)
class Version:
    """One surrogate of a run, as the index lists it.

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
    """The versions of one run folder. What reads and adds must hold a lock against other jobs."""

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
        draft = self.folder / f".{secrets.token_hex(4)}.part"
        try:
            while True:
                names = self.names()
                parent = names[-1] if names else None
                version = Version(f"{int(parent or 0) + 1:04d}", parent, **facts)
                save(surrogates, draft, extra | {"version": asdict(version)})
                try:
                    os.link(draft, self.folder / f"{version.version}.json")  # never overwrites
                    break
                except FileExistsError:
                    continue
        finally:
            draft.unlink(missing_ok=True)
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
        """Write the index of all versions, and surrogate.json as the newest of them."""
        names = self.names()
        records = [asdict(self.load(name)[1]) for name in names]
        text = json.dumps({"versions": records}, indent=2, allow_nan=False) + "\n"
        write_whole(self.folder / INDEX, text)
        if names:
            newest = (self.folder / f"{names[-1]}.json").read_bytes()
            target = self.run / NEWEST
            if not target.exists() or target.read_bytes() != newest:
                write_whole(target, newest)
