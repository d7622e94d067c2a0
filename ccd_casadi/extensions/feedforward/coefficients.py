"""The coefficients of a feedforward and of a shaper: what they move, the best ones, and learning.

The controller takes r̃ and f, both sums of delayed signals of one setpoint r:

    r̃_k = Σ_i h_i r_{k - i d},   f_k = Σ_i Σ_j F_ij r^(j)_{k - i d},   Σ_i h_i = 1

From rest, what a sampled loop reaches and the force of its motors are linear in x = [h, F]:

    y = Y x,   u = U x

A delay of i d samples delays a response by as much, so that each is computed once.

Learning: with the model's responses Ψ to the coefficients F of the feedforward's first tap
(columns, all instants and outputs one below the other) and the error e_j = r̃ - y in move j,

    F_{j+1} = F_j + Ψ⁺ e_j,        F_{j+1} - F* = (I - Ψ⁺ P)(F_j - F*)

where P are the true responses and F* has Ψ⁺ e = 0: the least error that the model can reach from
noise. It converges on a plant whose ρ = max |eig(I - Ψ⁺ P)| is less than 1, whatever the error is.

Source: iterative learning with basis functions, van de Wijdeven and Bosgra, Int. J. Control 83
(2010), 661-675.

All plants of a set settle at the earliest with coefficients that convex programmes find. For a time
t the least largest error that is left from t on, over the window w, is

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
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog

from ccd_casadi.analysis.move import counted_rows
from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.analysis.setpoint_feedforward import held_setpoint
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import closed_loop
from ccd_casadi.support.arrays import Array, states
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class Shape:
    """The set of coefficients of shaper and feedforward."""

    orders: tuple[int, ...]  # derivatives of the setpoint that have a force
    forces: int  # m, of the plant
    taps: int = 1  # of every signal, the first without delay
    spacing: int = 1  # d, samples from tap to tap

    @property
    def count(self) -> int:
        """The number of coefficients."""
        return self.taps * (1 + len(self.orders) * self.forces)

    @property
    def last(self) -> int:
        """Samples by which the last tap is late."""
        return (self.taps - 1) * self.spacing

    def split(self, x: Array) -> tuple[Array, Array]:
        """h (taps,) and F (taps, 5, m), by derivative of the setpoint."""
        h, rest = x[: self.taps], x[self.taps :]
        F = np.zeros((self.taps, 5, self.forces))
        F[:, self.orders] = rest.reshape(self.taps, len(self.orders), self.forces)
        return h, F

    def join(self, h: Array, F: Array) -> Array:
        """x of h (taps,) and F (taps, 5, m); fewer taps are filled with zeros."""
        more = self.taps - len(h)
        h, F = np.append(h, np.zeros(more)), np.concatenate([F, np.zeros((more, *F.shape[1:]))])
        return np.append(h, F[:, self.orders].ravel())


@dataclass(frozen=True)
class MoveResponses:
    """One plant's move, by coefficients of one tap."""

    period: float  # T, s
    reached: Array  # (N, q, c) what counts, per coefficient, unit of y; the setpoint's first
    force: Array  # (N, m, c) N
    setpoint: Array  # (N, q) wanted of it without a shaper; the last is where the move ends

    @property
    def end(self) -> Array:
        """The position where the move ends (q,)."""
        return np.asarray(self.setpoint[-1])

    def with_taps(self, shape: Shape) -> "MoveResponses":
        """Add all taps, with coefficients in the order of `Shape`."""
        return replace(
            self, reached=_add_taps(self.reached, shape), force=_add_taps(self.force, shape)
        )

    def error(self, x: Array) -> Array:
        """Compute what is left to the end of the move (N, q)."""
        return np.asarray(self.end - self.reached @ x)

    def tracking(self, x: Array, shape: Shape) -> Array:
        """The controller's error (N, q), to the shaped setpoint; with all taps."""
        h, _ = shape.split(x)
        wanted = [h[i] * _later(self.setpoint, i * shape.spacing) for i in range(shape.taps)]
        return np.asarray(sum(wanted) - self.reached @ x)

    def settling_time(self, x: Array, window: float) -> float:
        """Compute the time from which the error stays within `window`, s; infinite where it does
        not at last, and where one is not finite."""
        error = np.abs(self.error(x)).max(axis=1)
        outside = np.flatnonzero(~(error <= window))
        if not outside.size:
            return 0.0
        later = outside[-1] + 1
        return self.period * float(later) if later < len(error) else np.inf

    def heat(self, x: Array) -> float:
        """∫ |u|² dt, N² s."""
        return self.period * float(((self.force @ x) ** 2).sum())

    def peak(self, x: Array) -> float:
        """The largest force of any motor, N."""
        return float(np.abs(self.force @ x).max())


def _add_taps(response: Array, shape: Shape) -> Array:
    """(N, q, taps c) of (N, q, c): taps of the setpoint, then tap by tap all forces."""
    later = [_later(response, shape.spacing * i) for i in range(shape.taps)]
    return np.concatenate([one[..., :1] for one in later] + [one[..., 1:] for one in later], axis=2)


def _later(signal: Array, samples: int) -> Array:
    """A signal that begins at rest, later."""
    return np.concatenate([np.zeros_like(signal[:samples]), signal[: len(signal) - samples]])


def responses_of(
    loop: Loop, profile: Setpoint, orders: tuple[int, ...], *, axis: int, samples: int
) -> MoveResponses:
    """Respond with N samples to a setpoint and to a force of each of its derivatives at each motor.

    `loop` is closed, sampled and in SI, `profile` of the output `axis` (from 0); the others stay at
    0. `orders` are the derivatives that have a force. Raises UserError where the loop is
    continuous, or not stable.
    """
    if loop.sampling is None:
        raise UserError("feedforward: needs a sampled loop; deploy it, and give --controller")
    G, K = loop.as_run
    closed, period = closed_loop(G, K), loop.sampling.period
    if not np.abs(np.linalg.eigvals(closed.A)).max() < 1.0:
        raise UserError("feedforward: the loop is not stable on every plant of its set")
    rows, wanted, reference = counted_rows(loop, axis, closed)
    if not (loop.at or loop.ported):  # the other axes have to stay
        rows, wanted = closed.C_y, reference
    m, n = G.B.shape[1], len(closed.A)
    r = held_setpoint(profile, period * np.arange(samples, dtype=float), period)
    driven = [np.outer(r[0], closed.B_r @ reference)]
    ahead = [np.outer(r[0], closed.D_u @ reference)]
    for order in orders:
        for motor in range(m):
            signal = np.zeros((samples, n))
            signal[:, : len(G.A)] = np.outer(r[order], G.B[:, motor])
            driven.append(signal)
            ahead.append(np.outer(r[order], np.eye(m)[motor]))
    x = [states(closed.A, signal) for signal in driven]
    return MoveResponses(
        period,
        np.stack([one @ rows.T for one in x], axis=2),
        np.stack([one @ closed.C_u.T + more for one, more in zip(x, ahead, strict=True)], axis=2),
        np.outer(r[0], wanted),
    )


def learning_gain(model: MoveResponses, shape: Shape) -> Array:
    """Ψ⁺ (c, N q), from the error of a move to what is added to the forces of the first tap;
    `model` has all taps.
    """
    psi = _first(model, shape)
    size = np.abs(psi).max(axis=0)  # derivatives of the setpoint differ by many decades
    return np.asarray(np.linalg.pinv(psi / size) / size[:, None])


def learn(x: Array, error: Array, gain: Array, shape: Shape) -> Array:
    """Coefficients after a move with a controller's error (N, q), unit of y."""
    found = x.copy()
    found[shape.taps : shape.taps + len(gain)] += gain @ error.ravel()
    return found


def contraction(plants: Sequence[MoveResponses], gain: Array, shape: Shape) -> float:
    """ρ, the largest of all plants: less than 1 where learning converges on each; all taps, `gain`
    (c, N q).
    """
    one = np.eye(len(gain))
    return max(float(np.abs(np.linalg.eigvals(one - gain @ _first(plant, shape))).max())
               for plant in plants)  # fmt: skip


def least_error(plant: MoveResponses, x: Array, shape: Shape) -> float:
    """The least RMS of the controller's error that other forces of the first tap leave: what
    learning can reach."""
    psi = _first(plant, shape)
    size = np.abs(psi).max(axis=0)
    left = plant.tracking(x, shape).ravel()
    found = left - psi / size @ np.linalg.lstsq(psi / size, left)[0]
    return float(np.sqrt(np.mean(found**2)))


def _first(plant: MoveResponses, shape: Shape) -> Array:
    """Responses (N q, c) to the forces of the first tap."""
    count = len(shape.orders) * shape.forces
    own = plant.reached[..., shape.taps : shape.taps + count]
    return np.asarray(own.reshape(-1, count))


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
