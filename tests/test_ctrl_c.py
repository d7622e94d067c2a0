"""Ctrl-C while a command is still importing: one line, exit 130, nothing written."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# Imported by every command after our own package, and long before `main`.
SLOW_IMPORT = """
import os, signal
os.kill(os.getpid(), signal.SIGINT)
raise ImportError("Ctrl-C was not dealt with at once")
"""


@pytest.mark.parametrize("module", ["ccd_casadi.solve", "ccd_casadi.inner", "surrogates.retrain"])
def test_ctrl_c_during_imports_is_one_line(tmp_path: Path, module: str) -> None:
    (tmp_path / "casadi.py").write_text(SLOW_IMPORT)
    done = subprocess.run(
        [sys.executable, "-m", module, "x"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "interrupted before anything was begun\n"


def test_a_library_leaves_ctrl_c_alone() -> None:
    words = "import ccd_casadi.case, surrogates, signal; print(signal.getsignal(signal.SIGINT))"
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True, cwd=ROOT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert "default_int_handler" in done.stdout
