"""10⁶ rows in one store: writing, opening, asking and resuming; and eight processes on one store.

`python benchmarks/store_load.py [--rows N]` writes benchmarks/store_load.json.
"""

import argparse
import json
import multiprocessing
import platform
import resource
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.stored import stored_designs
from ccd_casadi.sampling.rows import problem_hash, sample_key
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers

ROOT = Path(__file__).parent.parent
UNIT = 20  # rows a transaction, as many as an inner problem takes
PROBLEMS = 20  # that share the store: 5 % of the rows are of the one that is asked for
PROCESSES, SHARED = 8, 4000


def filled(path: Path, rows: int) -> list[str]:
    """Make a store of so many rows of 20 problems, one of them case study 1; return its keys."""
    problem = problem_of(load_case(ROOT / "runs" / "two_mass.toml"))
    with SampleStore(path) as store, Workers(1) as workers:
        sampler = Sampler(problem, store, workers)
        sampler.quantities(np.array([[60.0, 60.0, 8.0, 5.0]]))
        (model,) = store.select(sampler.hash)
        rng, keys = np.random.default_rng(0), []
        owners = [sampler.hash, *(problem_hash({"other": i}) for i in range(1, PROBLEMS))]
        for start in range(0, rows, UNIT):
            owner = owners[start // UNIT % PROBLEMS]
            unit = []
            for x in rng.uniform([55.0, 55.0, 4.2, 5.1], [70.0, 70.0, 9.3, 8.7], (UNIT, 4)):
                theta, omega = tuple(map(float, x[:2])), tuple(map(float, np.exp(x[2:])))
                key = sample_key(owner, theta, *omega)
                unit.append(
                    replace(model, key=key, theta=theta, omega_S=omega[0], omega_T=omega[1])
                )
                if owner == sampler.hash:
                    keys.append(key)
            inner = sample_key(owner, unit[0].theta)
            store.put_unit(unit, (inner, owner, unit[0].theta, {"syntheses": UNIT}), owner)
    return keys


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call, and what it returned."""
    began = perf_counter()
    value = work()
    return perf_counter() - began, value


def share(path: Path, which: int) -> None:
    """One of several processes that write and read the same store."""
    with SampleStore(path) as store:
        (model,) = store.select("base")
        for i in range(0, SHARED, UNIT):
            # every row is written by two of the processes
            names = [f"{which // 2}-{j}" for j in range(i, i + UNIT)]
            store.put([replace(model, key=name) for name in names], "shared")
            assert len(store.get(names)) == UNIT


def eight(folder: Path, path: Path) -> dict[str, Any]:
    """Eight processes write 4 x 4000 distinct rows, each twice, into one store."""
    with SampleStore(path) as store:
        (model, *_) = store.select(problem_hash({"other": 1}))[:1]
    shared = folder / "shared.sqlite"
    with SampleStore(shared) as store:
        store.put([replace(model, key="base")], "base")
    context = multiprocessing.get_context("spawn")
    began = perf_counter()
    processes = [context.Process(target=share, args=(shared, i)) for i in range(PROCESSES)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    seconds = perf_counter() - began
    with SampleStore(shared) as store:
        count = store.count("shared")
    return {
        "processes": PROCESSES,
        "failed": sum(process.exitcode != 0 for process in processes),
        "rows": count,
        "rows_expected": PROCESSES // 2 * SHARED,
        "puts": PROCESSES * SHARED,
        "seconds": seconds,
    }


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    rows = parser.parse_args().rows
    problem = problem_of(load_case(ROOT / "runs" / "two_mass.toml"))
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "samples.sqlite"
        figures: dict[str, Any] = {"rows": rows, "machine": platform.machine(), "seconds": {}}
        seconds = figures["seconds"]
        seconds["write"], keys = timed(lambda: filled(path, rows))
        figures["megabytes"] = path.stat().st_size / 1e6
        seconds["open"], store = timed(lambda: SampleStore(path))
        with store:
            hashed = problem_hash(problem.identity())
            seconds["count_all"], figures["rows_found"] = timed(store.count)
            seconds["count_one_problem"], figures["rows_of_problem"] = timed(
                lambda: store.count(hashed)
            )
            seconds["get_500_keys"], found = timed(lambda: store.get(keys[:500]))
            assert len(found) == 500
            seconds["select_one_problem"], found = timed(lambda: store.select(hashed))
            assert len(found) == len(keys) + 1
            seconds["resume_known_designs"], found = timed(lambda: stored_designs(store, problem))
            assert len(found) == len(keys) + 1
        figures["eight_processes"] = eight(Path(name), path)
    figures["peak_megabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    text = json.dumps(figures, indent=2) + "\n"
    (ROOT / "benchmarks" / "store_load.json").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
