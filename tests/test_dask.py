"""A real Dask scheduler and real workers on loopback: nothing lost, nothing counted twice.

What freezes, kills or outwaits processes depends on how the machine schedules them: marked slow.
"""

import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import problem
from test_parallel import TaskFailure, failing, square, whereabouts
from test_sampling import THETAS, TWO_MASS, X, command, rows, started, table, wait_for_rows

from ccd_casadi import cluster as module
from ccd_casadi import solve
from ccd_casadi.cluster import Cluster
from ccd_casadi.errors import UserError
from ccd_casadi.parallel import WorkerLost, Workers
from ccd_casadi.samples import SampleStore
from ccd_casadi.sampling import Truth

HERE = Path(__file__).parent


# ---- tasks, imported by the workers --------------------------------------------------------------


def waits(task: tuple[int, str]) -> int:
    """The value, once a file is there."""
    value, path = task
    while not os.path.exists(path):
        time.sleep(0.01)
    return value


def straggles(task: tuple[int, str]) -> int:
    """Zero's first copy ends after its second; the last value waits until both have."""
    value, folder = task
    begun, second, first = (Path(folder) / name for name in ("begun", "second", "first"))
    if value == 0:
        try:
            begun.touch(exist_ok=False)
        except FileExistsError:
            second.touch()
        else:
            waits((0, str(second)))
            first.touch()
    elif value == 9:
        waits((9, str(first)))
    return value


def freezes_once(task: tuple[int, str]) -> int:
    """Zero's first copy stops its whole worker, which then says nothing more."""
    value, folder = task
    if value == 0 and not (Path(folder) / "frozen").exists():
        (Path(folder) / "frozen").touch()
        os.kill(os.getpid(), signal.SIGSTOP)
    return value


def dies_at_two(value: int) -> int:
    if value == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


# ---- a cluster of our own ------------------------------------------------------------------------


class Processes:
    """`dask scheduler` and `dask worker` as a user starts them; a nanny restarts its worker."""

    def __init__(self, folder: Path, nanny: bool = False) -> None:
        self.folder, self.nanny = folder, nanny
        self.tls: list[str] = []
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.started: list[subprocess.Popen[bytes]] = []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"

    def use_tls(self) -> dict[str, str]:
        """A certificate of our own for everyone; returns the client's settings."""
        key, certificate = str(self.folder / "key.pem"), str(self.folder / "certificate.pem")
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1",
             "-subj", "/CN=test", "-keyout", key, "-out", certificate],
            check=True, capture_output=True,
        )  # fmt: skip
        self.address = self.address.replace("tcp", "tls")
        self.tls = ["--tls-ca-file", certificate, "--tls-cert", certificate, "--tls-key", key]
        prefix = "distributed.comm.tls."
        return {
            prefix + "ca-file": certificate,
            prefix + "client.cert": certificate,
            prefix + "client.key": key,
        }

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)]),
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "3",
        }
        log = (self.folder / "log.txt").open("ab")
        with log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *words, *self.tls], cwd=self.folder, env=environment,
                stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip

    def start(self) -> None:
        """A scheduler on the same port as ever, and two workers."""
        self.scheduler = self._start(
            "scheduler", "--host", self.address.rsplit(":", 1)[0], "--port", str(self.port),
            "--dashboard-address", "127.0.0.1:0", "--no-show",
        )  # fmt: skip
        nanny = "--nanny" if self.nanny else "--no-nanny"
        self.started += [
            self._start("worker", self.address, "--nthreads", "1", "--no-dashboard", nanny)
            for _ in range(2)
        ]

    def whole(self) -> bool:
        processes = [*self.started, self.scheduler]
        return len(processes) == 3 and all(p is not None and p.poll() is None for p in processes)

    def workers(self) -> list[int]:
        """Process numbers of the workers: the nannies' children, where there are nannies."""
        pids = [process.pid for process in self.started]
        if not self.nanny:
            return pids
        found = []
        for pid in pids:
            for path in Path(f"/proc/{pid}/task").glob("*/children"):
                with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has ended
                    found += [int(word) for word in path.read_text().split()]
        return [pid for pid in found if b"spawn_main" in _command_line(pid)]

    def kill(self) -> None:
        """End everything, as a power cut does."""
        workers = self.workers()
        for process in [*self.started, self.scheduler]:
            if process is not None:
                process.kill()
                process.wait()
        for pid in workers:
            with suppress(ProcessLookupError):  # it ended with its nanny
                os.kill(pid, signal.SIGKILL)
        self.started, self.scheduler = [], None


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    processes = Processes(tmp_path_factory.mktemp("dask"))
    try:
        yield processes
    finally:
        processes.kill()


@pytest.fixture
def shared(lasting: Processes) -> Processes:
    """A scheduler and two workers, started anew only where the test before has broken them."""
    if not lasting.whole():
        lasting.kill()
        lasting.start()
    return lasting


@pytest.fixture
def nannies(tmp_path: Path) -> Iterator[Processes]:
    """The same with nannies, which restart workers."""
    processes = Processes(tmp_path, nanny=True)
    try:
        processes.start()
        yield processes
    finally:
        processes.kill()


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
        Truth(problem(), store, Workers(1)).bandwidths(thetas)
    return table(path)


def both_workers(cluster: Cluster) -> None:
    cluster._client.wait_for_workers(2, timeout=60)
    cluster._count()


# ---- results -------------------------------------------------------------------------------------


def test_rows_are_those_of_the_serial_run(shared: Processes, tmp_path: Path) -> None:
    found = []
    for name, pool in (("serial", Workers(1)), ("dask", Cluster(shared.address))):
        with SampleStore(tmp_path / name) as store, pool as workers:
            truth = Truth(problem(), store, workers)
            bandwidths = truth.bandwidths(THETAS)
            quantities = truth.quantities(X)
        bits = [(sample.values.tobytes(), sample.gradients.tobytes()) for sample in quantities]
        found.append((bandwidths, bits, truth.syntheses, table(tmp_path / name)))
    assert found[0] == found[1]
    assert len(found[0][3]["samples"]) > 50


def test_every_task_gives_its_result_once(shared: Processes) -> None:
    with Cluster(shared.address) as cluster:
        both_workers(cluster)
        assert cluster.count == 2
        for tasks in (0, 1, 2, 23):
            found = sorted(cluster.map_unordered(square, range(tasks)))
            assert found == [i * i for i in range(tasks)]
        places = list(cluster.map_unordered(whereabouts, range(12)))
    assert os.getpid() not in {pid for pid, _, _ in places}
    assert {threads for _, _, threads in places} == {1}, "one BLAS thread each"


def test_an_exception_reaches_the_caller(shared: Processes) -> None:
    with Cluster(shared.address) as cluster:
        with pytest.raises(TaskFailure, match="at three") as caught:
            list(cluster.map_unordered(failing, range(40)))
        assert "in a worker process" in caught.value.__notes__[0]
        first = cluster.map_unordered(square, range(5))
        next(first)
        with pytest.raises(RuntimeError, match="busy with another map"):
            next(cluster.map_unordered(square, range(5)))
        first.close()
        assert sorted(cluster.map_unordered(square, [1, 2])) == [1, 4]


def test_a_worker_with_other_numerics_is_refused(
    shared: Processes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "NUMERICS", -1)
    with Cluster(shared.address) as cluster, pytest.raises(UserError, match="same version"):
        list(cluster.map_unordered(square, range(5)))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_tls_by_the_settings_of_dask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import dask
    import distributed  # noqa: F401  # its settings must be there before they are changed

    processes = Processes(tmp_path)
    settings = processes.use_tls()
    try:
        processes.start()
        with dask.config.set(settings), Cluster(processes.address) as cluster:
            assert sorted(cluster.map_unordered(square, range(5))) == [0, 1, 4, 9, 16]
        monkeypatch.setattr(module, "CONNECT_SECONDS", 1.0)
        for address in (processes.address, processes.address.replace("tls", "tcp")):
            with pytest.raises(UserError, match="no Dask scheduler answers there"):
                Cluster(address).__enter__()
    finally:
        processes.kill()


# ---- losses --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_straggler_is_overtaken_and_its_late_answer_ignored(
    shared: Processes, tmp_path: Path
) -> None:
    with Cluster(shared.address, patience=0.3) as cluster:
        both_workers(cluster)
        found = list(cluster.map_unordered(straggles, [(i, str(tmp_path)) for i in range(10)]))
    assert sorted(found) == list(range(10))
    assert (tmp_path / "first").exists(), "both copies have answered"


@pytest.mark.slow
def test_a_frozen_worker_is_overtaken(shared: Processes, tmp_path: Path) -> None:
    try:
        with Cluster(shared.address, patience=0.3) as cluster:
            both_workers(cluster)
            tasks = [(i, str(tmp_path)) for i in range(20)]
            found = list(cluster.map_unordered(freezes_once, tasks))
        assert sorted(found) == list(range(20))
    finally:
        for pid in shared.workers():
            os.kill(pid, signal.SIGCONT)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [3, 30])
def test_killed_workers_lose_no_sample_and_double_none(
    nannies: Processes, tmp_path: Path, kills: int
) -> None:
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
            truth = Truth(problem(), store, cluster)
            while killer.is_alive():
                batches.append(box.uniform(55.0, 70.0, (20, 2)))
                found = truth.bandwidths(batches[-1])
                assert [sample.theta for sample in found] == [tuple(t) for t in batches[-1]]
        finally:
            finished.set()
            killer.join()
    assert len(set(killed)) == kills
    assert len(store.units) == len(set(store.units)) == 20 * len(batches)
    assert table(path) == serial(tmp_path / "serial.sqlite", np.vstack(batches))


@pytest.mark.slow
def test_a_restarted_scheduler_loses_nothing(shared: Processes, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    tasks = [(i, str(gate if i % 2 else tmp_path)) for i in range(20)]
    with Cluster(shared.address) as cluster:
        results = cluster.map_unordered(waits, tasks)
        found = [next(results)]  # the odd ones in flight cannot end
        shared.kill()
        gate.touch()
        shared.start()
        found += results
    assert sorted(found) == list(range(20))


@pytest.mark.slow
def test_a_cluster_that_stays_away_is_told(shared: Processes, tmp_path: Path) -> None:
    tasks = [(i, str(tmp_path / "never")) for i in range(4)]
    with Cluster(shared.address, absence=1.0) as cluster:
        for process in shared.started:
            process.kill()
        with pytest.raises(WorkerLost, match="no worker for 1 s; start `dask worker` again"):
            list(cluster.map_unordered(waits, tasks))
        shared.kill()
        with pytest.raises(WorkerLost, match="no scheduler for 1 s; start `dask scheduler` again"):
            list(cluster.map_unordered(waits, tasks))


@pytest.mark.slow
def test_a_task_that_kills_every_worker_is_told(nannies: Processes) -> None:
    with Cluster(nannies.address) as cluster, pytest.raises(WorkerLost, match="after worker died"):
        list(cluster.map_unordered(dies_at_two, range(8)))


# ---- the command ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_ctrl_c_ends_promptly_and_is_resumable(shared: Processes, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = [*command(folder), "--scheduler", shared.address]
    process = started(words)
    wait_for_rows(process, folder / "samples.sqlite", 20)
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    output, errors = process.communicate(timeout=20)
    assert time.monotonic() - began < 2.0
    assert (process.returncode, output) == (130, "")
    assert len(errors.splitlines()) == 1, errors
    assert errors.startswith("interrupted: what is sampled is kept; the same command resumes")
    kept = table(folder / "samples.sqlite")["samples"]
    assert len(kept) >= 20
    assert solve.main(words[3:]) == 0
    after = table(folder / "samples.sqlite")["samples"]
    # a row may gain its gradients later; what it says of the design stays
    assert {row[:6] for row in kept} <= {row[:6] for row in after}


def told(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr of a command that ends with 2 and leaves nothing behind."""
    code = solve.main([str(TWO_MASS), "--out", str(tmp_path / "o"), "--scheduler", address])
    output, errors = capsys.readouterr()
    assert (code, output, errors.count("\n")) == (2, "", 1), errors
    assert not (tmp_path / "o" / "samples.sqlite").exists()
    return errors


@pytest.mark.parametrize("address", ["", "here", "tcp://127.0.0.1", "127.0.0.1:8786"])
def test_what_is_no_address_is_told(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = told(address, tmp_path, capsys)
    assert words.startswith(f"--scheduler {address}: is no address; give what `dask")


@pytest.mark.parametrize("kind", ["tcp://127.0.0.1:{}", "tcp://127.0.0.1:99999", "carrier://a:{}"])
def test_an_address_where_nothing_answers_is_told(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.3)
    address = kind.format(Processes(tmp_path).port)
    words = told(address, tmp_path, capsys)
    assert re.match(rf"--scheduler {address}: no Dask scheduler answers there \(.+\); start", words)


def test_without_dask_the_remedy_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = told("tcp://127.0.0.1:8786", tmp_path, capsys)
    assert "Dask, which is not installed; run: python -m pip install dask distributed" in words
