"""SIGKILL at random moments of sampling, solving and retraining: nothing lost, nothing doubled.

`python benchmarks/kills.py [--kills 200] [--seed 0]` kills real processes, lets each story end
undisturbed, compares it with one that never was disturbed, and writes benchmarks/kills.json.

Sampling and solving must end with the same result.json (seconds aside), controller.json,
surrogate.json, and the same rows in the store, to the last bit. Retraining decides from the samples
that are there, which a batch cut short may change: it must end verified at the same J to 1e-6.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
CASE = ROOT / "runs" / "two_mass.toml"
QUICK = """
[sampling]
points = 3
lifted_points = 16
[outer]
starts = 4
direct_starts = 2
max_refinements = 3
"""
KILLS_A_STORY = 8
SAME = 1e-6
SHARES = {"sampling": 0.25, "solving": 0.45, "retraining": 0.3}
FILES = ("controller.json", "surrogate.json", "case.toml")
SAMPLING = f"""
import sys
import numpy as np
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.sampler import Sampler

if __name__ == "__main__":
    problem = problem_of(load_case({str(CASE)!r}))
    with SampleStore(sys.argv[1] + "/samples.sqlite") as store, Workers(2) as workers:
        sampler = Sampler(problem, store, workers)
        rng = np.random.default_rng(0)
        sampler.values(rng.uniform(55.0, 70.0, (30, 2)))
        sampler.quantities(rng.uniform([55, 55, 5, 5.1], [70, 70, 9, 8.7], (40, 4)))
"""


@dataclass
class Tally:
    """What one kind of work went through."""

    kills: int = 0
    workers_killed: int = 0
    stories: int = 0
    equal_to_the_bit: int = 0
    lost: int = 0
    doubled: int = 0
    different: list[str] = field(default_factory=list)
    rows_at_kills: list[int] = field(default_factory=list)


def rows(folder: Path) -> list[str]:
    """Keys in the store so far; none where it is not made yet."""
    path = folder / "samples.sqlite"
    if not path.exists():
        return []
    database = sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=60.0)
    try:
        return [row[0] for row in database.execute("select key from samples")]
    except sqlite3.OperationalError:  # its tables are not made yet
        return []
    finally:
        database.close()


def table(folder: Path) -> list[tuple[Any, ...]]:
    """Everything in the store but the seconds."""
    database = sqlite3.connect(f"file:{folder / 'samples.sqlite'}?mode=ro", uri=True)
    names = [row[1] for row in database.execute("pragma table_info(samples)")]
    names.remove("seconds")
    found = database.execute(f"select {', '.join(names)} from samples order by key").fetchall()
    found += database.execute("select * from results order by key").fetchall()
    database.close()
    return found


def result(folder: Path) -> dict[str, Any]:
    """result.json without what no two runs share."""
    found = json.loads((folder / "result.json").read_text())
    return {name: found[name] for name in found if name not in ("seconds", "phase_seconds")}


def sampling(folder: Path, number: int) -> list[str]:
    """Sampling on two worker processes."""
    return [sys.executable, str(folder.parent / "sampling.py"), str(folder)]


def solving(folder: Path, number: int) -> list[str]:
    """The whole command, each formulation in turn."""
    formulation = ("nested", "lifted", "direct")[number % 3]
    case = folder.parent / "quick.toml"
    words = ["-m", "ccd_casadi.solve", str(case), "--out", str(folder), "--quiet"]
    workers = str(1 + number // 3 % 2)
    return [sys.executable, *words, "--formulation", formulation, "--workers", workers]


def retraining(folder: Path, number: int) -> list[str]:
    """Retraining from nothing."""
    words = ["-m", "surrogates.retrain", str(folder), "--quiet", "--workers", "1"]
    return [sys.executable, *words]


KINDS: dict[str, Callable[[Path, int], list[str]]] = {
    "sampling": sampling, "solving": solving, "retraining": retraining,
}  # fmt: skip


def started(kind: str, folder: Path) -> None:
    """A folder to start in."""
    folder.mkdir()
    (folder.parent / "sampling.py").write_text(SAMPLING)
    (folder.parent / "quick.toml").write_text(CASE.read_text() + QUICK)
    if kind == "retraining":
        shutil.copy(folder.parent / "quick.toml", folder / "case.toml")


def process_of(words: list[str]) -> subprocess.Popen[str]:
    """A process of its own group, so that its workers may be found."""
    return subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def children(pid: int) -> list[int]:
    """Processes that a process has started, or these, and that still run."""
    path = Path(f"/proc/{pid}/task/{pid}/children")
    own = [int(word) for word in path.read_text().split()] if path.exists() else []
    return own + [each for child in own for each in children(child)]


def killed(process: subprocess.Popen[str], rng: random.Random, tally: Tally, limit: float) -> bool:
    """Kill the process, or once in three times first a worker of it; whether it was met running."""
    time.sleep(rng.uniform(0.0, limit))
    if rng.random() < 1.0 / 3.0:
        spawned = [p for p in children(process.pid) if _is_worker(p)]
        if spawned:
            os.kill(rng.choice(spawned), signal.SIGKILL)
            tally.workers_killed += 1
            time.sleep(rng.uniform(0.0, 0.5 * limit))
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return process.returncode == -signal.SIGKILL


def _is_worker(pid: int) -> bool:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes()
        return b"spawn_main" in words or b"forkserver" in words
    except OSError:
        return False


def story(
    kind: str, place: Path, number: int, rng: random.Random, tally: Tally, plain: Path, whole: float
) -> None:
    """Kill and start again a few times, let it end, and compare with the undisturbed run."""
    folder = place / f"{kind}{number}"
    started(kind, folder)
    words = KINDS[kind](folder, number)
    before: set[str] = set(rows(folder))
    for _ in range(KILLS_A_STORY):
        # What is resumed has less to do than the whole: half the time, or it has mostly ended.
        if not killed(process_of(words), rng, tally, 0.5 * whole):
            break
        tally.kills += 1
        found = rows(folder)
        tally.doubled += len(found) - len(set(found))
        tally.lost += len(before - set(found))
        tally.rows_at_kills.append(len(found))
        before = set(found)
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    tally.stories += 1
    found = rows(folder)
    tally.doubled += len(found) - len(set(found))
    tally.lost += len(before - set(found))
    if done.returncode != 0:
        tally.different.append(f"{kind} {number}: exit {done.returncode}: {done.stderr[-300:]}")
    elif same(kind, folder, plain):
        tally.equal_to_the_bit += 1
    elif kind != "retraining" or not close(folder, plain):
        tally.different.append(f"{kind} {number}: another result")
    shutil.rmtree(folder)


def same(kind: str, folder: Path, plain: Path) -> bool:
    """Equal to the last bit."""
    if table(folder) != table(plain):
        return False
    if kind == "sampling":
        return True
    files = [name for name in FILES if (plain / name).exists()]
    return result(folder) == result(plain) and all(
        undated(folder / name) == undated(plain / name) for name in files
    )


def undated(path: Path) -> bytes:
    """A file without the moment at which its surrogate was made."""
    return re.sub(rb'"created": "[^"]*"', b"", path.read_bytes())


def close(folder: Path, plain: Path) -> bool:
    """The same optimum, verified."""
    ours, theirs = result(folder), result(plain)
    values = [(ours["objective"], theirs["objective"])]
    values += [(ours["theta"][name], theirs["theta"][name]) for name in theirs["theta"]]
    return (
        (ours["status"], ours["active"]) == (theirs["status"], theirs["active"])
        and all(abs(a - b) <= SAME * abs(b) for a, b in values)
    )  # fmt: skip


def undisturbed(kind: str, place: Path, which: int) -> tuple[Path, float]:
    """A run that nobody kills, and the shorter time of two: the first may compile and import."""
    seconds = []
    for attempt in range(2):
        folder = place / f"plain{attempt}_{kind}{which}"
        started(kind, folder)
        start = time.perf_counter()
        subprocess.run(KINDS[kind](folder, which), cwd=ROOT, check=True)
        seconds.append(time.perf_counter() - start)
    return folder, min(seconds)


def main() -> None:
    """Kill so many times over the three kinds and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=sorted(KINDS), help="all the kills over this one")
    options = parser.parse_args()
    tallies = {kind: Tally() for kind in KINDS if options.only in (None, kind)}
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="kills_") as name:
        place = Path(name)
        for kind, tally in tallies.items():
            rng = random.Random(f"{options.seed} {kind}")
            share = round(options.kills * (1.0 if options.only else SHARES[kind]))
            plain: dict[int, tuple[Path, float]] = {}
            number = 0
            while tally.kills < share:
                which = number % 6 if kind == "solving" else 0
                if which not in plain:
                    plain[which] = undisturbed(kind, place, which)
                story(kind, place, number, rng, tally, *plain[which])
                number += 1
                print(kind, number, tally.kills, tally.different, flush=True)
    figures = {
        "seed": options.seed,
        "kills": sum(tally.kills for tally in tallies.values()),
        "rows_lost": sum(tally.lost for tally in tallies.values()),
        "rows_doubled": sum(tally.doubled for tally in tallies.values()),
        "different": sum(len(tally.different) for tally in tallies.values()),
        "kinds": {kind: vars(tally) for kind, tally in tallies.items()},
        "seconds": time.perf_counter() - began,
    }
    if options.only is None:
        (ROOT / "benchmarks" / "kills.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
