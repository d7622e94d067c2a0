"""Calls that never return are ended, and the next one is served."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ccd_casadi.support.errors import UserError
from ccd_casadi.support.worker_process import Overrun, Runner


def fail(message: str) -> None:
    raise UserError(message)


def test_results_errors_overruns_and_deaths() -> None:
    with Runner() as runner:
        assert runner.call(60.0, divmod, 7, 2) == (3, 1)
        with pytest.raises(UserError, match="what is wrong"):
            runner.call(60.0, fail, "what is wrong")
        first = runner.call(60.0, os.getpid)
        began = time.monotonic()
        with pytest.raises(Overrun, match=r"within 0\.2 s"):
            runner.call(0.2, time.sleep, 3600.0)
        assert time.monotonic() - began < 3000.0
        with pytest.raises(ProcessLookupError):
            os.kill(first, 0)
        with pytest.raises(Overrun, match="died"):
            runner.call(60.0, os._exit, 3)
        last = runner.call(60.0, os.getpid)
        assert last not in (first, os.getpid())
    with pytest.raises(ProcessLookupError):
        os.kill(last, 0)


LOOP = """
import os
import sys
from pathlib import Path
from ccd_casadi.support.worker_process import Runner

def forever(path):
    Path(path).write_text(str(os.getpid()))
    while True:
        pass

if __name__ == "__main__":
    with Runner() as runner:
        runner.call(5.0, forever, sys.argv[1])
"""


@pytest.mark.slow
def test_what_loops_ends_after_its_parent_was_killed(tmp_path: Path) -> None:
    script, note = tmp_path / "loop.py", tmp_path / "pid"
    script.write_text(LOOP)
    parent = subprocess.Popen([sys.executable, str(script), str(note)])
    while not note.exists() or not note.read_text():
        time.sleep(0.01)
    child = int(note.read_text())
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    for _ in range(6000):
        status = Path(f"/proc/{child}/stat")
        if not status.exists() or status.read_text().rsplit(")")[1].split()[0] == "Z":
            return
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    pytest.fail("it still runs")
