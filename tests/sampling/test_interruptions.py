"""A killed or interrupted run goes on from its samples and ends as if undisturbed."""

import json
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from oracles.busy import HANGS
from oracles.commands import changed, run
from test_sampling import ROOT, TWO_MASS, table


def command(folder: Path, *more: str, case: Path = TWO_MASS) -> list[str]:
    words = ["-m", "ccd_casadi.solve", str(case), "--out", str(folder), "--quiet", *more]
    words += ["--no-report"]
    return [sys.executable, *words]


def started(words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def rows(path: Path) -> int:
    """Samples in the store so far; 0 where it is not made yet."""
    try:
        database = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
        try:
            return int(database.execute("select count(*) from samples").fetchone()[0])
        finally:
            database.close()
    except sqlite3.OperationalError:
        return 0


def wait_for_rows(process: subprocess.Popen[str], path: Path, least: int) -> None:
    limit = time.monotonic() + HANGS
    while rows(path) < least and process.poll() is None:
        assert time.monotonic() < limit
        time.sleep(0.02)


def result(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "result.json").read_text())
    assert found.pop("seconds") > 0.0
    assert found.pop("phase_seconds")
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Callable[..., list[str]], Path]:
    """The command on a small case in one process, and the folder that it leaves undisturbed."""
    folder = tmp_path_factory.mktemp("runs")
    small = "\n[sampling]\npoints = 3\nlifted_points = 24\n[outer]\nbox_points = 0\n"
    case = changed(folder, more=small)

    def words(into: Path, *more: str) -> list[str]:
        return command(into, "--workers", "1", *more, case=case)

    assert run(folder / "run", "--no-report", case=case) == 0
    return words, folder / "run"


def interrupted_runs(
    words: list[str], folder: Path, kills: int, seed: int, span: float
) -> list[int]:
    """Kill and resume until `kills` kills have met a running command; rows left by each."""
    rng, left = random.Random(seed), []
    store = folder / "samples.sqlite"
    while len(left) < kills:
        process = started(words)
        if len(left) < 2 or rng.random() < 0.7:  # while it samples
            wait_for_rows(process, store, rows(store) + 1)
            time.sleep(rng.uniform(0.0, 0.3))
        else:  # at any moment: while it starts, fits, verifies or writes
            time.sleep(rng.uniform(0.5, 0.5 + span))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode in (0, -signal.SIGKILL)
        if process.returncode == 0:  # it had finished: begin again
            for path in folder.iterdir():
                path.unlink()
        else:
            left.append(rows(store))
    return left


@pytest.mark.parametrize(
    ("kills", "seed", "span"), [(2, 1, 1.0), pytest.param(20, 2, 1.5, marks=pytest.mark.slow)]
)
def test_killed_and_resumed_ends_as_if_undisturbed(
    undisturbed: tuple[Callable[..., list[str]], Path],
    tmp_path: Path,
    kills: int,
    seed: int,
    span: float,
) -> None:
    (words, whole), folder = undisturbed, tmp_path / "run"
    left = interrupted_runs(words(folder), folder, kills, seed, span)
    assert len(set(left)) >= 2, "the kills met the sampling at different points"
    done = subprocess.run(
        words(folder, "--resume"), cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert table(folder / "samples.sqlite") == table(whole / "samples.sqlite")
    assert result(folder) == result(whole)
    for name in ("controller.json", "surrogate.json", "case.toml"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes()


POOL = f"""
import sys
import numpy as np
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.sampler import Sampler

if __name__ == "__main__":
    problem = problem_of(load_case({str(TWO_MASS)!r}))
    with SampleStore(sys.argv[1]) as store, Workers(int(sys.argv[2])) as workers:
        sampler = Sampler(problem, store, workers)
        sampler.values(np.random.default_rng(0).uniform(55.0, 70.0, (40, 2)))
        print(sampler.syntheses)
"""


@pytest.mark.slow
def test_a_killed_pool_resumes_to_the_same_samples(tmp_path: Path) -> None:
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    seen: list[int] = []
    for _ in range(20):  # until two kills have met the sampling; it may be faster than we are
        process = started([sys.executable, str(script), str(tmp_path / "a.sqlite"), "2"])
        wait_for_rows(process, tmp_path / "a.sqlite", (seen[-1] if seen else 0) + 1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if process.returncode == -signal.SIGKILL:
            seen.append(rows(tmp_path / "a.sqlite"))
        else:
            for path in tmp_path.glob("a.sqlite*"):
                path.unlink()
            seen.clear()
        if len(seen) == 2:
            break
    assert 0 < seen[0] < seen[1], "the second run went on from the first"
    reported = []
    for name, workers in (("a", "2"), ("b", "1")):
        words = [sys.executable, str(script), str(tmp_path / f"{name}.sqlite"), workers]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        reported.append(done.stdout)
    assert reported[0] == reported[1], "as many syntheses are counted as if nothing had happened"
    assert table(tmp_path / "a.sqlite") == table(tmp_path / "b.sqlite")


@pytest.mark.parametrize(
    "formulation",
    # what is resumed ends alike: test_killed_and_resumed_ends_as_if_undisturbed
    [*(pytest.param(way, marks=pytest.mark.slow) for way in ("nested", "lifted")), "direct"],
)
def test_ctrl_c_is_resumable(
    undisturbed: tuple[Callable[..., list[str]], Path], tmp_path: Path, formulation: str
) -> None:
    """In the middle of sampling, or of IPOPT on the truth."""
    (words, whole), met = undisturbed, False
    for again in range(5):  # where this process is kept waiting the command may be done already
        folder = tmp_path / f"run{again}"
        process = started(words(folder, "--formulation", formulation))
        wait_for_rows(process, folder / "samples.sqlite", 20)
        met = process.poll() is None
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=HANGS)
        if met:
            break
    assert met
    assert (process.returncode, output) == (130, ""), errors
    assert len(errors.splitlines()) == 1, errors
    assert errors.startswith("interrupted: what is sampled is kept; the same command resumes")
    assert not (folder / "result.json").exists()
    if formulation == "nested":
        kept = rows(folder / "samples.sqlite")
        assert 20 <= kept < rows(whole / "samples.sqlite")
        assert run(folder, "--no-report", case=Path(words(folder)[3])) == 0
        assert result(folder) == result(whole)
