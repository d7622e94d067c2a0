"""What the explorer does beside its page: solves as commands, work in a process of its own."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from queue import Queue
from types import SimpleNamespace

from bokeh.document import Document
from oracles.case_documents import QUICK_SECTIONS

from ccd_casadi.cases.case import load_case
from ccd_casadi.extensions.explorer.page import ExplorerPage
from ccd_casadi.extensions.explorer.pins import Kept
from ccd_casadi.extensions.explorer.session import Background, Session, Solve
from ccd_casadi.support.options import ExitCode
from ccd_casadi.support.worker_process import WorkerLost


def test_a_solve_reports_its_lines_and_how_it_ended(tmp_path):
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


def told_and_done(task: int, log: Callable[[str], None]) -> int:
    """Work of a background that tells twice; 0 fails, and a negative number ends its process."""
    for words in ("begun", "nearly done"):
        log(words)
    if task < 0:
        os._exit(3)
    return 6 // task


def test_the_background_reports_answers_and_outlives_the_death_of_its_process() -> None:
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


def test_a_design_that_failed_can_be_started_again(tmp_path: Path) -> None:
    """The button stayed disabled until a slider moved."""
    failed: list[Callable[[BaseException], None]] = []
    background = SimpleNamespace(answer=lambda design, then, otherwise: failed.append(otherwise))
    (tmp_path / "case.toml").write_text(QUICK_SECTIONS)
    session = Session(load_case(tmp_path / "case.toml"), tmp_path)
    page = ExplorerPage(Document(), session, background, (), False, Kept())  # type: ignore[arg-type]
    before = set(page.document.session_callbacks)
    page.waits_for(None)  # type: ignore[arg-type]
    assert page.design.disabled
    failed[0](ValueError("no such plant"))
    for made in set(page.document.session_callbacks) - before:
        made.callback()
    session.store.close()
    assert not page.design.disabled
    assert "no such plant" in page.note.text
