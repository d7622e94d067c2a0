"""The figures of robustness.html and the tables behind them."""

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.drawing.content import Band, Curve, Figure, Level, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLUE, GREY, ORANGE
from ccd_casadi.robust.structured import StructuredBound
from ccd_casadi.robust.study import Study
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

SHOWN_PEAK = 3.0  # of S_max: a loop near instability has any peak


def perturbed(run: FinishedRun, found: Study, caption: str) -> Figure:
    """Peak and bandwidth over the shift, and over the damping."""
    S_max = run.problem.inner.S_max
    rows = []
    for line, label, factor in (
        (found.shift, "resonance shift (%)", 100.0),
        (found.damping, "damping × (–)", 1.0),
    ):
        judged = line.judged
        x = np.array([item.place[0] for item in judged])
        peak = np.array([item.peak if item.stable else np.nan for item in judged])
        bandwidth = np.array([item.bandwidth / HZ for item in judged])
        # the axis shows what matters about S_max; a loop near instability has any peak
        top = min(float(np.nanmax(peak)) * 1.05, SHOWN_PEAK * S_max)
        limit = (Level(S_max, f"S_max {S_max:g}", colour=GREY),)
        ends = (factor * float(x[0]), factor * float(x[-1]))
        curve = Curve(factor * x, peak, marker=".")
        span = (1.0, max(top, 1.1 * S_max))
        lost = _unstable(factor * x, peak, factor * np.array(line.stable), span)
        faster = Curve(factor * x, bandwidth, colour=ORANGE, marker=".")
        rows.append((
            Panel(label, "‖S‖∞ (–)", (curve,), bands=lost, levels=limit, x_range=ends,
                  y_range=span),
            Panel(label, "ω_b (Hz)", (faster,), x_range=ends),
        ))  # fmt: skip
    return Figure(Lines(tuple(rows), "Peak of S and bandwidth off the model"), caption)


def _unstable(x: Array, peak: Array, stable: Array, span: tuple[float, float]) -> tuple[Band, ...]:
    """The ends of a line on which the loop is lost, in grey."""
    found: list[Band] = []
    for outer, edge in ((x[0], stable[0]), (x[-1], stable[1])):
        if outer != edge and np.isnan(peak).any():
            ends = np.array([outer, edge])
            label = "" if found else "unstable"
            found.append(Band(ends, np.full(2, span[0]), np.full(2, span[1]), label, GREY))
    return tuple(found)


def shown_peak(run: FinishedRun, found: Study) -> float:
    """The right end of the axis of peaks of the random plants."""
    S_max = run.problem.inner.S_max
    largest = max((i.peak for i in found.tolerances.judged if i.stable), default=S_max)
    return float(min(1.02 * max(largest, S_max), SHOWN_PEAK * S_max))


def tolerances(run: FinishedRun, found: Study, caption: str) -> Figure:
    """Distributions of peak and bandwidth over the random plants; in the table of quantiles the
    unstable ones are infinite peaks."""
    judged = found.tolerances.judged
    peak = np.sort([item.peak for item in judged if item.stable])
    bandwidth = np.sort([item.bandwidth / HZ for item in judged if item.stable])
    share = (np.arange(peak.size) + 1.0) / max(len(judged), 1)
    S_max = run.problem.inner.S_max
    limit = (Level(S_max, "S_max", vertical=True), Level(1.0, "all"))
    panels = (
        Panel("‖S‖∞ (–)", "share of the plants (–)", (Curve(peak, share),),
              levels=limit, x_range=(min(*peak, S_max, 1e9), shown_peak(run, found)),
              y_range=(0.0, 1.08)),
        Panel("ω_b (Hz)", "share of the plants (–)", (Curve(bandwidth, share, colour=ORANGE),),
              y_range=(0.0, 1.08)),
    )  # fmt: skip
    peaks = np.sort([item.peak for item in judged])
    bands = np.sort([item.bandwidth / HZ if item.stable else 0.0 for item in judged])
    shares = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
    at = [round(share * (len(judged) - 1)) for share in shares]
    table = Table.of(("share", "‖S‖∞", "ω_b Hz (0: unstable)"), shares, peaks[at], bands[at])
    return Figure(Lines((panels,), "Peak and bandwidth of random hardware"), caption, (table,))


def structured(bound: StructuredBound, caption: str) -> Figure:
    """1/μ is what is allowed of complex errors; the level is what is allowed of real ones."""
    panel = Panel(
        "frequency (Hz)", "μ (–)", (Curve(bound.hz, bound.mu, "complex errors", BLUE),),
        levels=(
            Level(1.0 / bound.stiffness, f"bound for real errors (from {bound.worst_hz:.4g} Hz)"),
        ),
        log_x=True, log_y=True,
        y_range=(1e-2, 3.0 * max(float(bound.mu.max()), 1.0 / bound.stiffness)),
    )  # fmt: skip
    return Figure(Lines(((panel,),), "Structured singular value"), caption)
