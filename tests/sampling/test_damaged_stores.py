"""Stores that are damaged, foreign, locked or out of place: one line, and left alone."""

import random
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from oracles.rows import sample

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.retraining import stored_designs
from ccd_casadi.sampling.store import SampleStore, SampleStoreError
from ccd_casadi.support.errors import UserError


def use(path: Path) -> None:
    """Everything that a run does with a store."""
    with SampleStore(path) as store:
        store.put([sample()])
        store.put_unit([sample("b")], ("r", "p", (1.0,), {}))
        store.select()
        store.get(["k"])
        store.get_result("r")
        store.count()


def refusal(path: Path) -> str:
    with pytest.raises(SampleStoreError) as caught:
        use(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert len(text.splitlines()) == 1
    return text


def test_a_store_error_is_a_user_error() -> None:
    assert issubclass(SampleStoreError, UserError)


@pytest.mark.parametrize("content", [b"not a database\n" * 200, b"[plant]\n", b"\x80\x04." * 5000])
def test_a_foreign_file_is_refused_and_left_alone(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.sqlite"
    path.write_bytes(content)
    assert "move it away or choose another --out" in refusal(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "tables",
    [
        "create table books (title text)",
        "create table meta (a int, b int, c int)",
        "create table samples (key text primary key, theta text)",
        "create table meta (name text primary key, value text)",
    ],
)
def test_another_programs_database_is_refused_and_left_alone(tmp_path: Path, tables: str) -> None:
    path = tmp_path / "s.sqlite"
    database = sqlite3.connect(path)
    database.executescript(tables)
    database.close()
    before = path.read_bytes()
    assert "choose another --out" in refusal(path)
    assert path.read_bytes() == before


def test_another_schema_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    use(path)
    database = sqlite3.connect(path)
    with database:
        database.execute("update meta set value = '0' where name = 'schema'")
    database.close()
    assert "schema 0, not 1" in refusal(path)


def test_an_empty_file_becomes_a_store(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    path.touch()
    use(path)
    with SampleStore(path) as store:
        assert store.count() == 2


def full_store(path: Path) -> bytes:
    with SampleStore(path) as store:
        store.put([sample(f"k{i}", gradients=(0.1,) * 16) for i in range(300)])
    return path.read_bytes()


@pytest.mark.parametrize("share", [0.001, 0.02, 0.3, 0.7, 0.99])
def test_a_truncated_store_is_refused(tmp_path: Path, share: float) -> None:
    path = tmp_path / "s.sqlite"
    whole = full_store(path)
    path.write_bytes(whole[: int(share * len(whole))])
    assert "damaged" in refusal(path)


def test_a_damaged_store_is_refused_or_reads_plain_samples(tmp_path: Path) -> None:
    whole, rng = full_store(tmp_path / "whole.sqlite"), random.Random(0)
    refused = 0
    for attempt in range(60):
        damaged = bytearray(whole)
        for _ in range(rng.randint(1, 200)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path = tmp_path / f"{attempt}.sqlite"
        path.write_bytes(damaged)
        reported = ""
        try:
            use(path)
        except SampleStoreError as error:
            reported = str(error)
        assert len(reported.splitlines()) <= 1
        refused += bool(reported)
    assert refused > 10


@pytest.mark.parametrize("name", ["proc", "folder", "absent"])
def test_a_place_that_holds_no_file_is_reported(tmp_path: Path, name: str) -> None:
    """Root may write nearly everywhere, but not make a file in /proc."""
    (tmp_path / "folder").mkdir()
    places = {
        "proc": Path("/proc/samples.sqlite"),
        "folder": tmp_path / "folder",
        "absent": tmp_path / "absent" / "samples.sqlite",
    }
    if name == "proc" and not Path("/proc/self").exists():
        pytest.skip("no /proc here")
    assert "give a writable folder with --out" in refusal(places[name])


def test_a_read_only_store_is_reported() -> None:
    """Root ignores permissions, so a child that gave them up tries it."""
    code = (
        "import os, sys\n"
        "from ccd_casadi.sampling.store import *\n"
        "if os.getuid() == 0: os.setgid(65534); os.setuid(65534)\n"
        "try:\n"
        "    with SampleStore(sys.argv[1]) as store: store.put_problem('p', {})\n"
        "except SampleStoreError as error: print(error)\n"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "s.sqlite"
        use(path)
        path.chmod(0o444)
        folder.chmod(0o555)
        done = subprocess.run(
            [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False
        )
        folder.chmod(0o755)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{path}: ")
    assert "give a writable folder with --out" in done.stdout
    assert len(done.stdout.splitlines()) == 1


def test_a_lock_that_lasts_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    use(path)
    holder = sqlite3.connect(path, isolation_level=None)
    with SampleStore(path, busy_seconds=0.2) as store:
        holder.execute("begin immediate")
        began = time.monotonic()
        with pytest.raises(SampleStoreError, match="another process holds it; wait or stop"):
            store.put([sample("c")])
        assert time.monotonic() - began > 0.15, "it waited for as long as it was told"
        with pytest.raises(SampleStoreError, match="another process holds it"):
            SampleStore(path, busy_seconds=0.2)
        assert store.count() == 2, "readers are not held up by a writer"
        holder.execute("rollback")
        store.put([sample("c")])
        assert store.count() == 3
    holder.close()


def test_a_row_that_only_the_index_has_is_damage(two_mass_run: Path, tmp_path: Path) -> None:
    """As after a flipped bit: SQLite asks an index or the table, never both."""
    path = Path(shutil.copy(two_mass_run / "samples.sqlite", tmp_path))
    problem = problem_of(load_case(two_mass_run / "case.toml"))
    with SampleStore(path) as store:
        key = stored_designs(store, problem)[0][1].key
    content = path.read_bytes()
    places = [m.start() for m in re.finditer(key.encode(), content)]
    assert len(places) >= 2, "in the table and in its index"
    for place in places:
        path.write_bytes(content[:place] + b"x" + content[place + 1 :])
        with pytest.raises(SampleStoreError, match="damaged"), SampleStore(path) as store:
            stored_designs(store, problem)
    path.write_bytes(content)
    with SampleStore(path) as store:
        assert stored_designs(store, problem)
