"""What retraining keeps in a run folder: its lock, and RUN_DIR/surrogates/0001.json, ..., for good.

Each file's `extra["version"]` says its number and its parent's, how many samples it was fitted to,
the leave-one-out errors of each output {rms, max, q2} in its unit, the predicted J (objective), and
|J predicted - J true| / |J| at the true sample by the predicted optimum, itself left out
(at_optimum); RUN_DIR/surrogate.json is the newest.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from ccd_casadi.support.errors import UserError
from surrogates.files import write_whole
from surrogates.gaussian_process import GaussianProcess
from surrogates.serialise import SurrogateFileError, load, save

FOLDER, NEWEST = "surrogates", "surrogate.json"
LOCK = "retrain.lock"  # a database that the job keeps locked, of what was spent before the first


@contextmanager
def only_job(run: Path, spent: int) -> Iterator[int]:
    """Hold a run folder, at most until the process ends; yields what its first job found spent.

    Raises UserError where another job holds it.
    """
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(run / LOCK, timeout=0.0, isolation_level=None)
            execute = stack.enter_context(closing(connection)).execute
            execute("pragma locking_mode = exclusive")  # beyond the commit
            execute("begin exclusive")
            execute("create table if not exists job (spent integer)")
            execute("insert into job select ? where not exists (select * from job)", [spent])
            (base,) = execute("select spent from job").fetchone()
            execute("commit")
        except sqlite3.DatabaseError as error:
            raise UserError(
                f"{run / LOCK}: {error}; wait for the job that retrains this folder, retrain a "
                "copy (--out), or where no job runs delete that file"
            ) from None
        yield int(base)


def version_names(run: Path) -> list[str]:
    """Names of all versions, oldest first."""
    found = [p.stem for p in (run / FOLDER).glob("*.json") if p.stem.isdecimal()]
    return sorted(found, key=int)


def keep_version(
    run: Path, surrogates: Sequence[GaussianProcess], extra: dict[str, Any], **facts: Any
) -> str:
    """Keep surrogates as the next version, child of the newest, and return its name.

    For the one job that holds the run folder.
    """
    (run / FOLDER).mkdir(exist_ok=True)
    parent = next(reversed(version_names(run)), None)
    name = f"{int(parent or 0) + 1:04d}"
    record = {"version": name, "parent": parent, **facts}
    save(surrogates, run / FOLDER / f"{name}.json", extra | {"version": record})
    publish(run)
    return name


def load_version(run: Path, name: str) -> tuple[GaussianProcess, ...]:
    """The surrogates of a version.

    Raises SurrogateFileError where there is no such version, or its file is damaged.
    """
    path, known = run / FOLDER / f"{name}.json", version_names(run)
    if name not in known:
        words = f"known are {known[0]} to {known[-1]}" if known else "there are none yet"
        raise SurrogateFileError(f"{path}: there is no such version; {words}")
    members = load(path)[0]
    processes = tuple(m for m in members if isinstance(m, GaussianProcess))
    if len(processes) != len(members) or not processes:
        raise SurrogateFileError(f"{path}: holds other surrogates than Gaussian processes")
    return processes


def publish(run: Path) -> None:
    """Make surrogate.json the newest version."""
    newest = (run / FOLDER / f"{version_names(run)[-1]}.json").read_bytes()
    target = run / NEWEST
    if not target.exists() or target.read_bytes() != newest:
        write_whole(target, newest)
