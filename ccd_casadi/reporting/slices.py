"""ω_b*(θ) along each parameter through the optimum, for one parameter or more than two."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.drawing.content import Band, Curve, Figure, Level, Lines, Panel
from ccd_casadi.drawing.svg import GREEN, GREY, axis_label
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.facts import paragraph, theta_axes
from ccd_casadi.reporting.landscape import Truths, known_bandwidths
from ccd_casadi.support.units import HZ
from surrogates import GaussianProcess
from surrogates.gaussian_process import TWO_SIDED_95

SLICE = 61
NEARBY = 0.1  # share of the box within which a sample is shown beside a slice


def slices_figure(
    problem: CoDesignProblem, process: GaussianProcess | None, truths: Truths,
    theta: Sequence[float], best_hz: float, extra: str,
) -> Figure | None:  # fmt: skip
    """One small panel a parameter: prediction, its 95 % band, and the truths nearby.

    None where nothing is known. `extra` ends the caption.
    """
    lower, upper, at = (np.array(each, float) for each in (problem.lower, problem.upper, theta))
    known = known_bandwidths(problem, process, truths)
    places, values = np.array([*known]).reshape(-1, len(at)), np.array([*known.values()])
    away = np.abs(places - at) / (upper - lower)
    panels, seen = [], [np.array([best_hz])]
    spans: dict[str, tuple[float, float]] = {}  # the prediction's, and the band's half width
    for k, (name, unit, factor) in enumerate(theta_axes(problem)):
        axis, ends = axis_label(name, unit), (factor * lower[k], factor * upper[k])
        near = (np.delete(away, k, axis=1) <= NEARBY).all(axis=1) & np.isfinite(values)
        dots = factor * places[near, k], values[near]
        curves = [Curve(*dots, "truth nearby", GREEN, "", "o")] if near.any() else []
        bands = []
        seen.append(values[near])
        if process is not None:
            points = np.tile(at, (SLICE, 1))
            points[:, k] = np.linspace(lower[k], upper[k], SLICE)
            hz, deviation = (each / HZ for each in process.predict(points, return_std=True))
            x, half = factor * points[:, k], TWO_SIDED_95 * deviation
            curves.insert(0, Curve(x, hz, "surrogate"))
            bands = [Band(x, hz - half, hz + half, "95 % band")]
            spans[name] = float(np.ptp(hz)), float(half.max())
            seen.append(hz)
        optimum = Level(factor * at[k], "" if k else "optimum", True, GREY)
        panels.append(Panel(
            axis, "largest bandwidth ω_b* (Hz)", tuple(curves), tuple(bands), levels=(optimum,),
            x_range=ends, legend=None if k else "best",
        ))  # fmt: skip
    if not any(panel.curves for panel in panels):
        return None
    all_hz = np.concatenate(seen)
    margin = 0.06 * float(np.ptp(all_hz)) + 1e-3 * float(all_hz.max())
    y_range = (float(all_hz.min()) - margin, float(all_hz.max()) + margin)
    same = [replace(panel, y_range=y_range) for panel in panels]
    per_row = 1 if len(same) == 1 else 4 if len(same) % 3 else 3
    full = [*same, *[None] * (-len(same) % per_row)]
    rows = tuple(tuple(full[i : i + per_row]) for i in range(0, len(full), per_row))
    heights = (3.2 if len(rows) == 1 else 2.5,) * len(rows)
    lines = Lines(rows, "Largest bandwidth along each parameter through the optimum", heights)
    most = max(spans.items(), key=lambda item: item[1][0], default=None)
    band = max((half for _, half in spans.values()), default=0.0)
    told = (most and (most[0], most[1][0]), band, len(same) > 1, best_hz, NEARBY)
    return Figure(lines, paragraph("report.slices", *told) + extra)
