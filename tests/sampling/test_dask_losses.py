"""Workers and schedulers that die or stay away: nothing lost, nothing twice.

How that goes depends on how the machine schedules the processes: marked slow.
"""

import os
import random
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.busy import HANGS
from oracles.dask_processes import Processes, both_workers
from oracles.helpers import problem
from test_interruptions import command, rows, started, wait_for_rows
from test_sampling import table

from ccd_casadi.extensions.cluster.dask_pool import Cluster
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.solve import main
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.worker_process import WorkerLost

pytestmark = pytest.mark.slow


# ---- tasks, imported by the workers --------------------------------------------------------------


def waits(task: tuple[int, str]) -> int:
    """The value, once a file is there."""
    value, path = task
    while not os.path.exists(path):
        time.sleep(0.01)
    return value


def dies_at_two(value: int) -> int:
    if value == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


# ---- losses --------------------------------------------------------------------------------------


class Counted(SampleStore):
    """A store that keeps what was delivered to it, twice or not."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.units: list[str] = []

    def put_unit(self, samples: Any, result: Any, problem: str | None = None) -> None:
        self.units.append(result[0])
        super().put_unit(samples, result, problem)


def serial(path: Path, thetas: np.ndarray) -> dict[str, list[tuple[Any, ...]]]:
    with SampleStore(path) as store:
        Sampler(problem(), store, Workers(1)).values(thetas)
    return table(path)


def test_killed_workers_lose_no_sample_and_double_none(nannies: Processes, tmp_path: Path) -> None:
    kills = 3  # as many as Dask allows one task
    rng = random.Random(kills)
    box = np.random.default_rng(kills)
    path, finished = tmp_path / "dask.sqlite", threading.Event()
    killed: list[int] = []

    def kill() -> None:
        seen = 0
        while len(killed) < kills and not finished.is_set():
            workers = [pid for pid in nannies.workers() if pid not in killed]
            if workers and rows(path) > seen:  # sampling goes on
                time.sleep(rng.uniform(0.0, 0.1))
                seen = rows(path)
                victim = rng.choice(workers)
                with suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)
                    killed.append(victim)
            time.sleep(0.01)

    batches = []
    with Counted(path) as store, Cluster(nannies.address) as cluster:
        both_workers(cluster)
        killer = threading.Thread(target=kill)
        killer.start()
        try:
            sampler = Sampler(problem(), store, cluster)
            while killer.is_alive():
                batches.append(box.uniform(55.0, 70.0, (20, 2)))
                found = sampler.values(batches[-1])
                assert [sample.theta for sample in found] == [tuple(t) for t in batches[-1]]
        finally:
            finished.set()
            killer.join()
    assert len(set(killed)) == kills
    assert len(store.units) == len(set(store.units)) == 20 * len(batches)
    assert table(path) == serial(tmp_path / "serial.sqlite", np.vstack(batches))


def test_a_cluster_that_stays_away_is_reported(shared: Processes, tmp_path: Path) -> None:
    tasks = [(i, str(tmp_path / "never")) for i in range(4)]
    with Cluster(shared.address, absence=1.0) as cluster:
        for process in shared.started:
            process.kill()
        with pytest.raises(WorkerLost, match="the worker is gone; start `dask worker` again"):
            list(cluster.map_unordered(waits, tasks))
    shared.kill()
    shared.start()
    with Cluster(shared.address) as cluster:
        results = cluster.map_unordered(waits, [(0, str(tmp_path)), *tasks])
        next(results)
        shared.kill()
        with pytest.raises(WorkerLost, match=r"scheduler is gone.* the same command resumes"):
            list(results)


def test_a_task_that_kills_every_worker_is_reported(nannies: Processes) -> None:
    with Cluster(nannies.address) as cluster, pytest.raises(WorkerLost, match="after worker died"):
        list(cluster.map_unordered(dies_at_two, range(8)))


def test_ctrl_c_ends_promptly_and_is_resumable(shared: Processes, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = [*command(folder), "--scheduler", shared.address]
    process = started(words)
    wait_for_rows(process, folder / "samples.sqlite", 20)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=HANGS)
    assert (process.returncode, output) == (130, "")
    assert len(errors.splitlines()) == 1, errors
    assert errors.startswith("interrupted: what is sampled is kept; the same command resumes")
    kept = table(folder / "samples.sqlite")["samples"]
    assert len(kept) >= 20
    assert main(words[3:]) == 0
    after = table(folder / "samples.sqlite")["samples"]
    # a row may gain its gradients later; what it says of the design stays
    assert {row[:6] for row in kept} <= {row[:6] for row in after}
