"""What the explorer does beside its page: solves as commands, work in a process of its own."""

import os
import threading
from collections.abc import Callable
from queue import Queue

from ccd_casadi.extensions.explorer.known_plant import Background, Solve
from ccd_casadi.support.options import ExitCode
from ccd_casadi.support.worker_process import WorkerLost


def test_a_solve_tells_its_lines_and_how_it_ended(tmp_path):
    said, codes, over = [], [], threading.Event()

    def ended(code):
        codes.append(code)
        over.set()

    solve = Solve(tmp_path / "none.toml", tmp_path / "out", ["--workers", "1"], said.append, ended)
    assert over.wait(300.0)
    assert codes == [2]
    assert "none.toml: there is no such file" in said[0]
    assert "not verified" in ExitCode(4).words
    solve.stop()  # there is nothing left to stop


def told_and_done(task: int, tell: Callable[[str], None]) -> int:
    """Work of a background that tells twice; 0 fails, and a negative number ends its process."""
    for words in ("begun", "nearly done"):
        tell(words)
    if task < 0:
        os._exit(3)
    return 6 // task


def test_the_background_tells_answers_and_outlives_the_death_of_its_process() -> None:
    heard: list[str] = []
    came: Queue[object] = Queue()
    background = Background()
    for task in (2, 0, -1, 3):
        background.answer(background.ask(told_and_done, task, heard.append), came.put, came.put)
    first, failed, lost, last = (came.get(timeout=60.0) for _ in range(4))
    background.close()
    assert (first, last) == (3, 2)
    assert (type(failed), type(lost)) == (ZeroDivisionError, WorkerLost)
    assert heard == ["begun", "nearly done"] * 4
