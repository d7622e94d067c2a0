"""How fast p may change: a Lyapunov function that moves with p (after Desoer 1969).

In a part the sampled loop is x⁺ = A(p) x, x of the plant as written and of the controller. Its
modes are in two groups: slow ones, such as an integrator's, and the rest. With Y(p), rows for both
groups, linear between N positions, n = (|Y_s x|, |Y_f x|) has in a step with |p' - p| <= r T

    n⁺ <= N n,    N_ab = max over p, p' of |Y_a(p') A(p) Y⁻¹_b(p)|,

and at a handover, x⁺ = E x, n⁺ <= B n with B_ab = |Y_a E Y⁻¹_b| of both parts. V = w n, w > 0 of
each part, falls at each step where wN < w, and from handover to handover where w'BNᵏ < w over the k
periods in between. The highest r for which some w have both, over the range forth and back, is the
allowed rate. Who turns back sooner waits: a part keeps control as long as crossing it takes at r.

At each position a group's Y is R Z: Z projects on the group, in the modes of one position of the
part, and RᴴR = P solves (F/σ)ᴴP(F/σ) - P = -Q, σ = ρ(F)ˢ, of the group's F = Z A Z⁻¹. Q is such
that P = 1 at that position for s = 0. On loops of examples/gantry_stroke one group of all modes
allows 0.02 m/s, as V waits for the integrator; Q = 1 in states of even scales 0.04 m/s inside a
part alone; and P of each position's own modes 0.02 to 3 m/s there, as two poles meet in some parts.
Two groups allow 0.18 m/s over two parts of 0.1 m whose controllers were searched apart; simulated
at it the loop decays, but its largest motion is 4.6 times that at rest: V says nothing of that.

A(p) between the positions is not covered, nor are plants off the model, nor forces of p's motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, solve_discrete_lyapunov

from ccd_casadi.extensions.schedule.handover import (
    controllers_of,
    handovers,
    part_at,
    sampled_plants,
)
from ccd_casadi.extensions.schedule.segments import Segment
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.state_space import closed_loop, sigma_max, state_scales
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class RateBoundOptions:
    """Numbers of the bound."""

    positions: int = 101  # N of each part
    halvings: int = 18  # of the interval of rates
    share: float = 0.8  # s
    decades: float = 4.0  # to each side of 1, of w_f/w_s
    weights: int = 65  # their number


@dataclass(frozen=True)
class PartModes:
    """The modes of a part: A and Y at its positions (N, n, n), and the number of slow modes."""

    loops: Array
    Y: np.ndarray
    slow: int

    def norms(self, parts: np.ndarray, other: int) -> Array:
        """The largest norm of each block (2, 2) of matrices that lead to `other` slow modes."""
        rows, columns = ((slice(k), slice(k, None)) for k in (other, self.slow))
        return np.array([[sigma_max(parts[:, a, b]).max() for b in columns] for a in rows])

    @cached_property
    def _seen(self) -> tuple[np.ndarray, np.ndarray, Array]:
        """Y A Y⁻¹ at each position, its change with Y to each neighbour, and N at rest."""
        k = np.arange(len(self.Y))
        at, to = np.append(k[:-1], k[1:]), np.append(k[1:], k[:-1])
        onto = self.loops[at] @ np.linalg.inv(self.Y)[at]
        rest = self.Y[at] @ onto
        return rest, (self.Y[to] - self.Y[at]) @ onto, self.norms(rest, self.slow)

    def step(self, share: float) -> Array:
        """N where p moves by this share of the distance of positions in a period, or less."""
        rest, moved, least = self._seen  # a norm is convex in the share: its ends are examined
        return np.maximum(least, self.norms(rest + share * moved, self.slow))


def modes_of(loops: Array, options: RateBoundOptions = RateBoundOptions()) -> PartModes:
    """Y of a part: its groups are apart where neighbouring decays are, in the mean of p."""
    values, X = np.linalg.eig(loops)
    order = np.argsort(-np.abs(values), axis=1)
    values = np.take_along_axis(values, order, axis=1)
    X = np.take_along_axis(X, order[:, None], axis=2)
    Y = np.linalg.inv(X)
    slow = int(np.argmax(np.diff(np.log(-np.log(np.abs(values))), axis=1).mean(axis=0))) + 1
    best = int(np.argmin(np.linalg.cond(X)))
    size = np.sqrt(np.linalg.norm(X[best], axis=0) / np.linalg.norm(Y[best], axis=1))
    first, back, found = size[:, None] * Y[best], X[best] / size, []
    for A, x, y in zip(loops, X, Y, strict=True):
        rows = []
        for own in (slice(slow), slice(slow, None)):
            onto = first[own] @ x[:, own] @ y[own]  # analytic in p, through double poles too
            part = onto @ A @ back[:, own] @ np.linalg.inv(onto @ back[:, own])
            sigma = np.abs(np.linalg.eigvals(part)).max() ** options.share
            Q = np.diag(1.0 - np.abs(values[best, own]) ** 2)
            P = solve_discrete_lyapunov(part.conj().T / sigma, Q)
            rows.append(np.linalg.cholesky(P).conj().T @ onto)
        found.append(np.vstack(rows))
    return PartModes(loops, np.array(found), slow)


@dataclass(frozen=True)
class Border:
    """A handover at p = `at` between two parts; p has moved by `way` since the one before."""

    first: int
    then: int
    at: float
    way: float


def borders(segments: Sequence[Segment]) -> list[Border]:
    """The handovers of the way over the whole range, forth and back."""
    low, high = segments[0].low, segments[-1].high
    now, found = 0, []
    for up, end in ((True, high), (False, low)):
        while (at := segments[now].high if up else segments[now].low) != end:
            then = part_at(segments, now, float(np.nextafter(at, np.inf if up else -np.inf)))
            found.append((now, then, at, at - low if up else 2.0 * high - low - at))
            now = then
    moved = np.array([far for *_, far in found])
    ways = np.diff(moved, prepend=moved[-1:] - 2.0 * (high - low))
    return [Border(*one[:3], float(way)) for one, way in zip(found, ways, strict=True)]


@dataclass(frozen=True)
class RateBound:
    """The allowed rate of p."""

    rate: float  # r, unit of p per second; 0: none
    positions: int  # N
    part: int  # that set it, from 0
    at: float | None  # where it hands over; None: V stops falling inside
    waits: tuple[float, ...]  # of each part, s: it keeps control for at least as long


def rate_bound(
    loops: Sequence[Array], E: Array, segments: Sequence[Segment], period: float,
    options: RateBoundOptions = RateBoundOptions(),
) -> RateBound:  # fmt: skip
    """The highest rate of p at which V falls over the range, forth and back.

    `loops` has A of each part (N, n, n), evenly from its low to its high end, `E` x of the second
    part from x of the first (parts, parts, n, n), `period` T in s.
    """
    parts, way = [modes_of(A) for A in loops], borders(segments)
    fastest = [(one.high - one.low) / (len(A) - 1) / period
               for one, A in zip(segments, loops, strict=True)]  # fmt: skip
    jumps = [_jump(parts, one, E[one.first, one.then], segments) for one in way]
    rows = np.array([[(one.then == i) - (one.first == i) for i in range(len(parts))]
                     for one in way], float).reshape(-1, len(parts))  # fmt: skip
    # |n| of each part in a unit of its own, which shares a growth between two directions
    sizes = np.log([np.diagonal(B) for B in jumps]).reshape(-1, 2)
    units = np.exp(-np.linalg.lstsq(rows, sizes)[0])
    ratios = np.geomspace(10.0**-options.decades, 10.0**options.decades, options.weights)
    w = units[:, None] * np.stack([np.ones(len(ratios)), ratios], axis=1)
    what = [*((i, None) for i in range(len(parts))), *((one.first, one.at) for one in way)]
    low, high, sets = 0.0, min(fastest), what[int(np.argmin(fastest))]
    for _ in range(options.halvings):
        rate = 0.5 * (low + high)
        N = [part.step(rate / most) for part, most in zip(parts, fastest, strict=True)]
        rises = [(v @ own / v).max(axis=1) for v, own in zip(w, N, strict=True)]
        for one, B in zip(way, jumps, strict=True):
            held = np.linalg.matrix_power(N[one.first], int(one.way / (rate * period)))
            rises.append((w[one.then] @ B @ held / w[one.first]).max(axis=1))
        whole = np.array(rises)
        best = whole[:, whole.max(axis=0).argmin()]
        if best.max() < 1.0:
            low = rate
        else:
            high, sets = rate, what[int(best.argmax())]
    waits = [max((one.way / low if low else np.inf for one in way if one.first == i), default=0.0)
             for i in range(len(parts))]  # fmt: skip
    return RateBound(low, len(loops[0]), *sets, tuple(waits))


def _jump(parts: Sequence[PartModes], one: Border, E: Array, segments: Sequence[Segment]) -> Array:
    """B of a handover."""
    before, after, own = parts[one.first], parts[one.then], segments[one.then]
    k = int((one.at - own.low) / (own.high - own.low) * (len(after.Y) - 1))
    onto = E @ np.linalg.inv(before.Y[-1 if one.at == segments[one.first].high else 0])
    return before.norms(after.Y[k : k + 2] @ onto, after.slow)


def rate_bound_of(
    problem: CoDesignProblem, theta: Sequence[float], name: str, segments: Sequence[Segment],
    options: RateBoundOptions = RateBoundOptions(),
) -> RateBound:  # fmt: skip
    """`rate_bound` of a schedule's model, in states of even scales."""
    sampling = structured_of(problem).sampling
    assert sampling is not None
    K, loops = controllers_of(segments, sampling), []
    for one, own in zip(segments, K, strict=True):
        places = np.linspace(one.low, one.high, options.positions).tolist()
        loops.append([closed_loop(G, own) for G in sampled_plants(problem, theta, name, places)])
    first = loops[0][0]
    t = state_scales(first.A, first.B_d, first.C_y)
    plant = np.eye(len(t) - len(K[0].A))
    E = np.array([[block_diag(plant, T) for T in row] for row in handovers(K)])
    scaled = [np.array([loop.A for loop in part]) * t / t[:, None] for part in loops]
    return rate_bound(scaled, E * t / t[:, None], segments, sampling.period, options)
