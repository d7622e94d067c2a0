"""The landscape of ω_b*(θ) of a run: its data from surrogate and store, and its words."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.drawing.content import Landscape
from ccd_casadi.inner_problem.constraints import unmet
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.true_samples import Truths, feasible
from ccd_casadi.support.units import HZ, number
from surrogates import GaussianProcess

GRID = 25  # points per parameter of a landscape
COARSER = 17  # the same where there are many samples
MANY = 80  # samples with gradients above which it is that


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
    plant = plant_of(problem)
    if plant.constraint_names:
        bad = [bool(unmet(problem, tuple(place))) for place in thetas]
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
        if feasible(problem, s):
            best[s.theta] = max(best.get(s.theta, 0.0), s.bandwidth / HZ)
    return best


def caption_landscape(land: Landscape, best_hz: float) -> str:
    """What the colours and the dots are, and what the field leaves out."""
    if not land.bandwidth_hz.size:
        return (
            "No surrogate is of ω_b*(θ) alone: the large dots are the θ where a synthesis met "
            "S_max and S_low, in the colour of the best ω_b found there (ω_b* is at least "
            f"that), {len(land.truths)} of them; at the {len(land.designs)} small ones none did. "
            f"The verified design (★) has {number(best_hz)} Hz."
        )
    field = land.bandwidth_hz
    inside = np.isfinite(field) & ~land.outside
    known = field[inside] if inside.any() else field
    limited = " inside the last trust region" if land.outside.any() else ""
    words = (
        f"ω_b*(θ), the surrogate: {number(float(known.min()), 4)} to "
        f"{number(float(known.max()), 4)} Hz{limited}; the verified design (★) has "
        f"{number(best_hz)} Hz."
    )
    if land.outside.any():
        words += (
            f" Pale: outside the last trust region ({100.0 * land.outside.mean():.0f} % of the "
            "grid), where the last surrogate was not asked to be right; believe the dots there."
        )
    if land.forbidden is not None and land.forbidden.any():
        words += f" Hatched: a constraint on θ forbids {100.0 * land.forbidden.mean():.0f} %."
    return words


def caption_disagreement(
    problem: CoDesignProblem,
    process: GaussianProcess | None,
    truths: Truths,
    design: tuple[float, ...],
) -> str:
    """How far the surrogate's ω_b* is from the true one where it was not fitted to it."""
    if process is None:
        return ""
    known = np.isfinite(truths.bandwidth_hz)
    unit = (truths.theta - process.lower) / (process.upper - process.lower)
    gaps = np.abs(unit[:, None, :] - process.X[None, :, :]).max(axis=2)
    known &= gaps.min(axis=1) > 1e-9  # it interpolates its own samples
    if not known.any():
        return ""
    theta, truth = truths.theta[known], truths.bandwidth_hz[known]
    error = 100.0 * np.abs(process.predict(theta) / HZ / truth - 1.0)
    worst = int(error.argmax())
    place = ", ".join(
        f"{name} = {number(float(v), 4)}"
        for name, v in zip(problem.names, theta[worst], strict=True)
    )
    width = np.subtract(problem.upper, problem.lower)
    away = float((np.abs(theta - np.array(design)) / width).max(axis=1).min())
    return (
        f" Where the true ω_b* is known besides ({len(error)} θ, the nearest "
        f"{100.0 * away:.2g} % of the box away from the design) it is off by at most "
        f"{number(float(error[worst]), 2)} % (at {place}), {number(float(np.median(error)), 2)} % "
        "in the median."
    )
