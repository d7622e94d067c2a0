"""Retraining of case study 1 in real processes: named versions, and whatever kills a job."""

import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from oracles.busy import HANGS

from surrogates.retrain import main

pytestmark = pytest.mark.slow  # a study of half a minute; its parts are tested apart
ROOT = Path(__file__).parents[2]
TWO_MASS = ROOT / "runs" / "two_mass.toml"


def started_from(folder: Path) -> Path:
    """A run folder with a case and nothing else."""
    folder.mkdir()
    shutil.copy(TWO_MASS, folder / "case.toml")
    return folder


@pytest.fixture(scope="module")
def retrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = started_from(tmp_path_factory.mktemp("two_mass") / "run")
    assert main([str(folder), "--workers", "1", "--quiet"]) == 0
    return folder


def result(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


# ---- real processes ------------------------------------------------------------------------------


def launched(folder: Path, *more: str) -> subprocess.Popen[str]:
    """The command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "surrogates.retrain", str(folder), "--quiet", "--workers=1", *more],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def keys(folder: Path) -> list[str]:
    with closing(sqlite3.connect(folder / "samples.sqlite")) as database, database:
        return [row[0] for row in database.execute("select key from samples")]


@pytest.mark.slow
def test_ctrl_c_ends_it_soon_and_it_resumes(tmp_path: Path) -> None:
    folder = started_from(tmp_path / "run")
    process = launched(folder)
    limit = time.monotonic() + HANGS
    while not (folder / "retrain.lock").exists() and process.poll() is None:
        assert time.monotonic() < limit
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=HANGS)
    if process.returncode == 0:
        pytest.skip("it had finished")
    assert (process.returncode, output) == (130, "")
    assert len(errors.splitlines()) == 1
    assert "resumes" in errors
    assert not (folder / "result.json").exists()


@pytest.mark.slow
def test_killed_at_random_it_ends_the_same(retrained: Path, tmp_path: Path) -> None:
    folder = started_from(tmp_path / "run")
    rng, killed = random.Random(4), 0
    began = time.monotonic()
    plain = launched(started_from(tmp_path / "plain"))
    plain.communicate()
    whole = time.monotonic() - began
    while killed < 20:
        process = launched(folder)
        time.sleep(rng.uniform(0.2, 1.0) * whole)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if process.returncode == -signal.SIGKILL:
            killed += 1
        else:
            assert process.returncode == 0
            shutil.rmtree(folder)
            started_from(folder)
    assert main([str(folder), "--workers", "1", "--quiet"]) == 0
    assert len(set(keys(folder))) == len(keys(folder))
    ours, theirs = result(folder), result(retrained)
    assert ours["objective"] == pytest.approx(theirs["objective"], rel=1e-6)
    assert ours["theta"] == pytest.approx(theirs["theta"], rel=1e-6)
    assert ours["active"] == theirs["active"]
    for path in (folder / "surrogates").glob("*.json"):
        json.loads(path.read_text())


@pytest.mark.slow
def test_of_two_jobs_one_is_refused(retrained: Path, tmp_path: Path) -> None:
    folder = started_from(tmp_path / "run")
    both = [launched(folder) for _ in range(2)]
    reported = [process.communicate()[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2]
    assert sorted(len(words.splitlines()) for words in reported) == [0, 1]
    assert result(folder)["objective"] == pytest.approx(result(retrained)["objective"], rel=1e-6)
