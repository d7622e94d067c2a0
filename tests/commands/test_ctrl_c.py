"""Ctrl-C while a command is still importing: one line, exit 130, nothing written."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from ccd_casadi.support.errors import ctrl_c_noticed, interrupts_kept, raise_dropped, was_ctrl_c

ROOT = Path(__file__).parents[2]
# Imported by every command after our own package, and long before `main`.
SLOW_IMPORT = """
import os, signal
os.kill(os.getpid(), signal.SIGINT)
raise ImportError("Ctrl-C was not dealt with at once")
"""


@pytest.mark.parametrize(
    "command", ["ccd_casadi.solve x", "ccd_casadi.inner x --theta m=1", "surrogates.retrain x"]
)
def test_ctrl_c_during_imports_is_one_line(tmp_path: Path, command: str) -> None:
    (tmp_path / "casadi.py").write_text(SLOW_IMPORT)
    done = subprocess.run(
        [sys.executable, "-m", *command.split()],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "interrupted before anything was begun\n"


def test_a_library_leaves_ctrl_c_alone() -> None:
    words = (
        "import ccd_casadi.cases.case, surrogates, signal; print(signal.getsignal(signal.SIGINT))"
    )
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True, cwd=ROOT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert "default_int_handler" in done.stdout


def test_what_stumbles_over_a_dropped_ctrl_c_counts_as_one() -> None:
    """Compiled libraries drop the interrupt, and fail later by what it left undone."""
    with ctrl_c_noticed():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("not interrupted")
        error = ValueError("what it left undone")
    assert was_ctrl_c(error)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with ctrl_c_noticed():
        pass
    assert not was_ctrl_c(error), "an earlier command's Ctrl-C is not an excuse for the next"
    assert was_ctrl_c(KeyboardInterrupt())


def test_a_dropped_ctrl_c_is_raised_at_the_next_step() -> None:
    with ctrl_c_noticed():
        raise_dropped()  # none has come
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            raise_dropped()
    raise_dropped()  # a command's own, not for who comes later


def test_a_held_ctrl_c_comes_also_where_the_block_fails() -> None:
    def asked_to_end() -> None:
        with interrupts_kept():
            signal.raise_signal(signal.SIGINT)
            raise RuntimeError("the solver was asked to end")

    with pytest.raises(KeyboardInterrupt):
        asked_to_end()
