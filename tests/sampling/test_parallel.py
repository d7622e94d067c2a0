"""The pool of workers: every result once, errors told, no process left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from oracles.busy import HANGS

from ccd_casadi.support import worker_process
from ccd_casadi.support.options import usable_cores
from ccd_casadi.support.process_pool import LentWorkers, Workers
from ccd_casadi.support.worker_process import THREADS, Overrun, Runner, WorkerLost, import_ahead

HERE = Path(__file__).parent


# ---- tasks, imported by the worker processes -----------------------------------------------------


def square(value: int) -> int:
    return value * value


def whereabouts(_: int) -> tuple[int, dict[str, str | None], int]:
    import numpy  # noqa: F401
    from threadpoolctl import threadpool_info

    blas = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    return os.getpid(), {name: os.environ.get(name) for name in THREADS}, max(blas)


class TaskFailure(Exception):
    pass


def failing(value: int) -> int:
    if value == 3:
        raise TaskFailure("at three")
    return value


def dies_once(task: tuple[int, str]) -> int:
    value, mark = task
    if value == 4 and not os.path.exists(mark):
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def dies(value: int) -> int:
    if value == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def pid_and_sleep(task: tuple[str, float]) -> None:
    folder, seconds = task
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(seconds)


def where(task: tuple[int, str, bool]) -> tuple[int, int]:
    """A number and its process; one that is not the owner's dies once, where it is to."""
    value, owner, dying = task
    mark = Path(owner)
    if dying and str(os.getpid()) != mark.read_text():
        mark.with_suffix(".died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value, os.getpid()


def maps_itself(task: tuple[str, bool, int]) -> set[int]:
    """The processes of maps inside a task, made until another one helps."""
    folder, dying, last = task
    owner = Path(folder) / f"owner {last}"
    owner.write_text(str(os.getpid()))
    limit, pids = time.monotonic() + HANGS, set[int]()
    while last and len(pids) < 2 and not owner.with_suffix(".died").exists():
        assert time.monotonic() < limit
        tasks = [(i, str(owner), dying) for i in range(3)]
        found = list(LentWorkers().map_unordered(where, tasks))
        assert sorted(value for value, _ in found) == [0, 1, 2]
        pids |= {pid for _, pid in found}
    return pids


@pytest.fixture(params=["spawned", "forked"])
def started(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that import for themselves, and those of a server that has imported."""
    monkeypatch.setattr(worker_process, "_contexts", worker_process._contexts[:1])
    if request.param == "forked":
        import_ahead(["numpy"])
        assert len(worker_process._contexts) == 1 + sys.platform.startswith("linux")


# ---- results -------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("tasks", [0, 1, 2, 23])
def test_every_task_gives_its_result_once(count: int, tasks: int) -> None:
    with Workers(count) as workers:
        found = sorted(workers.map_unordered(square, range(tasks)))
        again = sorted(workers.map_unordered(square, range(tasks)))
    assert found == again == [i * i for i in range(tasks)]


@pytest.mark.usefixtures("started")
def test_workers_are_other_processes_with_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    before = dict(os.environ)
    with Workers(2) as workers:
        found = list(workers.map_unordered(whereabouts, range(12)))
    assert dict(os.environ) == before
    pids = {pid for pid, _, _ in found}
    assert os.getpid() not in pids
    assert len(pids) <= 2
    assert all(environment == dict.fromkeys(THREADS, "1") for _, environment, _ in found)
    assert {threads for _, _, threads in found} == {1}


def test_one_worker_is_this_process() -> None:
    with Workers(1) as workers:
        assert {pid for pid, _, _ in workers.map_unordered(whereabouts, range(3))} == {os.getpid()}
    with Workers(0) as workers:
        assert (workers.count, list(workers.map_unordered(square, [3]))) == (1, [9])


def test_patience_keeps_short_work_in_this_process() -> None:
    with Workers(2, patience=60.0) as workers:
        found = list(workers.map_unordered(whereabouts, range(6)))
    assert [pid for pid, _, _ in found] == [os.getpid()] * 6


def test_beyond_patience_the_rest_goes_to_processes(tmp_path: Path) -> None:
    tasks = [(str(tmp_path), 0.05)] * 8
    with Workers(2, patience=0.01) as workers:
        assert list(workers.map_unordered(pid_and_sleep, tasks)) == [None] * 8
    pids = {int(path.name) for path in tmp_path.iterdir()}
    assert os.getpid() in pids, "the first task is timed here"
    assert len(pids) >= 2, "what would take longer than the patience is spread"


def test_usable_cores_are_those_that_we_may_use() -> None:
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


# ---- failures ------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
def test_an_exception_reaches_the_caller(count: int) -> None:
    with Workers(count) as workers:
        found: list[int] = []
        with pytest.raises(TaskFailure, match="at three"):
            found.extend(workers.map_unordered(failing, range(40)))
        # how many others end before the news of it arrives is up to the machine
        assert set(found) <= set(range(40)) - {3}
        # and the workers are still of use
        assert sorted(workers.map_unordered(square, [1, 2])) == [1, 4]


@pytest.mark.usefixtures("started")
def test_the_task_of_a_killed_worker_is_tried_again(tmp_path: Path) -> None:
    mark = str(tmp_path / "died")
    with Workers(2) as workers:
        found = list(workers.map_unordered(dies_once, [(i, mark) for i in range(10)]))
    assert os.path.exists(mark)
    assert sorted(found) == list(range(10))


def test_equal_tasks_are_not_taken_for_the_same(tmp_path: Path) -> None:
    """Both fours are in flight when one of them kills its worker."""
    mark = str(tmp_path / "died")
    tasks = [(4, mark)] * 4
    with Workers(2) as workers:
        assert list(workers.map_unordered(dies_once, tasks)) == [4] * 4


@pytest.mark.usefixtures("started")
def test_a_task_that_kills_twice_is_reported() -> None:
    with Workers(2) as workers, pytest.raises(WorkerLost, match="died twice") as caught:
        list(workers.map_unordered(dies, range(8)))
    assert len(str(caught.value)) < 400
    assert workers._workers == []


@pytest.mark.usefixtures("started")
def test_a_call_in_a_process_of_its_own_gives_its_result_or_what_went_wrong() -> None:
    with Runner() as runner:
        assert runner.call(60.0, square, 3) == 9
        with pytest.raises(TaskFailure, match="at three"):
            runner.call(60.0, failing, 3)
        with pytest.raises(Overrun, match="died"):
            runner.call(60.0, os._exit, 3)
        assert runner.call(60.0, square, 2) == 4


@pytest.mark.parametrize("dying", [False, True])
def test_an_idle_worker_helps_with_what_a_task_maps_over(tmp_path: Path, dying: bool) -> None:
    """And where the helper dies the task is done by whom it helped."""
    with Workers(2) as workers:
        tasks = [(str(tmp_path), dying, last) for last in (0, 1)]
        found = list(workers.map_unordered(maps_itself, tasks))
        assert max(map(len, found)) == (1 if dying else 2)
        assert (tmp_path / "owner 1.died").exists() == dying
        assert sorted(workers.map_unordered(square, [1, 2, 3])) == [1, 4, 9]


def test_an_abandoned_map_leaves_no_process() -> None:
    with Workers(2) as workers:
        results = workers.map_unordered(whereabouts, range(20))
        pids = {next(results)[0] for _ in range(8)}
    results.close()
    assert pids
    assert ended(pids)


# ---- ends ----------------------------------------------------------------------------------------


def alive(pid: int) -> bool:
    """Whether a process still runs; a zombie does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def ended(pids: set[int], seconds: float = HANGS) -> bool:
    """Whether all of the processes end in time."""
    return until(lambda: not any(map(alive, pids)), seconds)


def until(condition: Callable[[], bool], seconds: float) -> bool:
    limit = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > limit:
            return False
        time.sleep(0.02)
    return True


PARENT = f"""
import sys
sys.path[:0] = {[str(HERE), str(HERE.parent)]!r}
import ccd_casadi.solve  # as the command does: workers import it as they start
from ccd_casadi.support.command_line import parser, run
from ccd_casadi.support.errors import exit_on_ctrl_c
from ccd_casadi.support.process_pool import Workers
from test_parallel import pid_and_sleep

def main(options):
    with Workers(2) as workers:
        list(workers.map_unordered(pid_and_sleep, [(str(options.out), {2.0 * HANGS})] * 8))

if __name__ == "__main__":
    exit_on_ctrl_c()
    ahead = ["ccd_casadi.sampling.inner_samples"] if "--seed" in sys.argv else []
    sys.exit(run(main, parser("parent", ""), early=lambda options: ahead))
"""


def parent(tmp_path: Path, forked: bool = False) -> subprocess.Popen[str]:
    """A command that waits for its workers; those are `forked` or spawned."""
    script, folder = tmp_path / "parent.py", tmp_path / "pids"
    script.write_text(PARENT)
    folder.mkdir()
    return subprocess.Popen(
        [sys.executable, str(script), "--out", str(folder), *["--seed", "1"] * forked],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def children(tmp_path: Path) -> set[int]:
    """The workers' process numbers, once both are at work."""
    folder = tmp_path / "pids"
    assert until(lambda: len(list(folder.iterdir())) == 2, HANGS)
    return {int(path.name) for path in folder.iterdir()}


@pytest.mark.parametrize("forked", [False, True], ids=["spawned", "forked"])
@pytest.mark.parametrize("whole_group", [True, False], ids=["terminal", "parent-only"])
def test_ctrl_c_ends_promptly_and_leaves_no_orphan(
    tmp_path: Path, whole_group: bool, forked: bool
) -> None:
    """A terminal sends SIGINT to every process of the group, `kill -INT` to one."""
    process = parent(tmp_path, forked)
    pids = children(tmp_path)
    assert all(map(alive, pids))
    if whole_group:
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=HANGS)  # the tasks at work sleep for longer
    assert process.returncode == 130
    assert len(errors.splitlines()) == 1
    assert "the same command resumes from there" in errors
    assert ended(pids)


@pytest.mark.parametrize(
    "delay", [0.0, 0.2, *(pytest.param(d, marks=pytest.mark.slow) for d in (0.1, 0.3, 0.4))]
)
@pytest.mark.parametrize("forked", [False, True], ids=["spawned", "forked"])
def test_ctrl_c_while_the_workers_start_is_quiet(
    tmp_path: Path, delay: float, forked: bool
) -> None:
    process = parent(tmp_path, forked)
    # Until `run` is entered Python itself ends the process, with its own words.
    started = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    assert until(lambda: len(started.read_text().split()) >= 2, HANGS)  # tracker and a worker
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=HANGS)
    assert process.returncode == 130
    assert len(errors.splitlines()) == 1, errors


@pytest.mark.parametrize(
    "kind", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("forked", [False, True], ids=["spawned", "forked"])
def test_workers_end_with_a_killed_parent(
    tmp_path: Path, kind: signal.Signals, forked: bool
) -> None:
    process = parent(tmp_path, forked)
    pids = children(tmp_path)
    assert all(map(alive, pids))
    process.send_signal(kind)
    process.communicate(timeout=HANGS)
    assert process.returncode == -kind
    assert ended(pids)
