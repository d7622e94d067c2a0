"""From one part of a stroke to the next: who controls where, and how fast p may change.

A part keeps control until the measured p leaves its range; then the part in whose range p lies
deepest takes over. Parts overlap: p has to return through the overlap before control does.

All parts have the same sections, so that a state means the same in each: the next part takes it
over. Only the integrators' share is rescaled, so that the force which holds a constant load stays:

    x' = (1 - V' W')(1 - V W) x + V' (C' V')⁺ C V W x

V and W are right and left eigenvectors of the poles at z = 1 before (and ' after) the handover,
W V = 1. On examples/gantry_stroke under a random force the motion does not rise at a handover; a
state by the last force alone (`controller_takeover`) raises it sixfold, as it starts all filters
anew.

The simulation moves p to and fro between the ends at a constant rate, the plant's matrices with it,
under a random force, and compares what is left of the loop's quiet with that of p at rest:

    rise = max over t of |y| on the way / max over p at rest and t of |y|

It is a test at the rates that are tried, with M(p), D(p), K(p) of the instant: what p's own motion
adds (Coriolis forces, a load that is carried along) is not in it.

How fast p may change is found by a Lyapunov function that moves with p (after Desoer 1969).
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

from ccd_casadi.extensions.schedule.segments import DesignedPart, Segment
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop, sigma_max, state_scales
from ccd_casadi.support.arrays import Array, states


@dataclass(frozen=True)
class CrossingOptions:
    """Numbers of the simulation on the way."""

    positions: int = 401  # at which the plant's matrices are evaluated; linear between them
    slowest: float = 160.0  # first time over the range, in periods of the least ω_b; then halved
    trials: int = 7  # rates at most
    rests: int = 9  # positions at rest to compare with
    rise: float = 1.25  # of the largest motion, over that at rest, that is allowed
    longest: int = 400_000  # periods of the way at one rate that are simulated at most


@dataclass(frozen=True)
class RateTrial:
    """A rate of p (its unit/s), the rise of the motion, and its share that is left in the end.

    That is the last tenth of a time of which the second half has no force; infinite: it diverged.
    """

    rate: float
    rise: float
    left: float


def controllers_of(parts: Sequence[DesignedPart], sampling: Sampling) -> list[StateSpace]:
    """K(z) of every part, by Tustin's rule."""
    found = []
    for part in parts:
        assert part.design.controller is not None
        found.append(tustin(part.design.controller, sampling.period))
    return found


def handovers(K: Sequence[StateSpace], *, resting: float = 1e-7) -> Array:
    """The state of a part from that of another: (parts, parts, n, n) of the K(z) of each part.

    |z - 1| of an integrator's pole is at most `resting`.
    """
    kept, moves, forces, one = [], [], [], np.eye(len(K[0].A))
    for own in K:
        poles, vectors = np.linalg.eig(own.A)
        slow = np.abs(poles - 1.0) <= resting
        V, W = vectors[:, slow].real, np.linalg.inv(vectors)[slow].real
        kept.append(one - V @ W)
        moves.append(V @ np.linalg.pinv(own.C @ V) if slow.any() else np.zeros_like(own.C.T))
        forces.append(own.C @ V @ W)
    return np.array([[kept[j] @ kept[i] + moves[j] @ forces[i] if i != j else one
                      for j in range(len(K))] for i in range(len(K))])  # fmt: skip


def part_at(segments: Sequence[Segment], now: int, p: float) -> int:
    """Return the part that controls at p, where `now` did before."""
    if segments[now].low <= p <= segments[now].high:
        return now
    depths = [min(p - one.low, one.high - p) for one in segments]
    return int(np.argmax(depths))


@dataclass(frozen=True)
class Way:
    """The loop along the range, its sampled plant linear between places."""

    segments: Sequence[Segment]  # the parts
    K: Sequence[StateSpace]  # K(z) of each
    places: Array  # (N,) evenly over the range
    plants: Sequence[StateSpace]  # at these, sampled

    def longest(self, options: CrossingOptions) -> float:
        """Time over the range at the first rate, s."""
        return options.slowest * 2.0 * np.pi / min(one.design.bandwidth for one in self.segments)

    @np.errstate(over="ignore", invalid="ignore")  # a loop that is lost leaves double precision
    def errors(self, way: Array, force: Array) -> Array:
        """The largest |y| of each step along p = way (k,) under a force (k, m) at the actuators."""
        A, B, C = (np.array([getattr(one, part) for one in self.plants]) for part in "ABC")
        onwards, found = handovers(self.K), np.zeros(len(way))
        share = (way - self.places[0]) / (self.places[-1] - self.places[0]) * (len(A) - 1)
        left = np.minimum(share.astype(int), len(A) - 2)
        x, now = np.zeros(A.shape[1]), part_at(self.segments, 0, float(way[0]))
        z = np.zeros(len(self.K[now].A))
        for k, (i, p) in enumerate(zip(left.tolist(), way.tolist(), strict=True)):
            t = share[k] - i
            e = -((C[i] + t * (C[i + 1] - C[i])) @ x)
            found[k] = np.abs(e).max()
            part = part_at(self.segments, now, p)
            if part != now:
                now, z = part, onwards[now, part] @ z
            own = self.K[now]
            u = own.C @ z + own.D @ e + force[k]
            z = own.A @ z + own.B @ e
            x = A[i] @ x + B[i] @ u + t * ((A[i + 1] - A[i]) @ x + (B[i + 1] - B[i]) @ u)
        return np.where(np.isfinite(found), found, np.inf)

    def at_rest(self, force: Array, rests: int) -> float:
        """The largest |y| of the loops at rest at some of the places, under the same force."""
        most = 0.0
        for i in np.linspace(0, len(self.places) - 1, rests).astype(int).tolist():
            part = part_at(self.segments, 0, float(self.places[i]))
            loop = closed_loop(self.plants[i], self.K[part])
            most = max(most, np.abs(states(loop.A, force @ loop.B_d.T) @ loop.C_y.T).max())
        return float(most)


def sampled_plants(
    problem: CoDesignProblem, theta: Sequence[float], name: str, positions: Sequence[float]
) -> list[StateSpace]:
    """The model at positions of p, sampled, in the states of its own matrices."""
    sampling = structured_of(problem).sampling
    assert sampling is not None
    own = uncertain_plant(problem, theta)
    row = np.array(own.names) == f"theta.{name}"
    plants = own.as_written([(0, np.where(row, p, own.nominal)) for p in positions])
    return [zoh(plant, sampling.period, sampling.delay) for plant in plants]


def way_of(
    problem: CoDesignProblem, theta: Sequence[float], name: str, segments: Sequence[Segment],
    options: CrossingOptions = CrossingOptions(),
) -> Way:  # fmt: skip
    """The loop of a schedule along its range."""
    sampling = structured_of(problem).sampling
    assert sampling is not None
    places = np.linspace(segments[0].low, segments[-1].high, options.positions)
    plants = sampled_plants(problem, theta, name, places.tolist())
    return Way(segments, controllers_of(segments, sampling), places, plants)


def rates_tried(
    way: Way, *, seed: int = 0, options: CrossingOptions = CrossingOptions()
) -> list[RateTrial]:
    """Simulate the way over the whole range at rising rates, until the motion rises too much."""
    rate, found = float(np.ptp(way.places)) / way.longest(options), []
    for _ in range(options.trials):
        found.append(cross(way, rate, seed=seed, options=options))
        if not found[-1].rise <= options.rise:
            break
        rate *= 2.0
    return found


def cross(
    way: Way, rate: float, *, seed: int = 0, options: CrossingOptions = CrossingOptions()
) -> RateTrial:
    """Simulate the way at one rate, to and fro: half the time under a random force, then without.

    NaN: the way takes more than `options.longest` periods.
    """
    period, width = way.plants[0].period, float(np.ptp(way.places))
    if not rate * period * options.longest >= 2.0 * width:
        return RateTrial(rate, np.nan, np.nan)
    half = int(np.ceil(max(way.longest(options), width / rate) / period))
    force = np.random.default_rng(seed).standard_normal((2 * half, way.K[0].C.shape[0]))
    force[half:] = 0.0
    to_and_fro = np.abs(np.arange(2 * half) * (rate * period / width) % 2.0 - 1.0)
    motion = way.errors(way.places[-1] - width * to_and_fro, force)
    most = float(motion.max())
    rise = most / way.at_rest(force, options.rests)
    return RateTrial(rate, rise, float(motion[-half // 5 :].max()) / most)


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
