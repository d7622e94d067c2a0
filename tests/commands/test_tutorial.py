"""Tutorial and page of the paper's kind followed literally: files, commands, figures compared."""

import re
from importlib import import_module
from pathlib import Path

import pytest
from oracles.sources import ROOT, files_of

TUTORIAL, NOMINAL = (ROOT / "docs" / f"{name}.md" for name in ("tutorial", "mixed_sensitivity"))
BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = {
    "my_stage": ("my_stage/report.html", "my_stage/robustness.html", "my_stage/deploy/report.html"),
    "my_nominal": ("my_nominal/report.html", "my_nominal/insight.html"),
    "my_robust": ("my_robust/report.html",),
}  # what the commands on a stage leave behind
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def same(shown: str, printed: str) -> bool:
    """Whether a printed line begins as the shown one, numbers to 0.2 %."""
    if NUMBER.sub("#", printed)[: len(NUMBER.sub("#", shown))] != NUMBER.sub("#", shown):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=False)
    return all(float(a) == pytest.approx(float(b), rel=2e-3, abs=1e-12) for a, b in pairs)


def commands(block: str) -> list[tuple[str, list[str]]]:
    """Each command of a console block with the lines shown under it."""
    found: list[tuple[str, list[str]]] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif line != "...":
            found[-1][1].append(line)
    return found


def commands_of(page: Path) -> list[tuple[str, list[str]]]:
    """All commands of a page, in its order."""
    blocks = BLOCK.findall(page.read_text())
    return [each for kind, _, body in blocks if kind == "console" for each in commands(body)]


def test_comparison_of_lines_can_fail() -> None:
    assert same("bandwidth     85.9878 Hz", "bandwidth     85.9 Hz   predicted 1 Hz")
    assert not same("bandwidth     85.9878 Hz", "bandwidth     85.5 Hz")
    assert not same("status        verified", "status        not_verified")


@pytest.mark.parametrize(
    ("page", "wanted", "count", "but"),
    [
        (TUTORIAL, "ccd_casadi.check", 1, ""),
        pytest.param(TUTORIAL, "my_stage", 5, "", marks=pytest.mark.slow),
        (NOMINAL, "my_nominal", 3, "insight robustness"),  # these are as dear as the three
        pytest.param(NOMINAL, "my_nominal", 5, "", marks=pytest.mark.slow),
        pytest.param(NOMINAL, "my_robust", 1, "", marks=pytest.mark.slow),
    ],
)
def test_every_command_gives_what_the_page_shows(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    page: Path,
    wanted: str,
    count: int,
    but: str,
) -> None:
    """The commands of a page with a word in them `but` for some; together they are all of them.

    In this process: what starts a command, `test_start` tests.
    """
    monkeypatch.chdir(tmp_path)
    for title, body in (files_of(TUTORIAL) | files_of(page)).items():
        (tmp_path / title).write_text(body)
    ran = 0
    for command, shown in commands_of(page):
        python, option, module, *words = command.split()
        assert (python, option) == ("python", "-m")
        if wanted not in command or module.removeprefix("ccd_casadi.") in but.split():
            continue
        code = import_module(module).main([*words, "--workers", "1"])
        reported = capsys.readouterr()
        assert code == 0, f"{command}: {reported.err}"
        printed = iter(reported.out.splitlines())
        for line in shown:
            assert any(same(line, other) for other in printed), f"{command}: no line {line!r}"
        ran += 1
    assert ran == count
    for place in PAGES.get(wanted, ()):
        if Path(place).stem in but.split():
            continue
        assert (tmp_path / place).exists()


def test_no_command_is_left_out() -> None:
    for page, count in ((TUTORIAL, 5), (NOMINAL, 6)):
        found = [command for command, _ in commands_of(page)]
        assert len(found) == count
        assert all(any(f" {stage}" in command for stage in PAGES) for command in found)
