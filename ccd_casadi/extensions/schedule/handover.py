"""From one part of a stroke to the next: who controls where, and a simulation on the way.

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
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.extensions.schedule.segments import DesignedPart, Segment
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop
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
