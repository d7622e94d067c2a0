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

from ccd_casadi.extensions.schedule.segments import Segment, within
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Sampling, sampled, tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class CrossingOptions:
    """Numbers of the simulation on the way.

    Attributes
    ----------
    positions : int
        At which the plant's matrices are evaluated.
    slowest : float
        Time over the range of the first rate, in periods of the least ω_b; then halved.
    trials : int
        Rates at most.
    rests : int
        Positions at rest to compare with.
    rise : float
        Of the largest motion, over that at rest, which a rate that is allowed does not exceed.
    """

    positions: int = 100
    slowest: float = 160.0
    trials: int = 7
    rests: int = 9
    rise: float = 1.25


@dataclass(frozen=True)
class RateTrial:
    """A rate of p (its unit/s) and the rise of the motion; infinite: it diverged."""

    rate: float
    rise: float


def controllers_of(segments: Sequence[Segment], sampling: Sampling) -> list[StateSpace]:
    """K(z) of every part, by Tustin's rule."""
    found = []
    for segment in segments:
        assert segment.design.controller is not None
        found.append(tustin(segment.design.controller, sampling.period))
    return found


def handovers(K: Sequence[StateSpace], *, resting: float = 1e-7) -> Array:
    """The state of a part from that of another.

    Parameters
    ----------
    K : sequence of StateSpace
        K(z) of every part, of one structure.
    resting : float
        |z - 1| of a pole of an integrator.

    Returns
    -------
    (parts, parts, n, n) array
        x of the second from x of the first.
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
    """Which part controls at p, where `now` did before."""
    if segments[now].low <= p <= segments[now].high:
        return now
    depths = [min(p - one.low, one.high - p) for one in segments]
    return int(np.argmax(depths))


def rates_tried(
    problem: CoDesignProblem, theta: Sequence[float], name: str, segments: Sequence[Segment],
    *, seed: int = 0, options: CrossingOptions = CrossingOptions(),
) -> list[RateTrial]:  # fmt: skip
    """Simulate the way over the whole range at rising rates, until the motion rises too much.

    Parameters
    ----------
    problem, theta, name : CoDesignProblem, sequence of float, str
    segments : sequence of Segment
        Of a sampled loop.
    seed : int
        Of the force.
    options : CrossingOptions

    Returns
    -------
    list of RateTrial
        The last may exceed `options.rise`.
    """
    sampling = structured_of(problem).sampling
    assert sampling is not None
    low, high = segments[0].low, segments[-1].high
    places = np.linspace(low, high, options.positions)
    plants = []
    for p in places.tolist():
        own = uncertain_plant(within(problem, name, p, p), theta)
        (plant,) = own.as_written([(0, own.nominal)])
        plants.append(sampled(plant, sampling.period, sampling.delay))
    K = controllers_of(segments, sampling)
    rng = np.random.default_rng(seed)
    slowest = min(one.design.bandwidth for one in segments) / (2.0 * np.pi)
    longest = int(np.ceil(options.slowest / slowest / sampling.period))
    force = rng.standard_normal((longest, K[0].C.shape[0]))

    def largest(way: Array) -> float:
        return _simulated(segments, plants, K, places, way, force)

    rest = max(largest(np.full(longest, p)) for p in np.linspace(low, high, options.rests))
    found = []
    for trial in range(options.trials):
        steps = longest // 2**trial
        to_and_fro = np.abs(np.arange(longest) / steps % 2.0 - 1.0)  # as long as at rest
        rise = largest(high - (high - low) * to_and_fro) / rest
        found.append(RateTrial((high - low) / (steps * sampling.period), rise))
        if not rise <= options.rise:
            break
    return found


@np.errstate(over="ignore", invalid="ignore")  # a loop that is lost leaves double precision
def _simulated(
    segments: Sequence[Segment], plants: Sequence[StateSpace], K: Sequence[StateSpace],
    places: Array, way: Array, force: Array,
) -> float:  # fmt: skip
    """The largest |y| along p(t) = way under a force at the actuators; infinite: it diverged."""
    onwards = handovers(K)
    x, most = np.zeros(len(plants[0].A)), 0.0
    now = part_at(segments, 0, float(way[0]))
    z = np.zeros(len(K[now].A))
    spot = np.abs(places - way[:, None]).argmin(axis=1)
    for k in range(len(way)):
        G = plants[spot[k]]
        e = -(G.C @ x)
        most = max(most, float(np.abs(e).max()))
        part = part_at(segments, now, float(way[k]))
        if part != now:
            now, z = part, onwards[now, part] @ z
        own = K[now]
        u = own.C @ z + own.D @ e
        z = own.A @ z + own.B @ e
        x = G.A @ x + G.B @ (u + force[k])
    return most if np.isfinite(x).all() and np.isfinite(most) else np.inf
