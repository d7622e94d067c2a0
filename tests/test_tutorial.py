"""The tutorial followed literally: every file written, every command run, every figure compared."""

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def same(shown: str, printed: str) -> bool:
    """Whether a printed line begins as the shown one, numbers to 0.2 %."""
    if NUMBER.sub("#", printed)[: len(NUMBER.sub("#", shown))] != NUMBER.sub("#", shown):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=False)
    return all(float(a) == pytest.approx(float(b), rel=2e-3, abs=1e-9) for a, b in pairs)


def commands(block: str) -> list[tuple[str, list[str]]]:
    """Each command of a console block with the lines shown under it."""
    found: list[tuple[str, list[str]]] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif line != "...":
            found[-1][1].append(line)
    return found


def test_comparison_of_lines_can_fail() -> None:
    assert same("bandwidth     85.9878 Hz", "bandwidth     85.9 Hz   predicted 1 Hz")
    assert not same("bandwidth     85.9878 Hz", "bandwidth     85.5 Hz")
    assert not same("status        verified", "status        not_verified")


@pytest.mark.parametrize(
    ("stage", "count"),
    [("my_stage", 5), pytest.param("my_robust", 2, marks=pytest.mark.slow)],
)
def test_every_command_gives_what_the_page_shows(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    stage: str,
    count: int,
) -> None:
    """The commands on one of the page's two cases; together they are all of them.

    In this process: what starts a command, `test_start` tests.
    """
    monkeypatch.chdir(tmp_path)
    ran = others = 0
    for kind, title, body in BLOCK.findall(PAGE.read_text()):
        if title:
            (tmp_path / title).write_text(body)
        if kind != "console":
            continue
        for command, shown in commands(body):
            python, option, module, *words = command.split()
            assert (python, option) == ("python", "-m")
            if stage not in command:
                others += 1
                continue
            code = import_module(module).main([*words, "--workers", "1"])
            told = capsys.readouterr()
            assert code == 0, f"{command}: {told.err}"
            printed = iter(told.out.splitlines())
            for line in shown:
                assert any(same(line, other) for other in printed), f"{command}: no line {line!r}"
            ran += 1
    assert (ran, ran + others) == (count, 7)
    pages = {
        "my_stage": ("my_stage/report.html", "my_stage/insight.html"),
        "my_robust": ("my_robust/deploy/report.html",),
    }
    for page in pages[stage]:
        assert (tmp_path / page).exists()
