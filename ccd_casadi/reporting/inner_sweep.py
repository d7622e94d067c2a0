"""The inner problem at the optimum: ω_b over (ω_S, ω_T) from the store, or from the surrogates."""

from collections.abc import Mapping

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from ccd_casadi.drawing.content import Figure, SweepMap, Table
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.lifted_maximum import fields
from ccd_casadi.reporting.true_samples import Truths, feasible
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, number
from surrogates import GaussianProcess

LEAST_ROWS = 9
GRID = 101
LIFTED = "contours from the lifted surrogates, dots true"
LINEAR = "contours interpolated linearly between the dots"
NO_FIELD = "the dots alone"


def sweep_data(
    problem: CoDesignProblem,
    processes: tuple[GaussianProcess, ...],
    truths: Truths,
    theta: tuple[float, ...],
    optimum: tuple[float, float, float],
) -> SweepMap | None:
    """The map at θ, `optimum` = (ω_S, ω_T, ω_b) in Hz; None where too few syntheses are known."""
    samples = [s for s in truths.near(problem, theta) if s.certified]
    if len(samples) < LEAST_ROWS:
        return None
    rows = np.array([
        (s.omega_S / HZ, s.omega_T / HZ, s.bandwidth / HZ, s.sensitivity_peak, s.sensitivity_low,
         float(feasible(problem, s)))
        for s in samples
    ])  # fmt: skip
    inner = problem.inner
    axes = [np.geomspace(*ends, GRID) for ends in (inner.omega_S, inner.omega_T)]
    limits = inner.levels
    source, field = LINEAR, None
    if len(processes) > 1:
        source = LIFTED
        field = fields(processes, np.array([theta]), *map(np.log, axes))[:, 0]
    else:
        # besides the peak, whichever bound is nearest to being passed
        others = [
            [np.log(getattr(s, name) / bound) for name, bound in list(inner.bounds.values())[1:]]
            for s in samples
        ]
        field = _interpolated(rows, limits[1] + np.max(others, axis=1), axes)
    named, empty = " or ".join(list(inner.bounds)[1:]), np.empty((0, 0))
    omega_S, omega_T = (axis / HZ for axis in axes)
    if field is None:
        return SweepMap(rows, omega_S, omega_T, empty, empty, empty, optimum, NO_FIELD, named)
    peak, low = field[1] - limits[0], (field[2:] - limits[1:, None, None]).max(0)
    return SweepMap(rows, omega_S, omega_T, field[0] / HZ, peak, low, optimum, source, named)


def _interpolated(rows: Array, low: Array, axes: list[Array]) -> Array | None:
    """ω_b, ln‖S‖∞ and `low` between the rows, linear in logarithms; None if they span no area."""
    places = np.log(HZ * rows[:, :2])
    values = np.column_stack([HZ * rows[:, 2], np.log(rows[:, 3]), low])
    # refinements pile up near the optimum; triangles between them are only rounding
    _, first = np.unique(np.round(places, 3), axis=0, return_index=True)
    logs = [np.log(axis) for axis in axes]
    # the box's ends come back from the store with a rounding error, just outside the hull
    inside = [
        np.clip(g, lo, hi) for g, lo, hi in zip(logs, places.min(0), places.max(0), strict=True)
    ]
    near = [np.where(np.abs(g - c) <= 1e-6, c, g) for g, c in zip(logs, inside, strict=True)]
    try:
        between = LinearNDInterpolator(places[first], values[first])
    except QhullError:
        return None
    points = np.stack(np.meshgrid(*near, indexing="ij"), -1)
    return np.moveaxis(between(points), -1, 0)


def sweep_figure(sweep: SweepMap, bounds: Mapping[str, float]) -> Figure:
    """The map with its words and numbers."""
    return Figure(sweep, _caption(sweep, bounds), (_table(sweep),))


def _caption(sweep: SweepMap, bounds: Mapping[str, float]) -> str:
    """How many syntheses, how many feasible, and what S_max costs."""
    inside = sweep.rows[:, 5] > 0.5
    given = [f"{name} = {bound:g}" for name, bound in bounds.items()]
    words = (
        f"{len(inside)} certified syntheses at the optimal θ, {int(inside.sum())} of them within "
        f"{', '.join(given[:-1])} and {given[-1]} ({sweep.source}). The optimum (★) lies at "
        f"ω_S = {number(sweep.optimum[0], 4)} Hz, ω_T = {number(sweep.optimum[1], 4)} Hz."
    )
    if (~inside).any():
        hz = float(sweep.rows[~inside, 2].max())
        if hz > sweep.optimum[2]:
            worst = sweep.rows[~inside][sweep.rows[~inside, 2].argmax()]
            words += (
                f" Without these bounds there would be up to {number(hz, 4)} Hz, at "
                f"‖S‖∞ = {number(float(worst[3]), 4)}."
            )
    if sweep.bandwidth_hz.size:
        known = np.isfinite(sweep.peak)
        bad = known & (np.maximum(sweep.peak, sweep.low) > 0.0)
        words += f" Infeasible (hatched): {100.0 * bad.sum() / known.sum():.0f} % of the box shown."
    return words


def _table(sweep: SweepMap) -> Table:
    """Every synthesis at the optimum."""
    head = ("ω_S Hz", "ω_T Hz", "ω_b Hz", "‖S‖∞", "|S(ω_low)|", "feasible")
    return Table(
        head, tuple((*map(float, row[:5]), "yes" if row[5] else "no") for row in sweep.rows)
    )
