"""ω_b*(θ) along each parameter through the optimum, for one parameter or more than two."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.drawing.content import Band, Curve, Figure, Level, Lines, Panel, Table
from ccd_casadi.drawing.svg import GREEN, GREY, axis_label
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.facts import theta_axes
from ccd_casadi.reporting.true_samples import Truths, feasible
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, number
from surrogates import GaussianProcess

SLICE = 61
NEARBY = 0.1  # share of the box within which a sample is shown beside a slice
TABLE_STEP = 4


@dataclass(frozen=True)
class Slice:
    """ω_b* in Hz along one parameter through the optimum; the band is 95 %. `near`: (θ_i, Hz)."""

    name: str
    unit: str
    theta: Array
    bandwidth_hz: Array
    deviation_hz: Array
    near: Array
    optimum: float


def slices_data(
    problem: CoDesignProblem,
    process: GaussianProcess | None,
    truths: Truths,
    theta: tuple[float, ...],
) -> list[Slice]:
    """Along every parameter through θ: prediction, deviation, and the truths nearby.

    Without a surrogate the feasible designs nearby stand for the truths.
    """
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    known, values = truths.theta, truths.bandwidth_hz
    if process is None:
        inside = [s for s in truths.designs if feasible(problem, s)]
        known = np.array([s.theta for s in inside]).reshape(-1, len(lower))
        values = np.array([s.bandwidth / HZ for s in inside])
    found = []
    for k, (name, unit, factor) in enumerate(theta_axes(problem)):
        axis = np.linspace(lower[k], upper[k], SLICE)
        points = np.tile(np.array(theta), (SLICE, 1))
        points[:, k] = axis
        empty = np.full(SLICE, np.nan)
        bandwidth, deviation = (
            (empty, empty) if process is None else process.predict(points, return_std=True)
        )
        away = np.abs((known - np.array(theta)) / (upper - lower))
        away[:, k] = 0.0
        near = (away.max(axis=1) <= NEARBY) & np.isfinite(values)
        dots = np.column_stack([factor * known[near, k], values[near]])
        at = factor * float(theta[k])
        hz = bandwidth / HZ, deviation / HZ
        found.append(Slice(name, unit, factor * axis, *hz, dots, at))
    return found


def slices_figure(slices: list[Slice], best_hz: float, extra: str) -> Figure:
    """One small panel a parameter; `extra` ends the caption."""
    caption = _caption(slices, best_hz) + extra
    return Figure(_lines(slices, best_hz), caption, _tables(slices))


def _lines(slices: list[Slice], best_hz: float) -> Lines:
    """The same vertical axis in all."""
    values = [best_hz]
    for item in slices:
        values += [v for v in (*item.bandwidth_hz, *item.near[:, 1]) if np.isfinite(v)]
    margin = 0.06 * (max(values) - min(values)) + 1e-3 * max(values)
    y_range = (min(values) - margin, max(values) + margin)
    panels: list[Panel | None] = [
        _panel(item, y_range, legend=i == 0) for i, item in enumerate(slices)
    ]
    per_row = 1 if len(panels) == 1 else 4 if len(panels) % 3 else 3
    panels += [None] * (-len(panels) % per_row)
    rows = tuple(tuple(panels[i : i + per_row]) for i in range(0, len(panels), per_row))
    heights = (3.2 if len(rows) == 1 else 2.5,) * len(rows)
    return Lines(rows, "Largest bandwidth along each parameter through the optimum", heights)


def _panel(item: Slice, y_range: tuple[float, float], legend: bool) -> Panel:
    curves, bands = [], []
    if np.isfinite(item.bandwidth_hz).any():
        half = 1.96 * item.deviation_hz
        low, high = item.bandwidth_hz - half, item.bandwidth_hz + half
        bands = [Band(item.theta, low, high, "95 % band" if legend else "")]
        curves = [Curve(item.theta, item.bandwidth_hz, "surrogate" if legend else "")]
    if len(item.near):
        label = "truth nearby" if legend else ""
        curves.append(Curve(item.near[:, 0], item.near[:, 1], label, GREEN, "", "o"))
    return Panel(
        axis_label(item.name, item.unit),
        "largest bandwidth ω_b* (Hz)",
        tuple(curves),
        bands=tuple(bands),
        levels=(Level(item.optimum, "optimum" if legend else "", True, GREY),),
        x_range=(float(item.theta[0]), float(item.theta[-1])),
        y_range=y_range,
    )


def _caption(slices: list[Slice], best_hz: float) -> str:
    """Along which parameter the bandwidth changes most, and how sure the surrogate is."""
    spans = [(float(np.nanmax(s.bandwidth_hz) - np.nanmin(s.bandwidth_hz)), s) for s in slices
             if np.isfinite(s.bandwidth_hz).any()]  # fmt: skip
    many = len(slices) > 1
    words = "ω_b* along each parameter, the others at the optimum" if many else "ω_b*(θ)"
    words += f" ({number(best_hz)} Hz there, dashed line); dots: true values"
    words += f" within {100 * NEARBY:.0f} % of the box." if many else "."
    if not spans:
        return words + " No surrogate is of ω_b*(θ) alone: the dots are the run's own designs."
    largest, item = max(spans, key=lambda pair: pair[0])
    widest = max(float(np.max(1.96 * s.deviation_hz)) for _, s in spans)
    most = "changes most along" if many else "changes along"
    words += f" It {most} {item.name}, by {number(largest, 3)} Hz over the range"
    words += f"; the 95 % band is at most ±{number(widest, 2)} Hz"
    return words + "."


def _tables(slices: list[Slice]) -> tuple[Table, ...]:
    """Every slice, thinned."""
    found = []
    for s in slices:
        head: tuple[str, ...] = (axis_label(s.name, s.unit), "true ω_b (Hz)")
        columns = s.near.T
        if np.isfinite(s.bandwidth_hz).any():
            head = (axis_label(s.name, s.unit), "ω_b* (Hz)", "± 95 % (Hz)")
            columns = np.array([s.theta, s.bandwidth_hz, 1.96 * s.deviation_hz])[:, ::TABLE_STEP]
        found.append(Table.of(head, *columns))
    return tuple(found)
