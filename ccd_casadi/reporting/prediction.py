"""What the surrogate promised and what the truth gave, round by round, and whether to trust it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.codesign.formulation import Iterate
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Table, Words
from ccd_casadi.drawing.svg import BLUE, GREY
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.facts import paragraph, theta_axes
from ccd_casadi.support.units import HZ, number, small_share, spoken
from surrogates import Quality
from surrogates.gaussian_process import TWO_SIDED_95

WORDS = {"bandwidth": "bandwidth ω_b", "sensitivity_peak": "peak of S", "rms_error": "RMS error",
         "move_time": "move time",
         "sensitivity_low": "|S| at ω_low", "compliance": "compliance |GS|"}  # fmt: skip
AXES = {"bandwidth": "Hz", "sensitivity_peak": "–", "sensitivity_low": "–", "compliance": "m/N",
        "rms_error": "nm", "move_time": "ms"}  # fmt: skip
LEAST_BAND = 3.0  # standardised residuals shown at least, either way


def history_blocks(
    iterates: Sequence[Iterate], problem: CoDesignProblem, result: Mapping[str, Any],
    theta: tuple[float, ...], tolerance: float, *, lifted: bool,
) -> tuple[Words, Table]:  # fmt: skip
    """ω_b and J predicted and true, round by round, the verified design last, and the error."""
    predicted_hz, true_hz = result["surrogate_bandwidth_hz"], result["bandwidth_hz"]
    J = result["objective"]
    last = replace(
        iterates[-1], theta=theta, predicted=HZ * predicted_hz, truth=HZ * true_hz, objective=J,
        predicted_objective=J + problem.w2 * HZ * (predicted_hz - true_hz),
        error=abs(predicted_hz / true_hz - 1.0),
    )  # fmt: skip
    rows = [
        (i.predicted / HZ, i.truth / HZ, i.predicted_objective, i.objective, i.error)
        for i in (*iterates, last)
    ]
    known = np.array(rows, float)
    known[~np.isfinite(known)] = np.nan
    axes = theta_axes(problem)
    units = (f"{name} ({unit})" if unit else name for name, unit, _ in axes)
    head = ("round", *units, "ω_b predicted Hz", "ω_b true Hz", "J predicted", "J true", "error")
    names = [*(str(i + 1) for i in range(len(iterates))), "verified"]
    table = Table(head, tuple(
        (name, *(v * axis[2] for v, axis in zip(item.theta, axes, strict=True)), *row[:-1],
         small_share(row[-1]) if np.isfinite(row[-1]) else "–")
        for name, item, row in zip(names, (*iterates, last), known, strict=True)
    ))  # fmt: skip
    *_, objective, error = known.T
    ends = [small_share(float(e)) for e in error[np.isfinite(error)][[0, -1]]]
    met = np.flatnonzero(error[:-1] <= tolerance)
    stays = bool(met.size and (error[met[0] : -1] <= tolerance).all())
    first = int(met[0]) + 1 if met.size else 0
    lost = int(np.isnan(objective).sum())
    told = (len(iterates), *ends, tolerance, first, stays, lost, lifted)
    return Words(paragraph("report.history", *told)), table


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
    unit = spoken(AXES[q.name])
    return Panel(f"true ({unit})", f"predicted ({unit})", curves, x_range=span, y_range=span,
                 title=WORDS[q.name])  # fmt: skip


def _residuals(q: Quality) -> Panel:
    most = max(LEAST_BAND, 1.1 * float(np.abs(q.standardised).max()))
    return Panel(
        f"true ({spoken(AXES[q.name])})",
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
         *(f"{number(e, 3)} {spoken(q.unit)}" for e in (q.loo.rms, q.loo.max)),
         number(q.loo.q2), f"{100 * q.coverage:.0f} %", q.samples_are, q.at_design)
        for q in qualities
    )  # fmt: skip
    return Table(head, rows)
