"""ω_b*(θ) over the hardware: its data from surrogate and store, a map of two parameters or a
slice along each, and the words.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ccd_casadi.drawing.content import Band, Curve, Figure, Landscape, Level, Lines, Panel
from ccd_casadi.drawing.svg import GREEN, GREY, axis_label
from ccd_casadi.inner_problem.objective import violated
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.facts import paragraph, theta_axes
from ccd_casadi.sampling.rows import Sample, best_key, hashes_of, sample_key
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.units import HZ, number
from surrogates import GaussianProcess
from surrogates.gaussian_process import TWO_SIDED_95

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
    """Everything in the store that belongs to this problem (a folder may have seen others)."""
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
    """The surrogate of ω_b*(θ) in rad/s; None where those of a run are of other things."""
    one = processes[0] if len(processes) == 1 else None
    return one if isinstance(one, GaussianProcess) else None


def landscape_data(
    problem: CoDesignProblem,
    process: GaussianProcess | None,
    truths: Truths,
    radius: float = 1.0,
    theta: Sequence[float] = (0.0, 0.0),
    axes: tuple[int, int] = (0, 1),
) -> Landscape:
    """The landscape over two parameters, the others as at θ; `radius` (a share of the box) of the
    trust region about it."""
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
        bad = [bool(violated(problem, tuple(place))) for place in thetas]
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
    return Landscape(
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
    """θ -> true ω_b* in Hz; without a surrogate of it the largest of the feasible designs there."""
    if process is not None:
        return dict(zip(map(tuple, truths.theta.tolist()), truths.bandwidth_hz, strict=True))
    best: dict[tuple[float, ...], float] = {}
    for s in truths.designs:
        if s.certified and problem.inner.excess(s) <= 1e-9:  # to the surrogates' margin
            best[s.theta] = max(best.get(s.theta, 0.0), s.bandwidth / HZ)
    return best


def caption_landscape(land: Landscape, best_hz: float) -> str:
    """What the colours and the dots are, and what the field leaves out."""
    field = land.bandwidth_hz
    inside = np.isfinite(field) & ~land.outside
    known = field[inside] if inside.any() else field
    ends = (float(known.min()), float(known.max())) if field.size else None
    return paragraph("report.landscape", land, ends, best_hz)


def caption_disagreement(process: GaussianProcess | None, truths: Truths) -> str:
    """How far the surrogate's ω_b* is from the true one where it was not fitted to it."""
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
