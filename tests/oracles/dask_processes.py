"""A Dask scheduler and two workers as a user starts them, to be used, frozen and killed."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from ccd_casadi.extensions.cluster.dask_pool import Cluster

TESTS = Path(__file__).parents[1]


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
            "PYTHONPATH": os.pathsep.join(map(str, [*TESTS.iterdir(), TESTS, TESTS.parent])),
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

    def answers(self) -> None:
        """Wait until the scheduler does: on a busy machine its imports take long."""
        assert self.scheduler is not None
        while self.scheduler.poll() is None:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=1.0):
                return
            time.sleep(0.1)

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


def both_workers(cluster: Cluster) -> None:
    cluster._client.wait_for_workers(2, timeout=60)
    cluster._count_workers()
