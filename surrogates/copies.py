"""A run folder copied as it is at one moment, also while somebody writes into its store."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

from surrogates.claims import FOLDER

LOCAL = (FOLDER, "*.sqlite", "*.sqlite-wal", "*.sqlite-shm")  # of one place, or copied otherwise


def copy_run(run: Path, out: Path) -> None:
    """Copy a run folder to `out`, unless something is there already: then it is gone on with.

    Databases go by SQLite's own backup, whole even in the middle of a transaction.
    """
    if out.exists() and any(out.iterdir()):
        return
    draft = out.with_name(out.name + ".part")  # a kill must not leave half a run to go on with
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(run, draft, ignore=shutil.ignore_patterns(*LOCAL))
    for path in run.glob("*.sqlite"):
        source = sqlite3.connect(path.resolve().as_uri() + "?mode=ro", uri=True)
        with closing(source), closing(sqlite3.connect(draft / path.name)) as target:
            source.backup(target)
    if out.exists():
        out.rmdir()
    draft.rename(out)
