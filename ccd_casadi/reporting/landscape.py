"""ω_b*(θ) over the hardware, and what the surrogate promised round by round."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.codesign.outer_problem import FormulationRound
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, GREY, axis_label
from ccd_casadi.inner_problem.objective import violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.facts import paragraph, theta_axes
from ccd_casadi.sampling.store import Sample, SampleStore
from ccd_casadi.sampling.units import best_key, hashes_of, sample_key
from ccd_casadi.support.text import HZ, number, small_share, spoken
from surrogates import GaussianProcess, Quality
from surrogates.gaussian_process import TWO_SIDED_95

WORDS = {"bandwidth": "bandwidth ω_b", "sensitivity_peak": "peak of S", "rms_error": "RMS error",
         "move_time": "move time",
         "sensitivity_low": "|S| at ω_low", "compliance": "compliance |GS|"}  # fmt: skip
AXES = {"bandwidth": "Hz", "sensitivity_peak": "–", "sensitivity_low": "–", "compliance": "m/N",
        "rms_error": "nm", "move_time": "ms"}  # fmt: skip
LEAST_BAND = 3.0  # standardised residuals shown at least, either way


def history_blocks(
    iterates: Sequence[FormulationRound], problem: CoDesignProblem, result: Mapping[str, Any],
    theta: tuple[float, ...], tolerance: float, *, lifted: bool,
) -> tuple[c.Words, c.Table]:  # fmt: skip
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
    table = c.Table(head, tuple(
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
    shown = (len(iterates), *ends, tolerance, first, stays, lost, lifted)
    return c.Words(paragraph("report.history", *shown)), table


def trust_figure(qualities: Sequence[Quality]) -> c.Figure:
    """A column for each output: predicted without the sample over true, and residuals below."""
    rows = tuple(tuple(map(panel, qualities)) for panel in (_predicted, _residuals))
    title = "samples predicted without themselves, and their standardised residuals"
    words = paragraph("report.trust", len(qualities[0].true))
    return c.Figure(c.Lines(rows, title, (3.3, 2.6)), words)


def _predicted(q: Quality) -> c.Panel:
    both = np.concatenate([q.true, q.predicted])
    margin = 0.04 * float(np.ptp(both)) or 1.0
    span = (float(both.min()) - margin, float(both.max()) + margin)
    ends = np.array(span)
    curves = (
        c.Curve(ends, ends, "", GREY, "--", width=0.8),
        c.Curve(q.true, q.predicted, "", BLUE, "", "o"),
    )
    unit = spoken(AXES[q.name])
    return c.Panel(f"true ({unit})", f"predicted ({unit})", curves, x_range=span, y_range=span,
                 title=WORDS[q.name])  # fmt: skip


def _residuals(q: Quality) -> c.Panel:
    most = max(LEAST_BAND, 1.1 * float(np.abs(q.standardised).max()))
    return c.Panel(
        f"true ({spoken(AXES[q.name])})",
        "residual / deviation (–)",
        (c.Curve(q.true, q.standardised, "", BLUE, "", "o"),),
        levels=tuple(c.Level(sign * TWO_SIDED_95, "95 % band") for sign in (1.0, -1.0)),
        y_range=(-most, most),
    )


def table_trust(qualities: Sequence[Quality]) -> c.Table:
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
    return c.Table(head, rows)


GRID = 25  # points per parameter of a landscape
COARSER = 17  # the same where there are many samples
MANY = 80  # samples with gradients above which it is that
SLICE = 61
NEARBY = 0.1  # share of the box within which a sample is shown beside a slice


@dataclass(frozen=True)
class Truths:
    """ω_b*(θ) in Hz where the inner problem was solved (NaN: infeasible), and every design."""

    theta: np.ndarray
    bandwidth_hz: np.ndarray
    designs: tuple[Sample, ...]


def read_truths(path: Path, problem: CoDesignProblem) -> Truths:
    """Read everything in a store that belongs to a problem (a folder may have seen others).

    Parameters
    ----------
    path : Path
        samples.sqlite.
    problem : CoDesignProblem

    Returns
    -------
    Truths
    """
    designs_hash, inner_hash = hashes_of(problem)
    count = len(problem.names)
    thetas, values = [], []
    with SampleStore(path) as store:
        rows = [s for s in store.select() if len(s.theta) == count]
        for theta in dict.fromkeys(sample.theta for sample in rows):
            known = store.get_result(best_key(inner_hash, theta))
            known = known or store.get_result(sample_key(inner_hash, theta))
            if known is not None:
                thetas.append(theta)
                value = known["bandwidth"]
                values.append(np.nan if value is None else value / HZ)
    ours = tuple(
        s for s in rows if s.key == sample_key(designs_hash, s.theta, s.omega_S, s.omega_T)
    )
    return Truths(np.array(thetas).reshape(-1, count), np.array(values), ours)


def bandwidth_process(processes: Sequence[object]) -> GaussianProcess | None:
    """Select the surrogate of ω_b*(θ) in rad/s.

    Parameters
    ----------
    processes : sequence
        Of a run.

    Returns
    -------
    GaussianProcess, or None where they are of other outputs
    """
    one = processes[0] if len(processes) == 1 else None
    return one if isinstance(one, GaussianProcess) else None


def landscape_data(
    problem: CoDesignProblem,
    process: GaussianProcess | None,
    truths: Truths,
    radius: float = 1.0,
    theta: Sequence[float] = (0.0, 0.0),
    axes: tuple[int, int] = (0, 1),
) -> c.Landscape:
    """Collect the landscape over two parameters, the others as at θ.

    Parameters
    ----------
    problem : CoDesignProblem
    process : GaussianProcess or None
        Of ω_b*(θ), rad/s.
    truths : Truths
    radius : float
        Of the trust region about θ, as a share of the box.
    theta : sequence of float (n,)
        SI.
    axes : tuple of int
        Numbers of the two parameters.

    Returns
    -------
    Landscape
    """
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    count = GRID if process is None or len(process.X) <= MANY else COARSER
    first, second = (np.linspace(lower[k], upper[k], count) for k in axes)
    thetas = np.tile(np.asarray(theta, float), (count * count, 1))
    thetas[:, axes] = np.stack(np.meshgrid(first, second, indexing="ij"), -1).reshape(-1, 2)
    field = np.empty((0, 0))
    if process is not None:
        field = process.predict(thetas).reshape(count, count) / HZ
    forbidden = None
    if plant_of(problem).constraint_names:
        bad = [bool(violations(problem, tuple(place))) for place in thetas]
        forbidden = np.array(bad).reshape(count, count)
    region = None
    if radius < 1.0:
        half, at = radius * (upper - lower), np.asarray(theta)
        low, high = np.maximum(lower, at - half), np.minimum(upper, at + half)
        region = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    label = "best feasible ω_b" if process is None else "true ω_b*(θ)"
    known = known_bandwidths(problem, process, truths)
    single = {s.theta for s in truths.designs} - set(known)
    i, j = axes
    return c.Landscape(
        names=(problem.names[i], problem.names[j]),
        units=(problem.units[i], problem.units[j]),
        first=first,
        second=second,
        bandwidth_hz=field,
        truths=np.array([(t[i], t[j], hz) for t, hz in known.items()]).reshape(-1, 3),
        designs=np.array([(t[i], t[j]) for t in sorted(single)]).reshape(-1, 2),
        truth_label=f"{label}, same colours",
        forbidden=forbidden,
        region=region,
    )


def known_bandwidths(
    problem: CoDesignProblem, process: GaussianProcess | None, truths: Truths
) -> dict[tuple[float, ...], float]:
    """Collect the known bandwidths over θ.

    Parameters
    ----------
    problem : CoDesignProblem
    process : GaussianProcess or None
        Without, the largest bandwidth of the feasible designs at each θ is taken.
    truths : Truths

    Returns
    -------
    dict of θ to Hz
        NaN where the inner problem is infeasible.
    """
    if process is not None:
        return dict(zip(map(tuple, truths.theta.tolist()), truths.bandwidth_hz, strict=True))
    best: dict[tuple[float, ...], float] = {}
    for s in truths.designs:
        if s.certified and problem.inner.excess(s) <= 1e-9:  # to the surrogates' margin
            best[s.theta] = max(best.get(s.theta, 0.0), s.bandwidth / HZ)
    return best


def caption_landscape(land: c.Landscape, best_hz: float) -> str:
    """Describe what the colours and the dots are, and what the field leaves out."""
    field = land.bandwidth_hz
    inside = np.isfinite(field) & ~land.outside
    known = field[inside] if inside.any() else field
    ends = (float(known.min()), float(known.max())) if field.size else None
    return paragraph("report.landscape", land, ends, best_hz)


def caption_disagreement(process: GaussianProcess | None, truths: Truths) -> str:
    """Describe how far the surrogate's ω_b* is from the true one where it was not fitted to it."""
    if process is None:
        return ""
    unit = (truths.theta - process.lower) / (process.upper - process.lower)
    gaps = np.abs(unit[:, None, :] - process.X[None, :, :]).max(axis=2)
    known = np.isfinite(truths.bandwidth_hz) & (gaps.min(axis=1) > 1e-9)  # it has its own samples
    if not known.any():
        return ""
    truth = truths.bandwidth_hz[known]
    error = 100.0 * np.abs(process.predict(truths.theta[known]) / HZ / truth - 1.0)
    return (
        f" At {len(error)} other θ with a known true ω_b* it is off by at most "
        f"{number(float(error.max()), 2)} %, {number(float(np.median(error)), 2)} % in the median."
    )


def slices_figure(
    problem: CoDesignProblem, process: GaussianProcess | None, truths: Truths,
    theta: Sequence[float], best_hz: float, extra: str,
) -> c.Figure | None:  # fmt: skip
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
        curves = [c.Curve(*dots, "truth nearby", GREEN, "", "o")] if near.any() else []
        bands = []
        seen.append(values[near])
        if process is not None:
            points = np.tile(at, (SLICE, 1))
            points[:, k] = np.linspace(lower[k], upper[k], SLICE)
            hz, deviation = (each / HZ for each in process.predict(points, return_std=True))
            x, half = factor * points[:, k], TWO_SIDED_95 * deviation
            curves.insert(0, c.Curve(x, hz, "surrogate"))
            bands = [c.Band(x, hz - half, hz + half, "95 % band")]
            spans[name] = float(np.ptp(hz)), float(half.max())
            seen.append(hz)
        optimum = c.Level(factor * at[k], "" if k else "optimum", True, GREY)
        panels.append(c.Panel(
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
    lines = c.Lines(rows, "Largest bandwidth along each parameter through the optimum", heights)
    most = max(spans.items(), key=lambda item: item[1][0], default=None)
    band = max((half for _, half in spans.values()), default=0.0)
    shown = (most and (most[0], most[1][0]), band, len(same) > 1, best_hz, NEARBY)
    return c.Figure(lines, paragraph("report.slices", *shown) + extra)
