"""Worker processes with one BLAS thread each, and threads for work that releases Python's lock."""

import math
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ContextDecorator, contextmanager, suppress
from contextvars import copy_context
from functools import cache
from multiprocessing import connection, resource_tracker
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor


T = TypeVar("T")
R = TypeVar("R")

_permitted = [1]
_here = threading.local()


class _OneBlasThread(ContextDecorator):
    """The limit is the process's: the first to come sets it, and the last to go lifts it."""

    def __init__(self) -> None:
        self._lock, self._inside, self._modules = threading.Lock(), 0, 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                # libraries come with modules; to search them takes 6 ms, a synthesis 10
                if self._modules != len(sys.modules):
                    self._libraries = ThreadpoolController()
                    self._modules = len(sys.modules)
                self._limits = self._libraries.limit(limits=1)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limits.restore_original_limits()


# Around what computes: matrices are small, and results must not depend on the number of cores.
one_blas_thread = _OneBlasThread()


class OwnThreads(Generic[T]):
    """An object that the thread which made it must free, as SciPy's SuperLU: another leaks it.

    Objects that other threads drop are freed when the thread makes its next one.

    Parameters
    ----------
    make : callable
        Makes the object.

    Attributes
    ----------
    value
        The object.
    """

    def __init__(self, make: Callable[[], T]) -> None:
        if not hasattr(_here, "let_go"):
            _here.let_go = deque()
        self._let_go: deque[T] = _here.let_go
        self._let_go.clear()
        self.value = make()

    def __del__(self) -> None:
        if getattr(_here, "let_go", None) is not self._let_go and hasattr(self, "value"):
            self._let_go.append(self.value)


@contextmanager
def threads_permitted(count: int) -> Iterator[None]:
    """Let `side_by_side` use up to `count` threads in this process."""
    _permitted.append(max(1, count))
    try:
        yield
    finally:
        _permitted.pop()


_BESIDE = "side_by_side"  # begins the names of these threads


@cache
def _threads(count: int) -> "ThreadPoolExecutor":
    """They last: what a thread made it may have to free."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(count, _BESIDE)


def side_by_side(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Evaluate [function(item), ...] in threads, in the items' order: give the longest ones first.

    From within `function` it evaluates them one after the other: no thread waits for another.

    Parameters
    ----------
    function : callable
    items : iterable

    Returns
    -------
    list

    Examples
    --------
    >>> with threads_permitted(2):
    ...     side_by_side(abs, [-3, 2, -1])
    [3, 2, 1]
    """
    todo = list(items)
    count = min(_permitted[-1], len(todo))
    if count <= 1 or threading.current_thread().name.startswith(_BESIDE):
        return [function(item) for item in todo]
    return list(_threads(count).map(function, todo))


def alongside(function: Callable[[], R]) -> Callable[[], R]:
    """Start a function in a thread.

    For work that processes do: two that compute in this process share one lock. Nothing waits for
    the thread where its result is not needed any more, as after Ctrl-C.

    Parameters
    ----------
    function : callable

    Returns
    -------
    callable
        Waits for the result, or raises the exception of `function`.

    Examples
    --------
    >>> alongside(lambda: 3)()
    3
    """
    from concurrent.futures import Future

    answer: Future[R] = Future()

    def run() -> None:
        try:
            answer.set_result(function())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(None, copy_context().run, "alongside", (run,), daemon=True).start()
    return answer.result


P = ParamSpec("P")

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# The last is how processes are started: spawned, as a fork of this one would copy locks that its
# threads hold, or forked from a server that has no threads.
_contexts: list[Any] = [multiprocessing.get_context("spawn")]


class WorkerLost(RuntimeError):
    """Workers died repeatedly on one task (killed, or out of memory), or never answered."""


class Overrun(RuntimeError):
    """The call did not return within its time, or its process died."""


class WorkerProcess:
    """One process and the parent's end of its pipe.

    Attributes
    ----------
    pipe : multiprocessing.connection.Connection
    process : multiprocessing.Process
    """

    def __init__(self) -> None:
        with interrupts_held(), _one_thread_each():
            self.pipe, theirs = multiprocessing.Pipe()
            # A daemon: it is ended at exit even where the pool was not left properly.
            self.process = _contexts[-1].Process(target=_serve, args=(theirs,), daemon=True)
            self.process.start()
        theirs.close()  # the process holds it alone: its death is an end of file here

    def begin(self, function: Callable[[T], object], task: T) -> None:
        """Let it go on with this task."""
        self.send(pickle.dumps((function, task)))  # where it is dead its answer will say so

    def send(self, message: bytes) -> None:
        """Send a message as it is; nothing where it is dead."""
        with suppress(OSError):
            self.pipe.send_bytes(message)

    def answer(
        self, seconds: float | None = None, reported: Callable[[str], None] = lambda words: None
    ) -> tuple[bool, Any]:
        """Return (True, its result) or (False, its exception); `reported` takes what it reports.

        Raises WorkerLost if the process died, and Overrun after so many seconds without a word.
        """
        try:
            while self.pipe.poll(seconds):
                done, value = pickle.loads(self.pipe.recv_bytes())  # our own child wrote it
                if done is not None:
                    return done, value
                reported(value)
            raise Overrun(f"no answer within {seconds:g} s")
        except (EOFError, OSError):
            self.process.join(1.0)
            code = self.process.exitcode
            raise WorkerLost(f"a worker process died (exit code {code})") from None

    @property
    def processor_seconds(self) -> float:
        """The processor time that it has used up to now, s; 0 where the system does not report
        another process."""
        if not sys.platform.startswith("linux") or self.process.pid is None:
            return 0.0
        with suppress(OSError):
            return time.clock_gettime(~self.process.pid << 3 | 2)  # as clock_getcpuclockid(3) does
        return 0.0

    def end(self) -> None:
        """Kill it, whatever it is doing."""
        with interrupts_held():
            self.process.kill()
            self.process.join()
            self.process.close()
            self.pipe.close()


class Runner(AbstractContextManager["Runner"]):
    """A context manager with one process for calls that may never return.

    The process is killed at its deadline and started again: compiled code that loops cannot be
    interrupted from Python.

    Raises
    ------
    Overrun
        By `call`, after its time, or where the process dies.
    """

    def __init__(self) -> None:
        self._process: WorkerProcess | None = None

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.end()
        self._process = None

    def call(
        self, seconds: float, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """function(*args, **kwargs), in that process; whatever it raises is raised here.

        Raises Overrun after `seconds`, and where the process dies.
        """
        try:
            if self._process is None or not self._process.process.is_alive():
                self.__exit__()
                self._process = WorkerProcess()
                self._process.begin(bool, None)
                self._process.answer(60.0)  # s that the process may take to start
            self._process.begin(_apply, (seconds, function, args, kwargs))
            done, value = self._process.answer(seconds)
        except BaseException as error:  # what it is doing is of no use any more
            self.__exit__()
            if isinstance(error, WorkerLost):
                raise Overrun("the process died") from None
            raise
        if not done:
            raise value
        result: R = value
        return result


def _apply(task: tuple) -> object:
    """The call, and the end of this process should it go on when its parent is gone."""
    seconds, function, args, kwargs = task
    with suppress(ImportError):  # Windows has no such limit: the parent alone ends the process
        import resource

        # Two seconds of processor time beyond the deadline the system ends the process.
        spent = math.ceil(time.process_time() + seconds + 2.0)
        resource.setrlimit(resource.RLIMIT_CPU, (spent, resource.getrlimit(resource.RLIMIT_CPU)[1]))
    return function(*args, **kwargs)


def import_ahead(modules: Sequence[str]) -> None:
    """Let a server import modules, once for all processes that are started from now on, while this
    process goes on. Elsewhere than on Linux they are spawned and import for themselves."""
    if not sys.platform.startswith("linux"):
        return
    from multiprocessing import forkserver

    with suppress(OSError), interrupts_held(), _one_thread_each():  # no place for its socket
        forkserver.set_forkserver_preload(list(modules))
        forkserver.ensure_running()
        _contexts.append(multiprocessing.get_context("forkserver"))


def imported_ahead() -> bool:
    """Whether processes are forked from a server that has imported for them."""
    return len(_contexts) > 1


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


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C comes at the end of the block; processes started in it are born with it blocked.

    Windows cannot hold it: there the block runs as it is.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # else it starts later by itself, and unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_to_parent: list[connection.Connection] = []  # of a worker


def log(words: str) -> None:
    """Report, from within a task, how far it is to the process that waits for its result.

    Parameters
    ----------
    words : str
    """
    for pipe in _to_parent:
        pipe.send_bytes(pickle.dumps((None, words)))


LEND = "lend"  # what a worker answers that lends a task: its number and the pickled task follow
OFFER, BACK = b"offer", b"back:"  # of an idle worker; what a lent task comes to


class Offers:
    """Idle workers that are offered to the task of this worker.

    Attributes
    ----------
    count : int
        Of idle workers.
    back : dict
        Number of a lent task -> its pickled answer; empty where its worker has died.
    """

    def __init__(self) -> None:
        self.count, self.back, self._lent = 0, dict[int, bytes](), 0

    def forget(self) -> None:
        """Those of a task before."""
        self.count, self.back = 0, {}

    def heard(self, message: bytes) -> bool:
        """Whether a message of the parent is no task."""
        if message == OFFER:
            self.count += 1
        elif message.startswith(BACK):
            number, answer = pickle.loads(message[len(BACK) :])  # of the parent
            self.back[number] = answer
        else:
            return False
        return True

    def listen(self, wait: bool = False) -> None:
        """Hear what the parent has said; `wait` for one message at least."""
        for pipe in _to_parent:
            while pipe.poll(None if wait else 0):
                self.heard(pipe.recv_bytes())
                wait = False

    def lend(self, function: Callable[[T], object], task: T) -> int:
        """Give a task to an idle worker; its number."""
        self.count, self._lent = self.count - 1, self._lent + 1
        payload = pickle.dumps((function, task))
        for pipe in _to_parent:
            pipe.send_bytes(pickle.dumps((LEND, (self._lent, payload))))
        return self._lent


offers = Offers()


def _serve(pipe: connection.Connection) -> None:
    """A worker's life: answer tasks until the pipe or the parent ends, even by SIGKILL in mid-task;
    Ctrl-C is the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent: Any = multiprocessing.parent_process()

    def leave() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=leave, daemon=True).start()
    _to_parent.append(pipe)
    with suppress(EOFError, OSError):
        while True:
            message = pipe.recv_bytes()
            if not offers.heard(message):  # one of a task that has ended is of no use
                offers.forget()
                pipe.send_bytes(answer_message(message))


def answer_message(message: bytes) -> bytes:
    """Run a pickled (function, task).

    Parameters
    ----------
    message : bytes

    Returns
    -------
    bytes
        Pickled (True, result) or (False, exception).
    """
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
