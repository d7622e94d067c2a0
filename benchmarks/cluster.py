"""Throughput of sampling: one worker against two, process pool and Dask; overheads; the store.

    OPENBLAS_NUM_THREADS=1 python benchmarks/cluster.py [REPEATS]

A scheduler and its workers are started on loopback. On a shared machine the wall clock measures the
neighbours as well: each figure is the best of REPEATS (5) interleaved rounds, and beside every
ratio of two workers to one stands the same ratio of a loop of plain arithmetic in bare processes,
which is what the machine had to give in that round.
"""

import json
import multiprocessing
import os
import pickle
import platform
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import psutil

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.sampling.cluster import Cluster
from ccd_casadi.sampling.sampler import CHUNK
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.units import design_unit, inner_unit
from ccd_casadi.support.process_pool import Pool, Workers

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).with_name("cluster.json")
UNITS = 80  # inner problems a round; 10 of them, of 400 syntheses each, by the sweep
EMPTY = 300  # tasks that do nothing, for the overhead


def spin(turns: int) -> int:
    """Plain arithmetic, some 50 ms for 10^6 turns: no memory, no library."""
    total = 0
    for i in range(turns):
        total += i & 3
    return total


def timed(action: Callable[[], object]) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def machine_ratio() -> float:
    """How much more two bare processes do than one, now."""
    turns = 20_000_000
    with multiprocessing.get_context("spawn").Pool(2) as processes:
        processes.map(spin, [1, 1])
        one = timed(lambda: processes.apply(spin, (turns,)))
        two = timed(lambda: processes.map(spin, [turns, turns], chunksize=1))
    return 2.0 * one / two


class LocalCluster:
    """`dask scheduler` and `dask worker` processes on loopback, ended with the block."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]

    def __enter__(self) -> Cluster:
        address = f"tcp://127.0.0.1:{self.port}"
        self.processes = [self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port))]
        for _ in range(self.workers):
            self.processes.append(self._start("worker", address, "--nthreads", "1", "--no-nanny"))
        self.cluster = Cluster(address).__enter__()
        self.cluster._client.wait_for_workers(self.workers, timeout=60)
        return self.cluster

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *words], start_new_session=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "benchmarks")])},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def __exit__(self, *error: object) -> None:
        self.cluster.__exit__(None, None, None)
        for process in self.processes:
            process.kill()
            process.wait()


def drained(pool: Pool, function: Callable, tasks: list) -> float:
    """Seconds for all the tasks of a map."""
    return timed(lambda: list(pool.map_unordered(function, tasks)))


def overhead(cluster: LocalCluster, pool: Pool, tasks: list[bytes]) -> dict[str, float]:
    """Milliseconds a task that does nothing, and returns what a unit of work does."""
    scheduler = psutil.Process(cluster.processes[0].pid)
    before, began = sum(scheduler.cpu_times()[:2]), time.process_time()
    seconds = drained(pool, bytes, tasks)
    spent = {
        "wall": seconds,
        "client_cpu": time.process_time() - began,
        "scheduler_cpu": sum(scheduler.cpu_times()[:2]) - before,
    }
    return {name: 1e3 * value / len(tasks) for name, value in spent.items()}


def store_rates(folder: Path, unit: tuple, rows: int) -> dict[str, float]:
    """Rows a second into the store by units of work, and by chunks with derivatives."""
    samples, (_, theta, payload) = unit
    units = max(1, rows // len(samples))
    with SampleStore(folder / "units.sqlite") as store:
        began = time.perf_counter()
        for i in range(units):
            fresh = [replace(s, key=f"{i}-{j}") for j, s in enumerate(samples)]
            store.put_unit(fresh, (str(i), "owner", theta, payload), "problem")
        seconds = time.perf_counter() - began
        size = sum(path.stat().st_size for path in folder.glob("units.sqlite*"))
    written = units * len(samples)
    return {"rows_per_s": written / seconds, "ms_per_unit": 1e3 * seconds / units,
            "rows_per_unit": len(samples), "bytes_per_row": size / written}  # fmt: skip


def main(repeats: int) -> None:
    """Measure, print, write."""
    problem = problem_of(load_case(ROOT / "runs" / "two_mass.toml"))
    thetas = np.random.default_rng(0).uniform(55.0, 70.0, (UNITS, 2))
    inner = [(problem, "p", str(i), tuple(theta)) for i, theta in enumerate(thetas.tolist())]
    sweeps = [(replace(problem, method="sweep"), *task[1:]) for task in inner[:10]]
    points = [(str(i), (*theta, np.log(600.0 + i), np.log(250.0)))
              for i, theta in enumerate(thetas.tolist())]  # fmt: skip
    designs = [(problem, points[i : i + CHUNK]) for i in range(0, UNITS, CHUNK)]
    unit = inner_unit(inner[0])
    payload = pickle.dumps(unit)
    work = {
        "inner": (inner_unit, inner),
        "sweep": (inner_unit, sweeps),
        "design": (design_unit, designs),
    }
    alone = {}  # CPU seconds of the work itself, which neighbours do not lengthen much
    for name, (function, tasks) in work.items():
        began = time.process_time()
        for task in tasks:
            function(task)
        alone[name] = (time.process_time() - began) / len(tasks)
    times: dict[str, list[float]] = {}
    machine, overheads = [], []
    clusters: list[LocalCluster] = []
    with ExitStack() as stack:
        pools: dict[str, Pool] = {}
        for count in (1, 2):
            # a pool of one is this process: its figure is that of the serial run
            pools[f"pool_{count}"] = stack.enter_context(Workers(count))
            clusters.append(LocalCluster(count))
            pools[f"dask_{count}"] = stack.enter_context(clusters[-1])
        for pool in pools.values():
            for function, tasks in work.values():
                drained(pool, function, tasks[:8])  # imports, compiled code, the plant
        for _ in range(repeats):
            machine.append(machine_ratio())
            overheads.append(overhead(clusters[1], pools["dask_2"], [payload] * EMPTY))
            for name, (function, tasks) in work.items():
                for which, pool in pools.items():
                    times.setdefault(f"{which}_{name}", []).append(drained(pool, function, tasks))
    best = {name: min(seconds) for name, seconds in times.items()}
    answer: dict[str, object] = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "load_average_1_min": os.getloadavg()[0],
        "repeats": repeats,
        "versions": {name: version(name) for name in ("dask", "distributed", "numpy", "scipy")},
        "machine_ratio_of_2_to_1": {"best": max(machine), "all": machine},
        "bytes_per_answer": len(payload),
        "dask_overhead_ms_per_task": {
            name: min(figures[name] for figures in overheads) for name in overheads[0]
        },
        "tasks": {},
    }
    for name, (_, tasks) in work.items():
        figures: dict[str, object] = {"tasks": len(tasks), "cpu_ms_alone": 1e3 * alone[name]}
        for kind in ("pool", "dask"):
            one, two = (times[f"{kind}_{count}_{name}"] for count in (1, 2))
            figures[kind] = {
                "ms_per_task_1": 1e3 * best[f"{kind}_1_{name}"] / len(tasks),
                "ms_per_task_2": 1e3 * best[f"{kind}_2_{name}"] / len(tasks),
                "ratio_of_best": min(one) / min(two),
                "ratio_by_round": [a / b for a, b in zip(one, two, strict=True)],
            }
        answer["tasks"][name] = figures
    with tempfile.TemporaryDirectory() as folder:
        answer["store"] = store_rates(Path(folder), unit, 20_000)
    RESULTS.write_text(json.dumps(answer, indent=2) + "\n")
    print(f"machine: two bare processes do {max(machine):.2f} times one at best, "
          f"load {answer['load_average_1_min']:.1f}")  # fmt: skip
    for name, figures in answer["tasks"].items():
        for kind in ("pool", "dask"):
            f = figures[kind]
            rounds = " ".join(f"{ratio:.2f}" for ratio in f["ratio_by_round"])
            print(f"{name:7}{kind:5} {figures['cpu_ms_alone']:8.2f} ms CPU alone, a task takes "
                  f"{f['ms_per_task_1']:8.2f} ms with 1, {f['ms_per_task_2']:8.2f} ms with 2: "
                  f"{f['ratio_of_best']:.2f} times (rounds {rounds})")  # fmt: skip
    print(
        "Dask, a task that does nothing: {wall:.2f} ms with 2 workers; CPU {client_cpu:.2f} ms "
        "client, {scheduler_cpu:.2f} ms scheduler".format(**answer["dask_overhead_ms_per_task"])
    )
    print("store: {rows_per_s:.0f} rows/s, {ms_per_unit:.2f} ms a unit of {rows_per_unit} rows, "
          "{bytes_per_row:.0f} bytes a row".format(**answer["store"]))  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
