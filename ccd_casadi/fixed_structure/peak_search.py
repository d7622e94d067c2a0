"""Every local peak of curves of a set's loops: a grid that misses none, and their exact maxima.

The grid runs through every pole and zero of plants, controller and closed loops with its flanks:
a rational function has no narrower peak than these. A local maximum on it is closed on the zero of
its exact slope.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.loop_problem import Columns, LoopProblem
from ccd_casadi.kernels.loop_grid import NONE, Answers, maxima, merged, unseen
from ccd_casadi.kernels.loop_point import LoopArrays
from ccd_casadi.kernels.loop_rows import close, levels
from ccd_casadi.lti.grid import FLANKS
from ccd_casadi.support.arrays import Array

HIDDEN = 1e-2  # ln of the share of its bound above which a maximum between grid points is sought
FAR = 1e3  # times the last root: there curves are what they are at infinity but for 1e-6
APART = 1e-8  # relative: grid points that are closer count as one
CLOSINGS = 40  # of a peak's bracket at most; most need four, a curve's kink all
FLAT = 1e-9  # slope at a maximum
NARROW = 1e-6  # of its first width: a bracket that is left alone, as at a kink
# Sorted singular values may have two maxima between neighbours of the grid, where the smooth ones
# cross, or one and a crossing, past which the slope has no change of sign: brackets of a maximum
# above -CLOSE are looked at again at so many places and at the maximum (an even number: the middle
# of a regular grid's bracket is the maximum itself).
CLOSE = 0.1
FINER = 12


@dataclass(frozen=True)
class Brackets(Columns):
    """Local maxima: curve, row, where on a grid, and the neighbours there."""

    curve: np.ndarray
    row: np.ndarray
    start: Array
    low: Array
    high: Array


def frequency_grid(
    problem: LoopProblem, roots: np.ndarray, poles: np.ndarray
) -> tuple[Array, np.ndarray, Answers]:
    """The frequencies v (P, k), ascending, on which peaks are looked for; which are of the base,
    and what the plants answer there.

    `roots`: the zeros and the poles of K. A loop may be faster than the base: the grid goes on past
    its last root.
    """
    fixed, base = problem.fixed, problem.base
    own, ends = roots[np.abs(roots) > 0.0], (float(base[0]), float(base[-1]))
    v, place = merged(fixed, own, poles, FLANKS, ends, APART, FAR)
    return v, (place >= 0) & (place < len(base)), Answers(place, *problem.answers)


def local_peaks(
    loop: LoopArrays, curves: np.ndarray, v: Array, value: Array, depth: float, begin: Array,
    end: Array,
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
    near = np.flatnonzero((value[i, at, c, k] > -CLOSE) & (found.low < found.high))
    inside = np.geomspace(found.low[near], found.high[near], FINER, axis=1)
    inside = np.sort(np.concatenate([inside, found.start[near, None]], axis=1), axis=1)
    level = levels(found.curve[near, None], i[near], inside, loop, -2.0 * CLOSE, NONE)
    return split(found, near, inside, level[:, :, 0], P, first)


def hidden_peaks(curves: np.ndarray, v: Array, value: Array) -> Brackets:
    """Steps of the grid near a bound in which a flat maximum may lie that no grid point shows."""
    found, ends = unseen(value, v, -HIDDEN)
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


def closed_on_peaks(loop: LoopArrays, peaks: Brackets) -> tuple[Array, np.ndarray]:
    """The maxima in brackets, and which of them lie inside."""
    P = len(loop.terms)
    ends = (peaks.start, peaks.low, peaks.high)
    found: tuple[Array, np.ndarray] = close(
        peaks.curve, peaks.row // P, peaks.row % P, *ends, loop, (FLAT, NARROW, float(CLOSINGS))
    )
    return found
