"""Every local peak of S, KS, T and GS on every plant against its bound, with exact derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.loop_problem import (
    Assessment,
    Columns,
    Constraints,
    LoopCurve,
    LoopProblem,
    RowPlaces,
)
from ccd_casadi.fixed_structure.plant_set import all_stable, closed_loops
from ccd_casadi.kernels.loop_grid import NONE, Answers, find_unseen, maxima, merge, second
from ccd_casadi.kernels.loop_point import LoopArrays, close, levels, rows
from ccd_casadi.kernels.modes import form_slopes
from ccd_casadi.lti.frequency_grid import RootOptions
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import side_by_side


@dataclass(frozen=True)
class PeakOptions:
    """Numbers of the search for peaks; levels are ln of a gain over its bound.

    Sorted singular values may have two maxima between neighbours of the grid, where the smooth ones
    cross, or one and a crossing, past which the slope has no change of sign: brackets of a maximum
    above -`crossing_level` are evaluated again at `crossing_points` and at the maximum (an even
    number: the middle of a regular grid's bracket is the maximum itself).
    """

    hidden: float = 1e-2  # ln below a bound within which a maximum between grid points is sought
    top: float = 1e3  # over the last root: curves are there what they are at infinity but for 1e-6
    apart: float = 1e-8  # relative: grid points that are closer count as one
    iterations: int = 40  # in a peak's bracket at most; most need four, a curve's kink all
    slope: float = 1e-9  # at a maximum
    width: float = 1e-6  # of its first width: a bracket that is left alone, as at a kink
    crossing_level: float = 0.1
    crossing_points: int = 12
    # Lower peaks are none of ours: of several channels above that of S = I, whose singular values
    # ripple around 1 wherever the loop has no gain.
    depth: float = -1.0
    depth_of_several: float = -0.4
    near: float = 0.5  # ln below a bound within which points of the base grid count too
    near_of_several: float = 0.4
    halved: int = 2000  # grid points, of all plants, from which two threads save time: 2 ms


@dataclass(frozen=True)
class Brackets(Columns):
    """Local maxima: curve, row, where on a grid, and the neighbours there."""

    curve: np.ndarray
    row: np.ndarray
    start: Array
    low: Array
    high: Array


def frequency_grid(
    problem: LoopProblem, roots: np.ndarray, poles: np.ndarray,
    options: PeakOptions = PeakOptions(),
) -> tuple[Array, np.ndarray, Answers]:  # fmt: skip
    """The frequencies v (P, k), ascending, on which peaks are searched; which are of the base, and
    what the plants answer there.

    `roots`: the zeros and the poles of K. A loop may be faster than the base: the grid extends past
    its last root.
    """
    fixed, base = problem.fixed, problem.base
    own, ends = roots[np.abs(roots) > 0.0], (float(base[0]), float(base[-1]))
    v, place = merge(
        fixed, own, poles, np.array(RootOptions.flanks), ends, options.apart, options.top
    )
    return v, (place >= 0) & (place < len(base)), Answers(place, *problem.answers)


def local_peaks(
    loop: LoopArrays, curves: np.ndarray, v: Array, value: Array, depth: float, begin: Array,
    end: Array, options: PeakOptions = PeakOptions(),
) -> Brackets:  # fmt: skip
    """The local maxima above `depth` of the levels `value` at v (P, k).

    Brackets start at `begin` and stop at `end` (C, numbers) in v; those near their bounds are
    narrowed where singular values may cross.
    """
    P, first = len(v), loop.out.shape[1]
    places, beside = maxima(value, v, end, depth)
    i, at, c, k = places.T
    low = np.maximum(beside[:, 0], begin[c, k])
    found = Brackets(curves[c], i + k * P, v[i, at], low, beside[:, 1])
    if first == 1:
        return found
    close = options.crossing_level
    near = np.flatnonzero((value[i, at, c, k] > -close) & (found.low < found.high))
    inside = np.geomspace(found.low[near], found.high[near], options.crossing_points, axis=1)
    inside = np.sort(np.concatenate([inside, found.start[near, None]], axis=1), axis=1)
    level = levels(found.curve[near, None], i[near], inside, loop, -2.0 * close, NONE)
    return split(found, near, inside, level[:, :, 0], P, first)


def hidden_peaks(
    curves: np.ndarray, v: Array, value: Array, options: PeakOptions = PeakOptions()
) -> Brackets:
    """Steps of the grid near a bound in which a flat maximum may lie that no grid point shows."""
    found, ends = find_unseen(value, v, -options.hidden)
    (i, c, k), (low, end) = found.T, ends.T
    return Brackets(curves[c], i + k * len(v), end, low, end)


def split(
    brackets: Brackets, near: np.ndarray, inside: Array, level: Array, P: int, first: int
) -> Brackets:
    """Brackets with those `near` narrowed by the levels (N, k, numbers) inside, (N, k) in v;
    several maxima in one come apart.

    A maximum of σ_k+1 where smooth ones cross has one of σ_k beside it, which the grid may miss.
    """
    known = brackets.only(near)

    def tops(row: np.ndarray) -> np.ndarray:
        own = level[np.arange(len(near)), :, row // P]
        return np.asarray((own[:, 1:-1] >= own[:, :-2]) & (own[:, 1:-1] > own[:, 2:]))

    def bracketed(row: np.ndarray, top: np.ndarray) -> Brackets:
        i, m = np.nonzero(top)
        return Brackets(known.curve[i], row[i], inside[i, m + 1], inside[i, m], inside[i, m + 2])

    own = tops(known.row)
    kept = np.setdiff1d(np.arange(len(brackets.row)), near[own.any(axis=1)])
    crossed = (known.row >= P) & (known.row < first * P)
    above = np.where(crossed, known.row - P, known.row)
    beside = tops(above) & crossed[:, None]
    # no maximum twice
    same = (above[:, None] == brackets.row) & (known.curve[:, None] == brackets.curve)
    x = inside[:, 1:-1, None]
    beside &= ~(same[:, None] & (brackets.low <= x) & (x <= brackets.high)).any(axis=2)
    return brackets.only(kept).and_those(bracketed(known.row, own), bracketed(above, beside))


def closed_on_peaks(
    loop: LoopArrays, peaks: Brackets, options: PeakOptions = PeakOptions()
) -> tuple[Array, np.ndarray]:
    """The maxima in brackets, and which of them lie inside."""
    P, rules = len(loop.terms), (options.slope, options.width, float(options.iterations))
    number, plant = np.divmod(peaks.row, P)
    given = (peaks.curve, number, plant, peaks.start, peaks.low, peaks.high)
    parts = side_by_side(
        lambda some: close(*(each[some] for each in given), loop, rules),
        _halves(len(plant), 16 * len(plant) >= options.halved),  # a peak takes as long as 16
    )
    top, closed = map(np.concatenate, zip(*parts, strict=True))
    return top, closed


def _halves(count: int, many: bool) -> list[slice]:
    """The rows of something for two threads, or for one where these are not `many`."""
    return [slice(0, count // 2), slice(count // 2, count)] if many else [slice(0, count)]


@dataclass(frozen=True)
class HessianOptions:
    """Numbers of the rows' second derivatives.

    Attributes
    ----------
    step : float
        Of ln v.
    parameter_step : float
        Of a parameter's range: far less than a half width's worth.
    unlike : float
        Relative: by how much the orders of a mixed difference may disagree.
    """

    step: float = 1e-5
    parameter_step: float = 1e-6
    unlike: float = 0.1


@singledispatch
def assess(
    problem: LoopProblem,
    kappa: Array,
    tau: float,
    *,
    depth: float | None = None,
    each: bool = False,
    options: PeakOptions = PeakOptions(),
) -> Assessment:
    """Assess a controller on every plant: stability by eigenvalues, then the constraints.

    Parameters
    ----------
    problem : LoopProblem
        Dispatches: models, parts of several channels (`composite`), measured lines.
    kappa, tau : array (n,), float
        κ in the problem's units; ln(ω_b/ω₀).
    depth : float, optional
        Constraints c > depth are found; by default that of `options`.
    each : bool
        The constraints of unstable loops are given too, where some loop is stable.
    options : PeakOptions

    Returns
    -------
    Assessment
        Without constraints where a loop is unstable.
    """
    plants = problem.plants
    poles = closed_loops(plants, problem.structure, kappa)[0]
    good = all_stable(poles)
    if not good.any() if each else not good.all():
        return Assessment(False, poles, None, None)
    several = len(plants.out) > 1
    within = options.near_of_several if several else options.near
    if depth is None:
        depth = options.depth_of_several if several else options.depth
    v, regular, answers = frequency_grid(problem, problem.roots(kappa), poles, options)
    P, curves, loop = len(v), np.array(problem.curves, np.int64), problem.loop(kappa, tau)
    crossing = plants.variable(np.exp(tau + problem.leads))  # by number
    end = np.where(problem.short[:, None], crossing, np.inf)
    every = np.arange(P)
    tiled, least = np.tile(curves, (P, 1)), min(depth, -within)
    parts = side_by_side(
        lambda some: levels(
            tiled[some], every[some], v[some], loop, least,
            answers._replace(place=answers.place[some]),
        ),
        _halves(P, v.size >= options.halved),
    )  # fmt: skip
    value = np.concatenate(parts)
    begin = np.where(problem.late[:, None], crossing, 0.0)
    counts = (begin <= v[..., None, None]) & (v[..., None, None] <= end)
    value = np.where(counts, value, -np.inf)
    peaks = local_peaks(loop, curves, v, value, depth, begin, end, options)
    peaks = peaks.and_those(hidden := hidden_peaks(curves, v, value, options))
    top, closed = closed_on_peaks(loop, peaks, options)
    # An open end at ω_b is the crossing, from either side; one at the lowest frequency is a row.
    low_end = peaks.start < 0.1 * crossing[peaks.row // P]
    above = peaks.low <= np.where(np.isin(peaks.curve, curves[problem.late]),
                                  crossing[peaks.row // P], 0.0)  # fmt: skip
    whole = closed | ~(above | np.isin(peaks.curve, curves[problem.short])) | low_end
    sought = np.arange(len(whole)) >= len(whole) - len(hidden.row)
    whole = np.where(sought, closed, whole)
    curve, row, at = [peaks.curve[whole]], [peaks.row[whole]], [top[whole]]
    low = plants.variable(np.full(len(crossing), problem.low))
    for end_curve, place in ((LoopCurve.S_LOW, low), (LoopCurve.CROSSING, crossing)):
        numbers = np.flatnonzero(np.isfinite(problem.limits[end_curve]))
        row.append((numbers[:, None] * P + every).ravel())
        curve.append(np.full(len(row[-1]), end_curve))
        at.append(np.repeat(place[numbers], P))
    i, j, c, k = np.nonzero(regular[..., None, None] & (value > -within))
    found = constraints(problem, kappa, tau, RowPlaces(*map(np.concatenate, (curve, row, at))))
    return Assessment(True, poles, found, RowPlaces(curves[c], i + k * P, v[i, j]))


@singledispatch
def constraints(problem: LoopProblem, kappa: Array, tau: float, at: RowPlaces) -> Constraints:
    """Compute values and derivatives of constraints.

    Parameters
    ----------
    problem : LoopProblem
    kappa : array (n,)
    tau : float
        ln ω_b in the problem's units.
    at : RowPlaces
        M of them.

    Returns
    -------
    Constraints
    """
    value, slope, to_kappa, *_ = evaluate_rows(problem, kappa, tau, at)
    to_tau = problem.to_tau(at, tau)
    end = at.curve == LoopCurve.CROSSING
    to_tau[end] = slope[end] / problem.plants.chain(at.v[end])
    return Constraints(at.curve, at.plant, at.v, value + problem.margin, to_kappa, to_tau)


def evaluate_rows(problem: LoopProblem, kappa: Array, tau: float, at: RowPlaces) -> Any:
    """Evaluate these rows by `kernels.loop_rows.rows`; without the margin."""
    number, plant = np.divmod(at.plant, problem.plants.count)
    return rows(at.curve, number, plant, at.v, problem.loop(kappa, tau))


@singledispatch
def to_theta(problem: LoopProblem, kappa: Array, constraints: Constraints) -> Array:
    """Differentiate constraints to the plants' parameters at fixed κ, τ and frequency.

    Parameters
    ----------
    problem, kappa : LoopProblem, array (n,)
        Plants that carry derivatives; κ in the problem's units.
    constraints : Constraints
        M of them.

    Returns
    -------
    array (M, n_θ)
        ∂c/∂θ.
    """
    slopes, v, which = problem.plants.driven.slopes, constraints.v, problem.plants_of(constraints)
    *_, x, y, right = evaluate_rows(problem, kappa, 0.0, constraints)
    out = form_slopes(slopes, which, v, x, y, False)
    free = constraints.curve == LoopCurve.GS
    if free.any():
        slopes = problem.plants.forced.slopes
        out[free] += form_slopes(slopes, which[free], v[free], -x[free], right[free], True)
    return np.asarray(out)


@singledispatch
def hessians(
    problem: LoopProblem,
    kappa: Array,
    tau: float,
    rows: Constraints,
    beside: Sequence[LoopProblem] = (),
    options: HessianOptions = HessianOptions(),
) -> Array:
    """Find the second derivatives of constraints c_j whose frequencies move with the peaks.

        ∂²c/∂y∂yᵀ + c_xyᵀc_xy/(-c_xx),   x = ln v, y = (z, κ, τ)      at a maximum of c over x

    Parameters
    ----------
    problem, kappa, tau : LoopProblem, array (n,), float
        As for `assess`.
    rows : Constraints
        M of them.
    beside : sequence of LoopProblem
        The k problems whose plants are moved by `options.parameter_step` along each z.
    options : HessianOptions

    Returns
    -------
    array (M, k + n + 1, k + n + 1)
        To (z, κ, τ); 0 of rows whose singular values cross there.
    """
    k, n, m, P = len(beside), len(kappa), len(rows.v), problem.plants.count
    step, moved_by = options.step, options.parameter_step
    out = np.zeros((m, k + n + 1, k + n + 1))
    if not m:
        return out
    loop = problem.loop(kappa, tau)
    out[:, k:-1, k:-1] = second(rows.curve, rows.plant // P, rows.plant % P, rows.v, loop)
    v = (rows.v * np.exp([[0.0], [step], [-step]])).ravel()
    around = RowPlaces(np.tile(rows.curve, 3), np.tile(rows.plant, 3), v)
    found = evaluate_rows(problem, kappa, tau, around)
    slopes, to_kappa = found[1].reshape(3, m), found[2].reshape(3, m, n)
    slope, own = slopes[0], to_kappa[0]
    c_xx, c_xk = ((part[1] - part[2]) / (2.0 * step) for part in (slopes, to_kappa))
    end = rows.curve == LoopCurve.CROSSING
    fixed = end | (rows.curve == LoopCurve.S_LOW)
    top = ~fixed & (c_xx < 0.0) & (np.abs(slope) < 1e-3 * np.sqrt(np.abs(c_xx)))
    c_xz, smooth = np.zeros((m, k)), np.ones(m, bool)
    if beside:
        to_z = to_theta(problem, kappa, rows)
        for i, other in enumerate(beside):
            moved = evaluate_rows(other, kappa, tau, rows)
            c_xz[:, i] = (moved[1] - slope) / moved_by
            out[:, i, k:-1] = out[:, k:-1, i] = (moved[2] - own) / moved_by
            out[:, i, :k] = (to_theta(other, kappa, rows) - to_z) / moved_by
        out[:, :k, :k] = 0.5 * (out[:, :k, :k] + out[:, :k, :k].transpose(0, 2, 1))
        # Where singular values cross no difference means anything: its two orders disagree.
        up, down = (to_theta(problem, kappa, replace(rows, v=rows.v * np.exp(x)))
                    for x in (step, -step))  # fmt: skip
        c_zx = (up - down) / (2.0 * step)
        unlike = np.abs(c_xz - c_zx).max(axis=1)
        smooth = unlike <= options.unlike * (1.0 + np.abs(c_zx).max(axis=1))
    c_xy = np.concatenate([c_xz, c_xk], axis=1)
    shift = c_xy / np.where(top, -c_xx, np.inf)[:, None]
    out[:, :-1, :-1] += shift[:, :, None] * c_xy[:, None, :]
    # The room of a shape opens with ω/ω_b: c_ττ, and c_xτ = -c_ττ but for the warped frequency.
    closed = problem.closed_share(rows, tau)
    bending = 4.0 * closed / (1.0 - closed) ** 2
    c_xt = -bending * problem.plants.chain(rows.v)
    out[:, -1, :-1] += c_xt[:, None] * shift
    out[:, :-1, -1] += c_xt[:, None] * shift
    out[:, -1, -1] += bending + c_xt**2 / np.where(top, -c_xx, np.inf)
    if end.any():
        chain = rows.to_tau[end] / np.where(slope[end] == 0.0, 1.0, slope[end])
        out[end, :-1, -1] = out[end, -1, :-1] = chain[:, None] * c_xy[end]
        out[end, -1, -1] = chain**2 * c_xx[end]
    out[~smooth] = 0.0
    return out
