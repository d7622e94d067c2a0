"""Terminal, page and result.json of a run tell one story: generated small runs of every kind.

`benchmarks/oracle.py consistency` runs as many as are asked for; a figure that is changed is found.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from oracles import consistency
from oracles.page_figures import disagreements, page_of, same

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing import paint

SLOW = pytest.mark.slow
# the suite has case study 1, below, and tests/codesign/test_contradictions.py
SEEDS = [pytest.param(seed, marks=SLOW) for seed in (1, 2, 4, 5, 9, 13)]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_run_contradicts_itself_nowhere(seed: int) -> None:
    row = consistency.judged(seed, None)  # what a process adds is that of other tests
    assert "failed" not in row
    assert row["status"] != "infeasible"  # else there is little to compare
    assert row["wrong"] == []


@pytest.fixture
def run(solved: Callable[[str], Path], tmp_path: Path) -> Path:
    """Case study 1, to be changed."""
    return Path(
        shutil.copytree(
            solved("lifted"), tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )


def terminal_of(folder: Path) -> str:
    """What `solve` printed of a run, from its result."""
    from ccd_casadi.reporting.decision import advice
    from ccd_casadi.reporting.facts import loop_lines
    from ccd_casadi.reporting.run_verdict import terminal_lines

    r = json.loads((folder / "result.json").read_text())
    lines = [
        f"decision {advice(r)}", *terminal_lines(r), f"objective {r['objective']:.4f} ",
        f"bandwidth {r['bandwidth_hz']:.4f} Hz", f"cost {r['syntheses']} syntheses",
        f"sensitivity peak {r['sensitivity_peak']:.5f} at {r['sensitivity_peak_hz']:.4g} Hz, "
        f"|S| {r['sensitivity_low']:.4g} at omega_low", *loop_lines(r),
    ]  # fmt: skip
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("key", "what"),
    [("force_step_max", "force step"), ("sensitivity_peak", "peak"), ("bandwidth_hz", "andwidth")],
)
def test_a_figure_that_is_another_on_one_page_is_found(run: Path, key: str, what: str) -> None:
    text, file = terminal_of(run), run / "result.json"
    assert disagreements(run, text) == []
    result = json.loads(file.read_text())
    file.write_text(json.dumps(result | {key: 1.02 * result[key]}))
    found = disagreements(run, text)
    assert any(words.startswith("terminal") and what in words for words in found)
    assert any(not words.startswith("terminal") and what in words for words in found)


def test_a_proof_that_is_none_and_half_a_point_are_found(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paint, "draw", lambda *_: None)  # what is read is report.json
    text, page = terminal_of(run), page_of(run)
    claimed = text + "\nproven for the whole box by 10 enclosures"
    assert disagreements(run, claimed) == ["terminal: proven, no proof"]
    head = ("frequency (Hz)", "Re L (–)", "Im L (–)")
    table = c.Table(head, ((1.0, "–", 0.0), (2.0, 1.0, 2.0)))
    half = c.Figure(c.Lines((), ""), "", (table,))
    paint.write_page(run / "report.html", replace(page, chapters=(c.Chapter("L", (half,)),
                                                            *page.chapters)))  # fmt: skip
    assert disagreements(run, text) == ["table: Re L (–) and its Im"]


def test_digits_are_compared_as_they_are_printed() -> None:
    assert same("43.7", 43.66)
    assert same("1.2e-05", 1.24e-5)
    assert not same("43.7", 43.8)
    assert not same("43.70", 43.66)
