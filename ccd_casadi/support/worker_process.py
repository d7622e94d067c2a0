"""One worker process: spawned, with one BLAS thread, answering tasks through a pipe of its own.

Nothing is shared, so a worker may be killed at any moment and its death concerns the one task that
it held. What goes through the pipe is pickled, which is how Python's processes speak: it comes from
processes that this one started, and is never stored.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, resource_tracker
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_SPAWN = multiprocessing.get_context("spawn")  # a fork would copy locks that threads hold


class WorkerLost(RuntimeError):
    """Workers died again and again on one task (killed, or out of memory), or never came back."""


class WorkerProcess:
    """One spawned process and the parent's end of its pipe."""

    def __init__(self) -> None:
        self.pipe, theirs = _SPAWN.Pipe()
        # A daemon: it is ended at exit even where the pool was not left properly.
        self.process = _SPAWN.Process(target=_serve, args=(theirs,), daemon=True)
        with _one_thread_each():
            self.process.start()
        theirs.close()  # the process holds it alone: its death is an end of file here

    def send(self, message: bytes) -> None:
        with suppress(OSError):  # it is dead: its answer will say so
            self.pipe.send_bytes(message)

    def answer(self) -> bytes | None:
        """What the process sent; None where it died."""
        try:
            return self.pipe.recv_bytes()
        except (EOFError, OSError):
            return None

    def end(self) -> None:
        """Kill it, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.process.close()
        self.pipe.close()

    def exit_code(self) -> int | None:
        self.process.join(1.0)
        return self.process.exitcode


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """An environment for processes to inherit: NumPy and Numba read it as they are imported."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def track_resources() -> None:
    """Start what multiprocessing starts by itself later, unblocking SIGINT; Windows has none."""
    if os.name == "posix":
        resource_tracker.ensure_running()


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C comes at the end of the block; processes started in it are born with it blocked.

    Windows cannot hold it: there the block runs as it is.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: connection.Connection) -> None:
    """A worker's life: answer tasks until the pipe or the parent ends."""
    become_worker()
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(answered(pipe.recv_bytes()))


def answered(message: bytes) -> bytes:
    """The pickled (True, result) or (False, exception) of a pickled (function, task)."""
    try:
        function, task = pickle.loads(message)  # of the parent, through our pipe
        return pickle.dumps((True, function(task)))
    except BaseException as error:
        text = "".join(traceback.format_exception(error))
        error.add_note(f"in a worker process:\n{text}")
        try:
            answer = pickle.dumps((False, error))
            pickle.loads(answer)  # some exceptions pickle but cannot be made again
            return answer
        except Exception:
            return pickle.dumps((False, RuntimeError(text)))


def become_worker() -> None:
    """Leave Ctrl-C to the parent and end as soon as it has ended, even by SIGKILL in mid-task."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent: Any = multiprocessing.parent_process()

    def leave() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=leave, daemon=True).start()
