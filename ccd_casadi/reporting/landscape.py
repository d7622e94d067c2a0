"""The landscape of ω_b*(θ) of a run: its data from surrogates and store, its words and tables."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.drawing.content import Landscape, Table
from ccd_casadi.drawing.svg import axis_label
from ccd_casadi.inner_problem.constraints import unmet
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.lifted_maximum import inner_maximum
from ccd_casadi.reporting.true_samples import Truths, feasible
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, number
from surrogates import GaussianProcess
from surrogates.quality import Missed

GRID = 25  # points per parameter of a landscape
COARSER = 17  # the same where there are many samples
MANY = 80  # samples with gradients above which it is that
TABLE_STEP = 4  # of the grid, in the table


def predicted(
    problem: CoDesignProblem, processes: tuple[GaussianProcess, ...], thetas: Array, std: bool
) -> tuple[Array, Array]:
    """ω_b*(θ) in Hz by the surrogates of either formulation, and its deviation if asked (else 0).

    For the lifted ones that of ω_b at the design that maximises it.
    """
    if len(processes) == 1:
        points, bandwidth = thetas, processes[0].predict(thetas)
    else:
        best = inner_maximum(problem, processes, thetas)
        points, bandwidth = best.x, best.bandwidth
    deviation = np.zeros(len(thetas))
    known = np.isfinite(bandwidth)
    if std and known.any():
        deviation[known] = processes[0].predict(points[known], return_std=True)[1]
    return bandwidth / HZ, deviation / HZ


def landscape_data(
    problem: CoDesignProblem,
    processes: tuple[GaussianProcess, ...],
    truths: Truths,
    radius: float = 1.0,
    theta: Sequence[float] = (0.0, 0.0),
    axes: tuple[int, int] = (0, 1),
) -> Landscape:
    """The landscape over two parameters, the others as at θ; `radius` (a share of the box) of the
    trust region about it."""
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    count = GRID if not processes or len(processes[0].X) <= MANY else COARSER
    first, second = (np.linspace(lower[k], upper[k], count) for k in axes)
    thetas = np.tile(np.asarray(theta, float), (count * count, 1))
    thetas[:, axes] = np.stack(np.meshgrid(first, second, indexing="ij"), -1).reshape(-1, 2)
    field = np.empty((0, 0))
    if processes:
        field = predicted(problem, processes, thetas, std=False)[0].reshape(count, count)
    forbidden = None
    plant = plant_of(problem)
    if plant.constraint_names:
        bad = [bool(unmet(problem, tuple(place))) for place in thetas]
        forbidden = np.array(bad).reshape(count, count)
    region = None
    if radius < 1.0:
        half, at = radius * (upper - lower), np.asarray(theta)
        low, high = np.maximum(lower, at - half), np.minimum(upper, at + half)
        region = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    label = "true ω_b*(θ), same colours"
    known = {
        tuple(t): float(hz)
        for t, hz in zip(truths.theta.tolist(), truths.bandwidth_hz, strict=True)
    }
    if not processes:
        known, label = best_designs(problem, truths), "best feasible ω_b, same colours"
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
        truth_label=label,
        forbidden=forbidden,
        region=region,
    )


def best_designs(problem: CoDesignProblem, truths: Truths) -> dict[tuple[float, ...], float]:
    """θ -> the largest ω_b in Hz of the feasible designs there: ω_b* is at least that."""
    best: dict[tuple[float, ...], float] = {}
    for s in truths.designs:
        if feasible(problem, s):
            best[s.theta] = max(best.get(s.theta, 0.0), s.bandwidth / HZ)
    return best


def caption_landscape(
    land: Landscape, best_hz: float, *, lifted: bool, error_hz: float = 0.0
) -> str:
    """Range, and the steepest place where the surrogate's own error leaves one to be told."""
    if not land.bandwidth_hz.size:
        return (
            "The direct formulation makes no surrogate: the large dots are the θ where a synthesis "
            "met S_max and S_low, in the colour of the best ω_b found there (ω_b* is at least "
            f"that), {len(land.truths)} of them; at the {len(land.designs)} small ones none did. "
            f"The verified design (★) has {number(best_hz)} Hz."
        )
    field = land.bandwidth_hz
    inside = np.isfinite(field) & ~land.outside
    known = field[inside] if inside.any() else field[np.isfinite(field)]
    if not known.size:
        return "The surrogates have no feasible design anywhere on the grid."
    where = "computed from the lifted surrogates by maximising ω_b over (ω_S, ω_T) at each θ"
    limited = " inside the last trust region" if land.outside.any() else ""
    words = (
        f"ω_b*(θ), {where if lifted else 'the surrogate'}: {number(float(known.min()), 4)} to "
        f"{number(float(known.max()), 4)} Hz{limited}; the verified design (★) has "
        f"{number(best_hz)} Hz."
    )
    if land.outside.any():
        words += (
            f" Pale: outside the last trust region ({100.0 * land.outside.mean():.0f} % of the "
            "grid), where the last surrogate was not asked to be right; believe the dots there."
        )
    else:
        words += _steepest(land, error_hz)
    share = np.isnan(field).mean()
    if share > 0.0:
        words += f" Grey: no feasible design ({100.0 * share:.0f} % of the grid)."
    if land.forbidden is not None and land.forbidden.any():
        words += f" Hatched: a constraint on θ forbids {100.0 * land.forbidden.mean():.0f} %."
    return words


def _steepest(land: Landscape, error_hz: float) -> str:
    """Where the field changes most between neighbours, if by more than it may err there."""
    steps = [np.abs(np.diff(land.bandwidth_hz, axis=k)) for k in range(2)]
    steps = [step if np.isfinite(step).any() else np.zeros_like(step) for step in steps]
    k = int(np.nanmax(steps[1]) > np.nanmax(steps[0]))
    largest = float(np.nanmax(steps[k]))
    if largest <= 2.0 * error_hz:  # a difference of two values
        return ""
    i, j = (int(v) for v in np.unravel_index(np.nanargmax(steps[k]), steps[k].shape))
    usual = max(float(np.nanmedian(step)) for step in steps)
    axis = land.first if k == 0 else land.second
    width = float(axis[1] - axis[0])
    ratio = largest / max(usual, 1e-12)
    return (
        " By the surrogate the steepest place is at "
        f"{land.names[0]} = {number(float(land.first[i]), 4)}, "
        f"{land.names[1]} = {number(float(land.second[j]), 4)}: {number(largest, 3)} Hz over "
        f"{number(width, 3)} {land.units[k]} of {land.names[k]}, {ratio:.0f} times the usual."
    )


def caption_disagreement(
    problem: CoDesignProblem,
    processes: tuple[GaussianProcess, ...],
    truths: Truths,
    design: tuple[float, ...],
    missed: Missed | None = None,
) -> str:
    """How far the surrogate's ω_b* is from the true one where it was not fitted to it.

    `missed`: by how much the samples around the design do so, left out.
    """
    if not processes:
        return ""
    process = processes[0]
    words = (
        f" The surrogate of ω_b was fitted to {len(process.X)} samples"
        f"{' with gradients' if process.has_gradients else ''}; left out one by one, they are "
        f"predicted to {number(process.loo.rms / HZ, 2)} Hz (root mean square)."
    )
    if missed is not None:
        words += (
            f" Left out, {missed.where} is missed by {number(abs(missed.error), 2)} Hz: around the "
            "design believe the colours, and their slope, no better than that."
        )
    known = np.isfinite(truths.bandwidth_hz)
    if len(processes) == 1:  # it interpolates its own samples
        unit = (truths.theta - process.lower) / (process.upper - process.lower)
        gaps = np.abs(unit[:, None, :] - process.X[None, :, :]).max(axis=2)
        known &= gaps.min(axis=1) > 1e-9
    if not known.any():
        return words
    theta, truth = truths.theta[known], truths.bandwidth_hz[known]
    error = 100.0 * np.abs(predicted(problem, processes, theta, std=False)[0] / truth - 1.0)
    if not np.isfinite(error).any():
        return words
    worst = int(np.nanargmax(error))
    place = ", ".join(
        f"{name} = {number(float(v), 4)}"
        for name, v in zip(problem.names, theta[worst], strict=True)
    )
    size = number(float(error[worst]), 2)
    width = np.array(problem.upper) - np.array(problem.lower)
    away = float((np.abs(theta - np.array(design)) / width).max(axis=1).min())
    near = f"; the nearest of them is {100.0 * away:.2g} % of the box away from the design"
    if len(error) == 1:
        return (
            f"{words} At the one other θ whose true ω_b* is known ({place}) it is off by {size} %"
            f"{near}."
        )
    return (
        f"{words} At the {len(error)} other θ whose true ω_b* is known it is off by at most {size} "
        f"% (at {place}), {number(float(np.nanmedian(error)), 2)} % in the median{near}."
    )


def tables_landscape(land: Landscape) -> tuple[Table, ...]:
    """The grid, thinned, and the true samples."""
    tables = []
    first, second = land.names
    if land.bandwidth_hz.size:
        thinned = slice(0, None, TABLE_STEP)
        heads = (number(float(value)) for value in land.second[thinned])
        values = land.bandwidth_hz[thinned, thinned].T
        head = (f"ω_b* in Hz; {first} ↓ {second} →", *heads)
        tables.append(Table.of(head, land.first[thinned], *values))
    head = (axis_label(first, land.units[0]), axis_label(second, land.units[1]), "true ω_b* (Hz)")
    return (*tables, Table.of(head, *land.truths.T))
