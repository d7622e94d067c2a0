"""A plant that ends its process, with whatever exit code, ends no command as if it were done."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from oracles.commands import own_plant

from ccd_casadi.support.options import ExitCode

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")


def started(folder: Path, fault: str) -> "subprocess.Popen[str]":
    """`check` of a plant that takes numbers, and does something else for heavy ones."""
    case = own_plant(folder, 100.0)
    text = (folder / "plant.py").read_text()
    line = f"    total = float(total)\n    if total > 124:\n        {fault}\n    return"
    (folder / "plant.py").write_text(f"import ctypes, time\n{text.replace('    return', line)}")
    words = [sys.executable, "-m", "ccd_casadi.check", str(case)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("fault", "said"),
    [("ctypes.CDLL(None)._exit(0)", "exit code 0"), ("ctypes.CDLL(None).exit(4)", "exit code 4"),
     ("ctypes.string_at(0)", "SIGSEGV")],
)  # fmt: skip
def test_it_is_bad_input_in_one_sentence(tmp_path: Path, fault: str, said: str) -> None:
    with started(tmp_path, fault) as process:
        out, words = process.communicate(timeout=60)
    assert process.returncode == ExitCode.BAD_INPUT
    assert (
        f"case.toml: plant: its function, or a library that it calls, ended the program ({said}"
        in words
    )
    assert not out


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_to_the_command_ends_what_computes(tmp_path: Path, number: signal.Signals) -> None:
    """Else the file would go on growing."""
    alive = tmp_path / "alive"
    fault = f"[(open({str(alive)!r}, 'a').write('.'), time.sleep(0.05)) for _ in range(1000)]"
    with started(tmp_path, fault) as process:
        while not alive.exists():
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(20) == -number
    time.sleep(0.3)
    size = alive.stat().st_size
    time.sleep(0.3)
    assert alive.stat().st_size == size
