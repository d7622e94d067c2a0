"""robustness.html: what the design survives, in figures with the numbers behind them."""

from typing import Any

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.survival import STATED
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, GREY, ORANGE
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.reporting.facts import facts, paragraph, paragraphs, run_name, theta_words
from ccd_casadi.reporting.gain_figures import figure_gains
from ccd_casadi.reporting.moves import way_words, ways_figure
from ccd_casadi.reporting.run_verdict import head_of
from ccd_casadi.robust.margins import DiskMargin
from ccd_casadi.robust.study import Study
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, inwards, number, spoken, with_unit

SHOWN_PEAK = 3.0  # of S_max: a loop near instability has any peak


def robustness_page(
    run: FinishedRun, found: Study, seed: int, index: str = "", *, own: bool = True
) -> c.Page:
    """Make the page robustness.html.

    Parameters
    ----------
    run : FinishedRun
    found : Study
    seed : int
    index : str
        Address of the page that links all pages of the run.
    own : bool
        The controller is the run's, so that the run's decision and verdict are shown.

    Returns
    -------
    Page
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
        c.Chapter("In short", tuple(map(c.Words, others))),
        _margins(found),
        _gains(found),
        _perturbed(run, found),
        _tolerances(run, found),
        *_structured(found),
        *([_move(found)] if found.moves else []),
    )
    return c.Page(head, chapters, index)


def conclusion(run: FinishedRun, found: Study) -> list[str]:
    """Write the findings in sentences, the most important first.

    Parameters
    ----------
    run : FinishedRun
    found : Study

    Returns
    -------
    list of str
    """
    throughout = np.allclose(found.damping.stable, found.demands.damping, rtol=1e-9)
    S_max, lost = run.problem.inner.S_max, _bandwidth_lost(run, found)
    named = _own_set(run)
    outside = any(low < high for low, high in named) and not all(
        low <= value <= high for value, (low, high) in zip(found.box.place, named, strict=True)
    )
    return _words("findings", found, S_max, run.sampling, throughout, lost, outside)


def _own_set(run: FinishedRun) -> tuple[tuple[float, float], tuple[float, float]]:
    """The resonance shifts and damping factors that the design was required to survive."""
    kind = kind_of(run.problem)
    factors = (1.0, *kind.other_factors()[0])
    return kind.common_shifts(), (min(factors), max(factors))


def _words(part: str, *known: Any) -> list[str]:
    """The paragraphs of a macro of `templates/robustness.txt`."""
    own = {"way_words": way_words, "inwards": inwards, "STATED": STATED}
    return paragraphs(f"robustness.{part}", *known, **own)


def _bandwidth_lost(run: FinishedRun, found: Study, *, accepted: float = 0.05) -> tuple[float, ...]:
    """ω_b in Hz of a quarter of the stable plants with other hardware at most, of the slowest one
    and of the design; nothing where the slowest loses less than the share `accepted`.

    A loop that stays stable and within S_max can be half as fast.
    """
    hz = np.array([item.bandwidth / HZ for item in found.tolerances.judged if item.stable])
    hz = hz[np.isfinite(hz)]
    design = run.figures.bandwidth / HZ
    if not hz.size or hz.min() > (1.0 - accepted) * design:
        return ()
    return float(np.quantile(hz, 0.25)), float(hz.min()), design


def _place(omega: float) -> str:
    if omega in (0.0, np.inf):
        return "at rest" if omega == 0.0 else "towards infinite frequency"
    return f"at {number(omega / HZ, 4)} Hz"


def _margins(found: Study) -> c.Chapter:
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
    return c.Chapter("Margins", (c.Table(head, tuple(rows)), *map(c.Words, _words("margins"))))


def _gains(found: Study) -> c.Chapter:
    shapes = (("S", ""), ("T", ""), ("GS", "m"), ("KS", "N/m"))
    tops = [
        (found.view.name_gain(name),
         with_unit(peak, spoken(unit), 5) + spoken("/N") * (name == "GS") if unit else number(peak),
         _place(omega))
        for (name, unit), (peak, omega) in zip(shapes, found.peaks, strict=True)
    ]  # fmt: skip
    drawn = c.Figure(figure_gains([found.view], compliance=True), paragraph("robustness.gains"))
    rms = c.Facts(tuple(facts("noise", found.noise, found.demands)))
    white = (c.Heading("White noise (one-sided density)"), rms)
    body = (drawn, c.Facts(tuple(tops)), *white)  # at rest: in short
    return c.Chapter("Disturbance and noise", body, folded=True)


def _perturbed(run: FinishedRun, found: Study) -> c.Chapter:
    """Peak and bandwidth over the shift, and over the damping; one mode at a time."""
    S_max = run.problem.inner.S_max
    panels = []
    for line, label, factor, own in zip(
        (found.shift, found.damping), ("resonance shift (%)", "damping × (–)"), (100.0, 1.0),
        _own_set(run), strict=True,
    ):  # fmt: skip
        judged = line.judged
        x = np.array([item.place[0] for item in judged])
        peak = np.array([item.peak if item.stable else np.nan for item in judged])
        bandwidth = np.array([item.bandwidth / HZ for item in judged])
        # the axis shows what matters about S_max; a loop near instability has any peak
        top = min(float(np.nanmax(peak)) * 1.05, SHOWN_PEAK * S_max)
        limit = (c.Level(S_max, f"S_max {S_max:g}", colour=GREY),)
        ends = (factor * float(x[0]), factor * float(x[-1]))
        curve = c.Curve(factor * x, peak, marker=".")
        span = (1.0, max(top, 1.1 * S_max))
        lost = _unstable(factor * x, peak, factor * np.array(line.stable), span)
        faster = c.Curve(factor * x, bandwidth, colour=ORANGE, marker=".")
        required = _required(factor, own)
        panels.append((
            c.Panel(label, "‖S‖∞ (–)", (curve,), bands=lost, levels=(*limit, *required),
                  x_range=ends, y_range=span),
            c.Panel(label, "ω_b (Hz)", (faster,), levels=required, x_range=ends),
        ))  # fmt: skip
    lines = c.Lines(tuple(panels), "Peak of S and bandwidth off the model")
    drawn = c.Figure(lines, paragraph("robustness.perturbed", SHOWN_PEAK))
    rows = tuple(
        (number(item.place[0], 5), 100.0 * item.place[1], "yes" if item.stable else "NO",
         item.bandwidth / HZ, item.peak) for item in found.modes
    )  # fmt: skip
    head = ("mode Hz", "shift %", "stable", "ω_b Hz", "‖S‖∞")
    modes = (c.Heading("One mode at a time"), c.Table(head, rows)) if rows else ()
    return c.Chapter("Plants off the model", (drawn, *modes))


def _required(factor: float, own: tuple[float, float]) -> tuple[c.Level, ...]:
    """Both ends of the case's [robust] set on an axis; nothing where it names none."""
    if own[0] == own[1]:
        return ()
    words = ("[robust] set from here", "")
    return tuple(c.Level(factor * v, said, True, GREEN) for v, said in zip(own, words, strict=True))


def _unstable(
    x: Array, peak: Array, stable: Array, span: tuple[float, float]
) -> tuple[c.Band, ...]:
    """The ends of a line on which the loop is lost, in grey."""
    found: list[c.Band] = []
    for outer, edge in ((x[0], stable[0]), (x[-1], stable[1])):
        if outer != edge and np.isnan(peak).any():
            ends = np.array([outer, edge])
            label = "" if found else "unstable"
            found.append(c.Band(ends, np.full(2, span[0]), np.full(2, span[1]), label, GREY))
    return tuple(found)


def shown_peak(run: FinishedRun, found: Study) -> float:
    """The right end of the axis of peaks of the random plants."""
    S_max = run.problem.inner.S_max
    largest = max((i.peak for i in found.tolerances.judged if i.stable), default=S_max)
    return float(min(1.02 * max(largest, S_max), SHOWN_PEAK * S_max))


def _tolerances(run: FinishedRun, found: Study) -> c.Chapter:
    """Distributions of peak and bandwidth over the random plants; in the table of quantiles the
    unstable ones are infinite peaks."""
    hard, shown = found.tolerances, shown_peak(run, found)
    judged = hard.judged
    peak = np.sort([item.peak for item in judged if item.stable])
    bandwidth = np.sort([item.bandwidth / HZ for item in judged if item.stable])
    share = (np.arange(peak.size) + 1.0) / max(len(judged), 1)
    S_max = run.problem.inner.S_max
    limit = (c.Level(S_max, "S_max", vertical=True), c.Level(1.0, "all"))
    panels = (
        c.Panel("‖S‖∞ (–)", "share of the plants (–)", (c.Curve(peak, share),),
              levels=limit, x_range=(min(*peak, S_max, 1e9), shown),
              y_range=(0.0, 1.08)),
        c.Panel("ω_b (Hz)", "share of the plants (–)", (c.Curve(bandwidth, share, colour=ORANGE),),
              y_range=(0.0, 1.08)),
    )  # fmt: skip
    peaks = np.sort([item.peak for item in judged])
    bands = np.sort([item.bandwidth / HZ if item.stable else 0.0 for item in judged])
    shares = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
    at = [round(share * (len(judged) - 1)) for share in shares]
    table = c.Table.of(("share", "‖S‖∞", "ω_b Hz (0: unstable)"), shares, peaks[at], bands[at])
    theta = theta_words({
        "theta": dict(zip(run.problem.names, hard.worst.place, strict=True)),
        "units": dict(zip(run.problem.names, run.problem.units, strict=True)),
    })  # fmt: skip
    caption, *worst = _words("tolerances", hard, shown, theta)
    lines = c.Lines((panels,), "Peak and bandwidth of random hardware")
    return c.Chapter(
        "Hardware tolerances", (c.Figure(lines, caption, (table,)), *map(c.Words, worst))
    )


def _structured(found: Study) -> list[c.Chapter]:
    bound = found.structured
    if bound is None:
        return []
    # 1/μ is what is allowed of complex errors; the level is what is allowed of real ones
    panel = c.Panel(
        "frequency (Hz)", "μ (–)", (c.Curve(bound.hz, bound.mu, "complex errors", BLUE),),
        levels=(
            c.Level(1.0 / bound.stiffness, f"bound for real errors (from {bound.worst_hz:.4g} Hz)"),
        ),
        log_x=True, log_y=True,
        y_range=(1e-2, 3.0 * max(float(bound.mu.max()), 1.0 / bound.stiffness)),
    )  # fmt: skip
    lines = c.Lines(((panel,),), "Structured singular value")
    drawn = c.Figure(lines, paragraph("robustness.structured", bound))
    return [c.Chapter("Structured singular value", (drawn,), folded=True)]


def _move(found: Study) -> c.Chapter:
    ways = {move.words: [move] for move in found.moves}
    drawn = ways_figure(ways, "The loop is simulated exactly.")
    return c.Chapter("A move", (*map(c.Words, _words("move", found)), drawn), folded=True)
