"""Threads of one process: what they make is freed, whoever lets it go."""

import gc
import threading
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from ccd_casadi.plants.finite_elements import Pencil, build_pencil
from ccd_casadi.support.worker_process import OwnThreads, alongside, side_by_side, threads_permitted

PAGE = 4096  # bytes, at least


class Made:
    """Notes where it was made and freed."""

    threads: list[tuple[int, int]]

    def __init__(self) -> None:
        self.maker = threading.get_ident()

    def __del__(self) -> None:
        Made.threads.append((self.maker, threading.get_ident()))


def test_what_a_thread_makes_it_frees_itself() -> None:
    Made.threads = []
    makers = set()
    with threads_permitted(2):
        meet = threading.Barrier(2)

        def make(_: int) -> OwnThreads[Made]:
            meet.wait(30.0)  # one each
            return OwnThreads(Made)

        for _ in range(5):
            found = side_by_side(make, range(2))
            makers |= {item.value.maker for item in found}
            del found  # here, in the main thread
    assert len(makers) == 2, "the threads last"
    assert len(Made.threads) >= 8  # all but the last of each
    assert all(maker == freed for maker, freed in Made.threads)


def test_what_its_own_thread_lets_go_is_freed_at_once() -> None:
    Made.threads = []
    del OwnThreads(Made).value
    OwnThreads(Made)
    assert len(Made.threads) == 2


def test_threads_inside_threads_do_not_wait_for_each_other() -> None:
    with threads_permitted(2):
        meet = threading.Barrier(2)

        def outer(i: int) -> list[int]:
            meet.wait(30.0)  # both threads are taken
            return side_by_side(abs, [i, -i])

        whole = alongside(lambda: side_by_side(outer, [1, 2]))
        ended = threading.Thread(target=whole, daemon=True)
        ended.start()
        ended.join(30.0)
        assert not ended.is_alive()
    assert whole() == [[1, 1], [2, 2]]


def resident_pages() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1])


@pytest.mark.slow
def test_factorisations_of_threads_do_not_pile_up() -> None:
    """SciPy's SuperLU frees nothing that another thread made: 12 MB each here, 7 GB in a solve."""
    n = 120
    line = sparse.diags_array([-1.0, 2.1, -1.0], offsets=[-1, 0, 1], shape=(n, n))
    A, M = sparse.csr_matrix(sparse.kronsum(line, line)), sparse.csr_matrix(sparse.eye_array(n * n))

    def factored(_: int) -> Pencil:
        return build_pencil([A], [M], 0.0, np.zeros((n * n, 0)), np.zeros(0))

    with threads_permitted(2):
        held = []
        for _ in range(12):
            side_by_side(factored, range(2))
            gc.collect()
            held.append(PAGE * resident_pages())
    assert max(held[2:]) - held[2] < 60e6


def test_what_runs_alongside_holds_nobody_up() -> None:
    """It has this thread's context, raises here what it raised, and no exit waits for it."""
    context: ContextVar[int] = ContextVar("context")
    context.set(7)
    assert alongside(context.get)() == 7
    with pytest.raises(ZeroDivisionError):
        alongside(lambda: 1 / 0)()
    started, go_on = threading.Event(), threading.Event()

    def waiting() -> bool:
        started.set()
        return go_on.wait(60.0)

    result = alongside(waiting)
    assert started.wait(60.0)
    assert all(one.daemon for one in threading.enumerate() if one.name == "alongside")
    go_on.set()
    assert result()
