"""Files that are written whole or not at all, and a run folder copied as it is at one moment."""

import os
import secrets
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

LOCAL = ("*.sqlite", "*.sqlite-wal", "*.sqlite-shm")  # copied otherwise


def write_whole(path: Path, content: str | bytes) -> None:
    """Replace a file in one step: a kill or a full disk leaves the old one.

    Parameters
    ----------
    path : Path
        Of the file.
    content : str or bytes
        Text as UTF-8.

    Raises
    ------
    OSError
        The folder cannot be written, or the disk is full.
    """
    # In the same folder, since a rename is atomic only within one file system; under a name that
    # no other job has, since several may write the same file.
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with draft.open("wb") as stream:
            stream.write(content.encode() if isinstance(content, str) else content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def copy_run(run: Path, out: Path) -> None:
    """Copy a run folder, unless something is there already, which is then resumed.

    Databases go by SQLite's own backup, whole even in the middle of a transaction and while
    somebody writes into them.

    Parameters
    ----------
    run, out : Path
        From where, and to where.
    """
    if out.exists() and any(out.iterdir()):
        return
    draft = out.with_name(out.name + ".part")  # a kill must not leave half a run
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(run, draft, ignore=shutil.ignore_patterns(*LOCAL))
    for path in run.glob("*.sqlite"):
        source = sqlite3.connect(path.resolve().as_uri() + "?mode=ro", uri=True)
        with closing(source), closing(sqlite3.connect(draft / path.name)) as target:
            source.backup(target)
    if out.exists():
        out.rmdir()
    draft.rename(out)
