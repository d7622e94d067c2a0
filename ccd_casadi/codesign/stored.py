"""What a run folder holds already: its true samples, and the versions of its surrogates.

Versions are kept for good, RUN_DIR/surrogates/0001.json, ...; RUN_DIR/surrogate.json is the newest.
Each file's `extra["version"]` says its number and its parent's, how many samples it was fitted to,
the leave-one-out errors of each output {rms, max, q2} in its unit, the predicted J (objective), and
|J predicted - J true| / |J| at the true sample by the predicted optimum, itself left out
(at_optimum).
"""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.sampling.rows import Sample, hashes_of
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import GaussianProcess
from surrogates.files import write_whole
from surrogates.serialise import save

SAME = 1e-9  # of the box: the rounding of a point that went through a surrogate


def stored_designs(store: SampleStore, problem: CoDesignProblem) -> list[tuple[Array, Sample]]:
    """Designs with derivatives inside the box as (x, row), x = (θ, ln ω_S, ln ω_T), oldest first.

    Designs that were not certified are among them.
    """
    bounds = lifted_bounds(problem)
    keys = store.keys_with_gradients(hashes_of(problem)[0])
    known, found = store.get(keys), []
    for item in keys:
        row = known.get(item)
        # an index that names what the table has not is damage too
        if (
            row is None
            or len(row.theta) != len(problem.names)
            or len(row.gradients or ()) != (2 + len(problem.inner.bounds)) * len(bounds.lower)
        ):
            raise store.damaged()
        x = np.array([*row.theta, np.log(row.omega_S), np.log(row.omega_T)])
        inside = np.clip(x, *bounds)
        if bounds.away(x, inside) <= SAME:
            found.append((inside, row))
    return found


def stored_thetas(store: SampleStore, problem: CoDesignProblem) -> Array:
    """Every θ (n, n_θ) inside the box whose inner problem was solved, oldest first."""
    lower, upper = box(problem)
    thetas = store.thetas(hashes_of(problem)[1])
    if any(len(theta) != len(lower) for theta in thetas):
        raise store.damaged()
    X = np.array(thetas, dtype=float).reshape(-1, len(lower))
    return X[((lower <= X) & (upper >= X)).all(axis=1)]


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


def publish(run: Path) -> None:
    """Make surrogate.json the newest version."""
    newest = (run / FOLDER / f"{version_names(run)[-1]}.json").read_bytes()
    target = run / NEWEST
    if not target.exists() or target.read_bytes() != newest:
        write_whole(target, newest)
