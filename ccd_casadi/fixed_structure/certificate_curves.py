"""Peaks of a set's curves on refined grids, and ω_b, as the judge finds them.

Grids run through every pole and zero of plant, controller and closed loop. Local maxima, the first
-3 dB of S and every dip of the room below the shape are closed in on by ever finer grids, those of
all plants at once: no derivative is taken, as the synthesis does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.fixed_structure.certificate_responses import LoopResponses
from ccd_casadi.lti.frequency_grid import frequency_grid, root_flanks, zoom
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.support.arrays import Array

HALF_POWER = 1.0 / np.sqrt(2.0)  # |S| at -3 dB


@dataclass(frozen=True)
class CurveOptions:
    """Numbers of the judge's grids and of the peaks on them."""

    per_decade: int = 60  # points of a grid
    flanks: tuple[float, ...] = (0.0, -0.2, 0.2, -0.5, 0.5, -1.0, 1.0, -2.0, 2.0, -5.0, 5.0)
    # ^ points around a root, in half widths
    apart: float = 1e-9  # relative: grid points that are closer count as one
    near: float = 0.9  # of the height that counts: lower maxima stay below it between points too
    finer: int = 41  # points in the bracket of such a maximum of a lesser singular value
    sections: int = 15  # of a bracket into ten parts: to rounding


def grid_through(
    roots: Sequence[np.ndarray],
    sampling: Sampling | None,
    omega_low: float,
    size: float,
    corner: float,
    options: CurveOptions = CurveOptions(),
) -> Array:
    """ω in rad/s, logarithmic and through every root with its flanks.

    `roots`: poles of the loop, of plant and controller (sampled: in z), then zeros in s. `size`:
    the plant's fastest pole; `corner`: of the weights.
    """
    values = [np.concatenate(roots)]
    if sampling is not None:
        with np.errstate(divide="ignore"):
            # Poles are in z here; those of the plant's zeros are left in s, on the same axis.
            z = np.concatenate(roots[:3])
            values = [np.log(z[z != 0.0]) / sampling.period, np.concatenate(roots[3:])]
    joint = np.concatenate(values)
    joint = joint[np.isfinite(joint) & (np.abs(joint) > 0.0)]
    slow = np.abs(joint)[np.abs(joint) > 1e-6 * size].min()
    bottom = 0.01 * min(omega_low, slow)
    top = max(300.0 * max(size, float(np.abs(joint).max())), 30.0 * corner)
    if sampling is not None:
        top = np.pi / sampling.period
    count = int(options.per_decade * np.log10(top / bottom))
    special = (root_flanks(joint, np.array(options.flanks)), np.abs(joint), np.array([omega_low]))
    # Of two points that rounding parts one may be the maximum, and its bracket end at the other.
    return frequency_grid(bottom, top, count, *special, apart=options.apart)


def pad(grids: Sequence[Array]) -> Array:
    """Grids (P, k) of one length: the shorter ones repeat their last frequency."""
    most = max(len(grid) for grid in grids)
    return np.array([np.pad(grid, (0, most - len(grid)), mode="edge") for grid in grids])


def with_crossings(
    table: LoopResponses, grid: Array, options: CurveOptions = CurveOptions()
) -> tuple[Array, dict[str, Array]]:
    """Grids (P, k), finer where a lesser singular value has a maximum that comes near the largest,
    and every curve there.

    Where it is the larger one between two points only, neither of these shows a maximum. It counts
    where it may be a peak (weighted or not), pass -3 dB first, or leave the shape least room.
    """
    rows, near = np.arange(len(grid)), options.near
    values, sizes = table.with_lesser(rows, grid)
    weights, more = table.weights(grid), [[grid[:, :0][i]] for i in rows]
    for name, matrix in sizes.items():
        largest, floor = matrix[..., -1], np.full_like(grid, np.inf)
        scales = [np.ones_like(grid), *([weights[name]] if name in weights else [])]
        if name == "S":
            scales.append(1.0 / counted_frequencies(table, grid))
            past = np.maximum.accumulate(largest > HALF_POWER, axis=1)
            floor = np.where(past, np.inf, near * HALF_POWER)
            floor[:, 1:] = np.minimum(floor[:, 1:], floor[:, :-1])  # the bracket of the first too
        for scale in scales:
            top = (scale * largest).max(axis=1, keepdims=True)
            floor = np.minimum(floor, near * top / scale)
        for lesser in np.moveaxis(matrix, -1, 0)[:-1]:
            for i, j in zip(*_maxima(grid, lesser, near * np.maximum(largest, floor)), strict=True):
                more[i].append(np.linspace(grid[i, j - 1], grid[i, j + 1], options.finer))
    new = [_apart(np.concatenate(own), grid[i], options.apart) for i, own in enumerate(more)]
    most = max(map(len, new))
    if not most:
        return grid, values
    fine = np.array([np.append(own, np.full(most - len(own), grid[i, -1]))
                     for i, own in enumerate(new)])  # fmt: skip
    joint = np.concatenate([grid, fine], axis=1)
    order = np.argsort(joint, axis=1, kind="stable")
    beside = table.at(rows, fine)
    values = {name: np.take_along_axis(np.concatenate([value, beside[name]], axis=1), order, 1)
              for name, value in values.items()}  # fmt: skip
    return np.take_along_axis(joint, order, axis=1), values


def _apart(points: Array, known: Array, apart: float) -> Array:
    """Select the points that are not within `apart` (relative) of each other or of known ones."""
    joint = np.concatenate([known, np.sort(points)])
    order = np.argsort(joint, kind="stable")
    gaps = np.diff(joint[order], prepend=-np.inf, append=np.inf)
    least = apart * joint[order]
    new = order >= len(known)
    old = np.append(~new[1:], False)  # the next one is a known one
    keep = new & (gaps[:-1] > least) & ~(old & (gaps[1:] <= least))
    return np.asarray(joint[order][keep])


def peaks(
    table: LoopResponses, grid: Array, values: dict[str, Array],
    options: CurveOptions = CurveOptions(),
) -> dict[str, tuple[Array, Array]]:  # fmt: skip
    """Every curve's largest value (P,) and its frequency, local maxima near it zoomed into.

    The brackets of all curves are evaluated at once: one response of a point serves every curve.
    """
    plants, tops, parts = np.arange(len(grid)), {}, []
    for number, (name, value) in enumerate(values.items()):
        best = np.argmax(value, axis=1)
        tops[name] = value[plants, best], grid[plants, best]
        i, j = _maxima(grid, value, options.near * tops[name][0])
        parts.append((np.full(len(i), number), i, j))
    curve, which, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    rows = np.arange(len(which))

    def own(points: Array) -> Array:
        return np.asarray(np.stack(list(table.at(which, points).values()))[curve, rows])

    where, peak = zoom(own, grid[which, at - 1], grid[which, at + 1])
    for number, (value, frequency) in enumerate(tops.values()):
        mine = rows[curve == number]
        mine = mine[np.argsort(peak[mine])]  # of those of one plant the highest is written last
        mine = mine[peak[mine] > value[which[mine]]]
        value[which[mine]], frequency[which[mine]] = peak[mine], where[mine]
    return tops


def _maxima(grid: Array, value: Array, least: Array) -> tuple[np.ndarray, np.ndarray]:
    """Plant and place of every local maximum above `least`, (P,) or (P, k), inside a grid."""
    inner, floor = value[:, 1:-1], least[:, None] if least.ndim == 1 else least[:, 1:-1]
    found = (inner >= value[:, :-2]) & (inner >= value[:, 2:]) & (inner > floor)
    i, j = np.nonzero(found & (grid[:, :-2] < grid[:, 2:]))
    return i, j + 1


def crossing_and_bandwidth(
    table: LoopResponses, grid: Array, S: Array, row: Sequence[float] | None = None,
    options: CurveOptions = CurveOptions(),
) -> tuple[Array, Array]:  # fmt: skip
    """The first ω with |S| = 1/√2 of every plant (NaN where there is none), and the largest ω_b
    that keeps the shape below it (0 there).

    S (P, k) on the grid, of the whole or of a channel's row.
    """
    # A peak between two points of the grid may pass -3 dB where both stay below.
    i, j = _maxima(grid, S, np.full(len(S), options.near * HALF_POWER))
    i, j = i[S[i, j] <= HALF_POWER], j[S[i, j] <= HALF_POWER]
    where, peak = zoom(lambda x: table.sensitivity(i, x, row), grid[i, j - 1], grid[i, j + 1])
    most = int(np.bincount(i).max(initial=0))
    more, heights = np.tile(grid[:, -1:], most), np.tile(S[:, -1:], most)
    place = np.arange(len(i)) - np.searchsorted(i, i)
    more[i, place], heights[i, place] = where, peak
    grid, S = _sorted(np.concatenate([grid, more], 1), np.concatenate([S, heights], 1))
    above = S > HALF_POWER
    crossing, bandwidth = np.full(len(S), np.nan), np.zeros(len(S))
    good = np.flatnonzero(above.any(axis=1) & ~above[:, 0])
    if not len(good):
        return crossing, bandwidth
    first = np.argmax(above[good], axis=1)
    low, high = grid[good, first - 1], grid[good, first]
    each = np.arange(len(good))
    for _ in range(options.sections):
        points = np.linspace(low, high, 11, axis=1)
        past = np.argmax(table.sensitivity(good, points, row)[:, 1:] > HALF_POWER, axis=1)
        low, high = points[each, past], points[each, past + 1]
    crossing[good], bandwidth[good] = low, low
    if table.bounds.shape is not None:
        bandwidth[good] = _within_shape(table, grid[good], S[good], good, low, row, options.near)
    return crossing, bandwidth


def _within_shape(
    table: LoopResponses,
    grid: Array,
    S: Array,
    which: np.ndarray,
    crossing: Array,
    row: Sequence[float] | None,
    near: float,
) -> Array:
    """The largest ω_b of plants `which` (P,) that keeps the shape below |S|.

    Every dip of the room h(ω), the ω_b that |S(jω)| alone allows, is closed in on: ω_b <= h(ω) for
    all ω, or only for all ω <= ω_b.
    """
    bounds = table.bounds

    def room(x: Array, S: Array) -> Array:
        return np.asarray(counted_frequencies(table, x) / bounds.reached(S / HALF_POWER))

    short = bounds.shape_ends is ShapeEnd.CROSSING
    ends = crossing if short else grid[:, -1]
    finer = np.minimum(crossing[:, None] * np.geomspace(1.0 / 30.0, 3.0, 1500), ends[:, None])
    known = np.where(grid <= ends[:, None], room(grid, S), np.inf)
    value = np.concatenate([known, room(finer, table.sensitivity(which, finer, row))], axis=1)
    omega, value = _sorted(np.concatenate([grid, finer], axis=1), value)
    i, j = _maxima(omega, -value, -crossing / near)
    where, least = zoom(lambda x: -room(x, table.sensitivity(which[i], x, row)),
                           omega[i, j - 1], np.minimum(omega[i, j + 1], ends[i]))  # fmt: skip
    dips = np.concatenate([i, np.tile(np.arange(len(which)), 2)])
    last = np.argmax(np.where(omega <= ends[:, None], omega, 0.0), axis=1)
    rows = np.arange(len(which))
    heights = np.concatenate([-least, value[:, 0], value[rows, last]])
    at = np.concatenate([where, omega[:, 0], omega[rows, last]])
    found = crossing.copy()
    if not short:
        np.minimum.at(found, dips, heights)
        return found
    for k in rows:
        own = dips == k
        pairs = list(zip(heights[own].tolist(), at[own].tolist(), strict=True))
        while broken := [(h, x) for h, x in pairs if x <= found[k] and h < found[k]]:
            height, x = min(broken)
            found[k] = height if height >= x else x * (1.0 - 1e-9)
    return found


def counted_frequencies(table: LoopResponses, omega: Array) -> Array:
    """The ω at which the shape is taken: without an integrator none below ω_low."""
    return omega if table.integrator else np.maximum(omega, table.bounds.omega_low)


def _sorted(omega: Array, value: Array) -> tuple[Array, Array]:
    """Both by ascending ω."""
    order = np.argsort(omega, axis=1, kind="stable")
    return np.take_along_axis(omega, order, axis=1), np.take_along_axis(value, order, axis=1)
