"""Can the surrogate be trusted? Samples predicted without themselves, and the words for it."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLUE, GREY
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.support.units import number
from surrogates import Quality
from surrogates.gaussian_process import TWO_SIDED_95

WORDS = {"bandwidth": "bandwidth ω_b", "sensitivity_peak": "peak of S", "rms_error": "RMS error",
         "move_time": "move time",
         "sensitivity_low": "|S| at ω_low", "compliance": "compliance |GS|"}  # fmt: skip
AXES = {"bandwidth": "Hz", "sensitivity_peak": "–", "sensitivity_low": "–", "compliance": "m/N",
        "rms_error": "nm", "move_time": "ms"}  # fmt: skip
LEAST_BAND = 3.0  # standardised residuals shown at least, either way


def trust_figure(qualities: Sequence[Quality]) -> Figure:
    """A column for each output: predicted without the sample over true, and residuals below."""
    rows = tuple(tuple(map(panel, qualities)) for panel in (_predicted, _residuals))
    title = "samples predicted without themselves, and their standardised residuals"
    words = paragraph("report.trust", len(qualities[0].true))
    return Figure(Lines(rows, title, (3.3, 2.6)), words)


def _predicted(q: Quality) -> Panel:
    both = np.concatenate([q.true, q.predicted])
    margin = 0.04 * float(np.ptp(both)) or 1.0
    span = (float(both.min()) - margin, float(both.max()) + margin)
    ends = np.array(span)
    curves = (
        Curve(ends, ends, "", GREY, "--", width=0.8),
        Curve(q.true, q.predicted, "", BLUE, "", "o"),
    )
    unit = AXES[q.name]
    return Panel(f"true ({unit})", f"predicted ({unit})", curves, x_range=span, y_range=span,
                 title=WORDS[q.name])  # fmt: skip


def _residuals(q: Quality) -> Panel:
    most = max(LEAST_BAND, 1.1 * float(np.abs(q.standardised).max()))
    return Panel(
        f"true ({AXES[q.name]})",
        "residual / deviation (–)",
        (Curve(q.true, q.standardised, "", BLUE, "", "o"),),
        levels=tuple(Level(sign * TWO_SIDED_95, "95 % band") for sign in (1.0, -1.0)),
        y_range=(-most, most),
    )


def table_trust(qualities: Sequence[Quality]) -> Table:
    """Errors left out, calibration and support at the design, output by output."""
    head = (
        "output", "samples", "leave one out, rms", "largest", "Q²",
        "in 95 % bands", "samples are", "at the design",
    )  # fmt: skip
    rows = tuple(
        (WORDS[q.name], len(q.true),
         *(f"{number(e, 3)} {q.unit}" for e in (q.loo.rms, q.loo.max)),
         number(q.loo.q2), f"{100 * q.coverage:.0f} %", q.samples_are, q.at_design)
        for q in qualities
    )  # fmt: skip
    return Table(head, rows)
