"""robustness.html: what the design survives, in figures with the numbers behind them."""

from typing import Any

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.drawing.content import Chapter, Facts, Figure, Heading, Page, Table, Words
from ccd_casadi.reporting import robustness_figures as figures
from ccd_casadi.reporting.facts import facts, paragraph, paragraphs, run_name, theta_words
from ccd_casadi.reporting.loops import figure_gains
from ccd_casadi.reporting.moves import way_words, ways_figure
from ccd_casadi.reporting.verdict import head_of
from ccd_casadi.robust.margins import DiskMargin
from ccd_casadi.robust.study import Study
from ccd_casadi.support.units import HZ, number, with_unit

LOSS = 0.05  # of ω_b: what hardware within its tolerances may cost without being mentioned


def robustness_page(
    run: FinishedRun, found: Study, seed: int, index: str = "", *, own: bool = True
) -> Page:
    """robustness.html; `index`: the page that links all of the run.

    `own`: of the run's own controller, so that the run's decision and verdict stand on it.
    """
    lead, *others = conclusion(run, found)
    given = "This controller is stable on every plant that was tried."
    if not found.survives:
        given = "Do not use this controller: it is not stable on every plant that was tried."
    head = head_of(
        f"Robustness: {run_name(run.folder)}", found.survives,
        "stable on all plants" if found.survives else "not stable on all plants",
        "that were tried; others were not examined",
        f"{theta_words(run.result)} · seed {seed}", lead, run.result if own else {},
        "" if own else given,
    )  # fmt: skip
    chapters = (
        Chapter("In short", tuple(map(Words, others))),
        _margins(found),
        _gains(found),
        _perturbed(run, found),
        _tolerances(run, found),
        *_structured(found),
        *([_move(found)] if found.moves else []),
    )
    return Page(head, chapters, index)


def conclusion(run: FinishedRun, found: Study) -> list[str]:
    """The findings in sentences, the most important first."""
    throughout = np.allclose(found.damping.stable, found.demands.damping, rtol=1e-9)
    S_max, lost = run.problem.inner.S_max, _bandwidth_lost(run, found)
    return _words("findings", found, S_max, run.sampling, throughout, lost)


def _words(part: str, *known: Any) -> list[str]:
    """The paragraphs of a macro of `templates/robustness.txt`."""
    return paragraphs(f"robustness.{part}", *known, way_words=way_words)


def _bandwidth_lost(run: FinishedRun, found: Study) -> tuple[float, ...]:
    """ω_b in Hz of a quarter of the stable plants with other hardware at most, of the slowest one
    and of the design; nothing where they lose none to speak of.

    A loop that stays stable and within S_max can be half as fast.
    """
    hz = np.array([item.bandwidth / HZ for item in found.tolerances.judged if item.stable])
    hz = hz[np.isfinite(hz)]
    design = run.figures.bandwidth / HZ
    if not hz.size or hz.min() > (1.0 - LOSS) * design:
        return ()
    return float(np.quantile(hz, 0.25)), float(hz.min()), design


def _place(omega: float) -> str:
    if omega in (0.0, np.inf):
        return "at rest" if omega == 0.0 else "towards infinite frequency"
    return f"at {number(omega / HZ, 4)} Hz"


def _margins(found: Study) -> Chapter:
    head = (
        "loop broken at", "gain up", "gain down", "phase °", "crossover Hz", "disk α", "at Hz",
        "disk gain", "disk phase °",
    )  # fmt: skip

    def disk(margin: DiskMargin) -> tuple[float, ...]:
        return margin.alpha, margin.hz, margin.gain, margin.phase_deg

    nothing = float("nan")
    rows = [
        (m.name, m.gain_up, m.gain_down, m.phase_deg, m.crossover_hz, *disk(m.disk))
        for m in found.margins.loops
    ]
    for name, margin in (("outputs", found.margins.outputs), ("inputs", found.margins.inputs)):
        rows.append((f"all {name} at once", *([nothing] * 4), *disk(margin)))
    return Chapter("Margins", (Table(head, tuple(rows)), *map(Words, _words("margins"))))


def _gains(found: Study) -> Chapter:
    shapes = (("S", ""), ("T", ""), ("GS", "m"), ("KS", "N/m"))
    tops = [
        (found.view.named(name),
         with_unit(peak, unit, 5) + "/N" * (name == "GS") if unit else number(peak), _place(omega))
        for (name, unit), (peak, omega) in zip(shapes, found.peaks, strict=True)
    ]  # fmt: skip
    drawn = Figure(figure_gains([found.view], compliance=True), paragraph("robustness.gains"))
    rms = Facts(tuple(facts("noise", found.noise, found.demands)))
    white = (Heading("White noise (one-sided density)"), rms)
    body = (drawn, Facts(tuple(tops)), *white)  # at rest: in short
    return Chapter("Disturbance and noise", body)


def _perturbed(run: FinishedRun, found: Study) -> Chapter:
    drawn = figures.perturbed(run, found, paragraph("robustness.perturbed", figures.SHOWN_PEAK))
    rows = tuple(
        (number(item.place[0], 5), 100.0 * item.place[1], "yes" if item.stable else "NO",
         item.bandwidth / HZ, item.peak) for item in found.modes
    )  # fmt: skip
    head = ("mode Hz", "shift %", "stable", "ω_b Hz", "‖S‖∞")
    modes = (Heading("One mode at a time"), Table(head, rows)) if rows else ()
    return Chapter("Plants off the model", (drawn, *modes))


def _tolerances(run: FinishedRun, found: Study) -> Chapter:
    hard, shown = found.tolerances, figures.shown_peak(run, found)
    theta = theta_words({
        "theta": dict(zip(run.problem.names, hard.worst.place, strict=True)),
        "units": dict(zip(run.problem.names, run.problem.units, strict=True)),
    })  # fmt: skip
    caption, *worst = _words("tolerances", hard, shown, theta)
    drawn = figures.tolerances(run, found, caption)
    return Chapter("Hardware tolerances", (drawn, *map(Words, worst)))


def _structured(found: Study) -> list[Chapter]:
    bound = found.structured
    if bound is None:
        return []
    drawn = figures.structured(bound, paragraph("robustness.structured", bound))
    return [Chapter("Structured singular value", (drawn,))]


def _move(found: Study) -> Chapter:
    ways = {"with mass feedforward" if m.feedforward else "without feedforward": [m]
            for m in found.moves}  # fmt: skip
    drawn = ways_figure(ways, "The loop is simulated exactly.")
    return Chapter("A move", (*map(Words, _words("move", found)), drawn))
