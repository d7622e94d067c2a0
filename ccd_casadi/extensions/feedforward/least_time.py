"""The coefficients with which all plants of a set settle at the earliest: convex programmes.

For a time t the least largest error that is left from t on, over the window w, is

    s(t) = min over x of s   where   |y_end - Y_i,k x| <= s w    for each plant i and k T >= t
                                     |U_i,k x| <= u_max          for each plant, motor and k
                                     ∫ |U_i x|² dt <= E          for each plant i: watts
                                     Σ h = 1,  h >= 0

Rows are linear, the heat enters by its tangents: all programmes are linear. A larger t has fewer
rows, so that s(t) does not rise, and the earliest t with s(t) <= 1 is found by bisection. It is the
optimum over all coefficients, whatever the start. Rows enter where they are violated (cutting
planes): a few of some ten thousand.

Shapers with h >= 0 never reach beyond the setpoint.

Source: on input shaping as a convex programme, Tuttle and Seering, ACC 1994; on the bisection of
quasi-convex functions, Boyd and Vandenberghe, Convex Optimization (2004), section 4.2.5.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from ccd_casadi.extensions.feedforward.move_responses import MoveResponses, Shape
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class LeastTimeOptions:
    """Numbers of the search for the least time."""

    margin: float = 0.1  # share of the window that is kept free on the plants of the design
    largest: float = 20.0  # what a coefficient moves, over the move
    first: int = 20  # rows of a plant that the first programme has, spread over all times
    added: int = 300  # rows that enter at most after each programme
    rounds: int = 40  # programmes at most for one time
    tight: float = 1e-3  # of window, force and heat: a row that is violated by less is kept


@dataclass(frozen=True)
class ForceLimits:
    """The limits of the motors in a move."""

    peak: float  # u_max of any motor, N
    heat: float  # E, N² s


@dataclass(frozen=True)
class LeastTime:
    """The result of a search for the least time."""

    x: Array  # (c,) coefficients, as of `shape`
    shape: Shape
    time: float  # from which on all plants of the design are within the window less its margin, s
    left: float  # s(t): the largest error from then on, over the window


class _Programme:
    """Rows of all plants in coefficients z = x/size of comparable size; they stay in use."""

    def __init__(
        self, error: Array, force: Array, heat: Array, end: Array, shape: Shape, size: Array,
        window: float, options: LeastTimeOptions,
    ) -> None:  # fmt: skip
        """Set up rows from `error` (plants, N, q, c), `end` (q,) and `window` over the move,
        `force` (plants, N, m, c) and `heat` (plants, c, c), |R z| <= 1, over their limits."""
        plants, N, q, c = error.shape
        self.rows, self.right = error.reshape(-1, c) / window, np.tile(end, plants * N) / window
        self.sample = np.tile(np.repeat(np.arange(N), q), plants)
        self.motors, self.heat = force.reshape(-1, c), heat
        self.options, self.count = options, c
        spread = np.linspace(0, len(self.rows) - 1, options.first * plants).astype(int)
        self.used = np.unique(spread)
        self.limits = np.zeros((0, c))  # rows of forces and tangents of heat, each <= 1
        self.total = np.append(size[: shape.taps], np.zeros(c + 1 - shape.taps))
        large = options.largest
        self.bounds = [(0.0, large)] * shape.taps + [(-large, large)] * (c - shape.taps)

    def least(self, first: int, z: Array, most: float) -> tuple[float, Array | None]:
        """s and z where errors count from sample `first` on; infinite, None: no solution, or none
        with s <= `most`."""
        counts, bound, tight = self.sample >= first, -1.0, self.options.tight
        for _ in range(self.options.rounds):
            left = np.where(counts, np.abs(self.right - self.rows @ z), 0.0)
            pushed, heats = self.motors @ z, self.heat @ z
            lengths = np.linalg.norm(heats, axis=1)
            s = float(left.max())
            over = max(float(np.abs(pushed).max()), float(lengths.max())) - 1.0
            if bound >= 0.0 and s <= bound * (1.0 + tight) + tight and over <= tight:
                return s, z
            worst = _largest(left, max(bound, 0.0), self.options.added)
            self.used = np.union1d(self.used, worst)
            strong = _largest(np.abs(pushed), 1.0, self.options.added)
            hot = _largest(lengths, 1.0, self.options.added)
            tangents = np.einsum("pi,pij->pj", heats[hot], self.heat[hot]) / lengths[hot, None]
            signed = np.sign(pushed[strong])[:, None] * self.motors[strong]
            self.limits = np.vstack([self.limits, signed, tangents])
            found = self._solve(self.used[counts[self.used]])
            if found is None or found[1] > most:  # more rows do not lower s
                break
            z, bound = found
        return np.inf, None

    def _solve(self, used: np.ndarray) -> tuple[Array, float] | None:
        """z and s of the rows in use."""
        rows, right = self.rows[used], self.right[used]
        slack = -np.ones((len(used), 1))
        A = np.vstack([
            np.hstack([-rows, slack]), np.hstack([rows, slack]),
            np.column_stack([self.limits, np.zeros(len(self.limits))]),
        ])  # fmt: skip
        found = linprog(
            np.append(np.zeros(self.count), 1.0), A_ub=A,
            b_ub=np.concatenate([-right, right, np.ones(len(self.limits))]),
            A_eq=self.total[None], b_eq=[1.0], bounds=[*self.bounds, (0.0, None)], method="highs",
        )  # fmt: skip
        return None if found.x is None else (found.x[:-1], float(found.x[-1]))


def _largest(sizes: Array, bound: float, most: int) -> np.ndarray:
    """Places of the largest values above a bound."""
    found = np.argsort(-sizes)[:most]
    return np.asarray(found[sizes[found] > bound])


def least_time(
    plants: Sequence[MoveResponses],
    shape: Shape,
    window: float,
    limits: ForceLimits,
    latest: float,
    start: Array,
    options: LeastTimeOptions = LeastTimeOptions(),
) -> LeastTime | None:
    """Find the coefficients with which the latest plant settles at the earliest.

    Plants are of one tap, `window` is w in the unit of y. `latest` is a time in s that is known to
    be late enough, or where the search ends; `start` (c,) are coefficients whose largest errors are
    the first rows. None: not even by `latest`.
    """
    shaped, period = [one.with_taps(shape) for one in plants], plants[0].period
    move = float(np.abs(plants[0].end).max())
    error = np.array([one.reached for one in shaped]) / move
    force = np.array([one.force for one in shaped]) / limits.peak
    size = 1.0 / np.abs(error).max(axis=(0, 1, 2))  # z = 1 moves what counts by the whole move
    watts = np.array([one.force for one in shaped]) * size * np.sqrt(period / limits.heat)
    heat = np.asarray(np.linalg.qr(watts.reshape(len(plants), -1, shape.count), mode="r"))
    programme = _Programme(
        error * size, force * size, heat, plants[0].end / move, shape, size, window / move,
        options,
    )  # fmt: skip
    most = 1.0 - options.margin
    low, high = 0, min(int(np.ceil(latest / period)), error.shape[1] - 1)
    s, z = programme.least(high, start / size, most)
    if z is None or s > most:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        trial, there = programme.least(middle, z, most)
        if there is not None and trial <= most:
            high, s, z = middle, trial, there
        else:
            low = middle
    return LeastTime(size * z, shape, period * high, s)
