"""What a command leaves on the screen of a terminal of a given width."""

import fcntl
import os
import pty
import struct
import sys
import termios

import pytest

import ccd_casadi
from ccd_casadi.support.terminal import Progress, colour_line, wrap


def on_screen(columns: int, *words: str) -> list[str]:
    """The lines that a command leaves on a terminal: what was written over is gone."""
    child, terminal = pty.fork()
    if child == 0:
        os.environ["PYTHONUTF8"] = "1"
        fcntl.ioctl(0, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
        os.execv(sys.executable, [sys.executable, "-m", "ccd_casadi", *words])
    written = b""
    try:
        while part := os.read(terminal, 65536):
            written += part
    except OSError:  # Linux says so where the other side is closed
        pass
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    lines = written.decode().replace("\r\n", "\n").split("\n")
    return [line.split("\r")[-1].replace("\x1b[2K", "") for line in lines]


@pytest.mark.parametrize("columns", [60, pytest.param(80, marks=pytest.mark.slow)])
def test_an_answer_is_wrapped_to_the_terminal(columns: int) -> None:
    """Lines break between words, paths are whole, and no bar stays on a line of the answer."""
    case = str(ccd_casadi.TWO_MASS)
    lines = on_screen(columns, "check", case)
    reported = [line for line in lines if case not in line and "compiling" not in line]
    assert max(map(len, reported)) <= columns
    assert any(case in line for line in lines)
    assert any(line.startswith("plant         two_mass: 1 input") for line in lines)
    ends = [line for line in lines if line.startswith("checking the plant")]
    assert len(ends) == 1
    assert "left" not in ends[0]


@pytest.mark.slow
def test_the_table_of_back_ends_holds_80_characters() -> None:
    at = ["--theta", "m1=60,m2=60", "--omega-s-hz", "900", "--omega-t-hz", "25"]
    lines = on_screen(80, "cross_check", str(ccd_casadi.TWO_MASS), *at)
    row = next(line for line in lines if line.startswith("one Riccati (ours)"))
    assert row.endswith("  certified")
    assert max(map(len, lines)) <= 80


def test_a_line_goes_on_under_its_words() -> None:
    line = "survives      warned   stable for resonances -0.76 to +7.9 %, less than +-2 %"
    broken = wrap(line, 50).split("\n")
    assert all(part.startswith(" " * 23) for part in broken[1:])
    assert " ".join(" ".join(broken).split()) == " ".join(line.split())


def test_the_state_of_a_line_has_its_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert colour_line("survives      warned   so") == "survives      \x1b[33mwarned\x1b[0m   so"
    monkeypatch.setenv("NO_COLOR", "1")
    assert colour_line("survives      warned   stable") == "survives      warned   stable"


def test_work_that_ends_early_ends_its_bar(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(126, "worst hardware") as bar:
        bar.advance(9)
    with Progress(1, "verifying") as bar:
        bar.advance()
    assert "9/9" in capsys.readouterr().err.splitlines()[-1]
