"""The paper's figures 4 and 5 by our own syntheses, as a page.

    python benchmarks/paper_figures.py [CASE.toml] [--out PAGE.html]

The plant at 60 kg each, and the inner optima of cases A and B there; the case's M_K is left out.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.drawing.content import (
    Block,
    Chapter,
    Curve,
    Figure,
    Head,
    Level,
    Lines,
    Mark,
    Page,
    Panel,
    Table,
    Words,
)
from ccd_casadi.drawing.paint import page_html
from ccd_casadi.drawing.svg import CYCLE
from ccd_casadi.inner_problem.problem import CoDesignProblem, true_inner
from ccd_casadi.reporting.bode import bode
from ccd_casadi.reporting.loops import synthesised_loop
from ccd_casadi.studies.published import PUBLISHED

ROOT = Path(__file__).resolve().parent.parent
THETA = (60.0, 60.0)


def sections(problem: CoDesignProblem, published: dict[str, Any]) -> list[Chapter]:
    """Figures 4 and 5; none where the case has no feasible design."""
    loops = {
        name: loop
        for name in ("A", "B")
        if (loop := _case(problem, name, published[f"case_{name}"]["M_K"])) is not None
    }
    if "A" not in loops:
        return []
    return [
        Chapter("The paper's figure 4: the plant, 60 kg each", _plant(loops["A"], published)),
        Chapter("The paper's figure 5: cases A and B", _cases(loops, published)),
    ]


def _case(problem: CoDesignProblem, name: str, M_K: float) -> LoopView | None:
    """The inner optimum at (60, 60) with the case's M_K; None where it is infeasible."""
    local = replace(problem, weights=replace(problem.weights, M_K=M_K))
    found = true_inner(local, THETA)
    if found.optimum is None:
        return None
    figures = found.optimum.figures
    label = f"case {name}, M_K = {M_K:g} N/m"
    return synthesised_loop(local, THETA, figures.omega_S, figures.omega_T, label)


def _plant(loop: LoopView, published: dict[str, Any]) -> tuple[Block, ...]:
    paper = published["plant_60_60"]
    caption = (
        f"Plant and the controller of case A. Anti-resonance {loop.antiresonances_hz[0]:.1f} Hz "
        f"(paper {paper['antiresonance_hz']:g}), resonance {loop.resonances_hz[-1]:.1f} Hz "
        f"(paper {paper['resonance_hz']:g})."
    )
    return (replace(bode(loop), caption=caption),)


def _cases(loops: dict[str, LoopView], published: dict[str, Any]) -> tuple[Block, ...]:
    """S and K of both cases with bandwidths and local peaks, and a table against the paper's."""
    S_curves, K_curves, marks, levels = [], [], [], []
    rows = []
    for i, (name, loop) in enumerate(loops.items()):
        colour = CYCLE[i]
        S_curves.append(Curve(loop.hz, loop.gains[0], loop.label, colour))
        K_curves.append(Curve(loop.hz, np.abs(loop.controller[:, 0, 0]), loop.label, colour))
        marks += [
            Mark(hz, gain, f"{gain:.3g} at {hz:.4g} Hz", colour=colour) for hz, gain in loop.peaks
        ]
        levels.append(Level(loop.bandwidth_hz, f"ω_b {loop.bandwidth_hz:.4g} Hz", True, colour))
        paper = published[f"case_{name}"]
        peak = loop.peaks[0][0] if loop.peaks else float("nan")
        rows += [
            _against(f"case {name}: bandwidth (Hz)", loop.bandwidth_hz, paper["bandwidth_hz"]),
            _against(f"case {name}: local peak of S (Hz)", peak, paper["peak_hz"]),
        ]
    x = "frequency (Hz)"
    span = (float(loops["A"].hz[0]), float(loops["A"].hz[-1]))
    S = Panel(
        x, "|S| (–)", tuple(S_curves), marks=tuple(marks), log_x=True, log_y=True, x_range=span,
        levels=(*levels, Level(2**-0.5, "-3 dB")), legend="lower right",
    )  # fmt: skip
    K = Panel(x, "|K| (N/m)", tuple(K_curves), log_x=True, log_y=True, x_range=span)
    lines = Lines(((S,), (K,)), "Sensitivity and controller of cases A and B", (3.6, 2.8))
    caption = (
        "Inner optima of this case file at 60 kg each. The complex zero pair of the plant peaks in "
        "S; a higher gain moves the peak, and the bandwidth, to higher frequencies."
    )
    table = Table(("figure", "here", "paper", "difference"), tuple(rows))
    figure = Figure(lines, caption)
    note = "How far S_max and the box bring these to the paper's: docs/development/calibration.md."
    return figure, table, Words(note)


def _against(label: str, ours: float, paper: float) -> tuple[str, str, str, str]:
    return (label, f"{ours:.2f}", f"{paper:g}", f"{100.0 * (ours / paper - 1.0):+.1f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", nargs="?", type=Path, default=ROOT / "runs" / "two_mass_paper.toml")
    parser.add_argument("--out", type=Path, default=Path("paper_figures.html"))
    given = parser.parse_args()
    found = sections(problem_of(load_case(given.case)), PUBLISHED["two_mass"])
    head = Head("The paper's figures 4 and 5", "good", "computed", "", "", "")
    given.out.write_text(page_html(Page(head, tuple(found), index="")))


if __name__ == "__main__":
    main()
